"""Quantiles, and the expected width of intervals, against printed tables, simulations and closed forms."""

import numpy as np
import pytest
from scipy import stats

from clbench.scoring.expected_precision import episodes_needed, expected_precision, half_width
from clbench.scoring.intervals import MANY, student_quantile, studentised_range_quantile
from clbench.testing import TOY


@pytest.mark.parametrize(
    ("degrees", "value"),
    [(1, 12.706), (2, 4.303), (3, 3.182), (4, 2.776), (9, 2.262), (50, 2.009), (MANY, 1.960)],
)
def test_students_quantile_agrees_with_printed_tables(degrees: int, value: float) -> None:
    assert student_quantile(degrees) == pytest.approx(value, abs=0.0006)


@pytest.mark.parametrize(
    ("count", "degrees", "value"),
    [
        (2, 1, 17.97),
        (3, 2, 8.33),
        (5, 8, 4.89),
        (20, 4, 9.23),
        (10, 20, 5.01),
        (10, MANY, 4.47),
        (15, MANY, 4.80),
    ],
)
def test_the_quantile_of_the_studentised_range_agrees_with_printed_tables(
    count: int, degrees: int, value: float
) -> None:
    assert studentised_range_quantile(count, degrees) == pytest.approx(value, abs=0.006)


@pytest.mark.parametrize("degrees", [1, 2, 4, 28, MANY])
def test_the_range_of_two_numbers_is_students_t_times_the_root_of_two(degrees: int) -> None:
    expected = np.sqrt(2) * student_quantile(degrees)
    assert studentised_range_quantile(2, degrees) == pytest.approx(
        expected, rel=1e-5
    )  # SciPy: asymptotic from 1e5 on


@pytest.mark.parametrize(("count", "degrees"), [(3, 2), (5, 8), (15, 28)])
def test_the_studentised_range_exceeds_its_quantile_in_a_twentieth_of_simulations(
    count: int, degrees: int
) -> None:
    generator = np.random.default_rng(0)
    ranges = np.ptp(generator.standard_normal((200_000, count)), axis=1)
    ranges /= np.sqrt(generator.chisquare(degrees, 200_000) / degrees)
    share = np.mean(ranges > studentised_range_quantile(count, degrees))
    assert share == pytest.approx(0.05, abs=0.0015)  # three standard errors


def test_the_width_to_expect_with_one_seed_is_binomial() -> None:
    expected = stats.binomtest(60, 120).proportion_ci(0.95, "wilson")
    assert half_width(1, 20, 6) == pytest.approx((expected.high - expected.low) / 2, rel=1e-5)
    assert half_width(1, 20, 6, seed_deviation=0.3) == half_width(1, 20, 6)


def test_the_episodes_needed_are_the_fewest_that_are_enough() -> None:
    for seeds, tasks, wished in ((1, 6, 0.05), (5, 6, 0.14), (10, 4, 0.1), (10, 10, 0.08), (30, 1, 0.1)):
        needed = episodes_needed(wished, seeds, tasks)
        assert needed is not None
        assert half_width(seeds, needed, tasks) <= wished + 1e-9
        assert needed == 1 or half_width(seeds, needed - 1, tasks) > wished
    assert episodes_needed(half_width(5, 20, 6), 5, 6) == 20
    assert episodes_needed(0.5, 2, 6) == 1  # no interval of a rate is longer


def test_no_number_of_episodes_makes_up_for_seeds_that_differ() -> None:
    # Three seeds of a standard deviation of 0.1 alone give half a width of 0.22 by Wilson's interval.
    assert episodes_needed(0.21, 3, 6) is None
    assert episodes_needed(0.24, 3, 6) == 20
    assert episodes_needed(0.01, 3, 6, seed_deviation=0.0) is not None


def test_a_scenario_has_a_sentence_on_the_intervals_to_expect() -> None:
    three, one = (expected_precision(TOY, seeds) for seeds in (3, 1))
    episodes = TOY.budget.test_episodes
    skills, targets = len(TOY.retained), len(TOY.target)
    widths = [half_width(3, episodes, count) for count in (skills, targets, skills + targets)]
    assert len({f"{width:.2f}" for width in widths}) == 2  # as many skills as targets
    assert three.startswith(f"3 seeds x {episodes} episodes: ")
    assert (
        f"± {widths[0]:.2f} for retention, ± {widths[1]:.2f} for adaptation, "
        f"± {widths[2]:.2f} for final average"
    ) in three
    assert one.startswith("1 seed x ")
    assert "this seed alone" in one
