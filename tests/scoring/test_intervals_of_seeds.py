"""Intervals over seeds against SciPy and simulations, in the middle of a span and at its bounds."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy import stats

from clbench.records.record import Relearning
from clbench.scoring.intervals import (
    NO_ESTIMATE,
    Estimate,
    estimate,
    estimate_quantity,
    interval,
    interval_of_seeds,
    mean_of_seeds,
    paired_difference,
)
from clbench.scoring.scores import Scores


def of_means(values: Any, span: tuple[float, float]) -> tuple[float, float]:
    """Return the ends of the interval of the mean of the values of seeds."""
    values = np.asarray(values, dtype=float)
    got = interval(float(values.mean()), (values.sum() - values) / (len(values) - 1), span=span)
    assert got.low is not None
    assert got.high is not None
    return got.low, got.high


def test_with_several_seeds_the_interval_of_an_unbounded_quantity_is_students_t() -> None:
    values = np.array([0.3, 1.7, 0.9, 4.0])
    expected = stats.t.interval(0.95, 3, loc=values.mean(), scale=stats.sem(values))
    assert of_means(values, (-np.inf, np.inf)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("successes", [1, 30, 66, 100])
def test_with_binomial_errors_the_interval_is_wilsons(successes: int) -> None:
    rate, degrees = successes / 101, 10**6
    expected = stats.binomtest(successes, 101).proportion_ci(0.95, "wilson")
    got = interval_of_seeds(rate, np.sqrt(rate * (1 - rate) / 101), degrees, (0.0, 1.0))
    assert got == pytest.approx((expected.low, expected.high), rel=1e-5)


def test_four_seeds_at_a_bound_and_one_near_it_exclude_a_value_far_from_it() -> None:
    low, high = of_means([-1, -1, -1, -0.55, -1], (-1.0, 1.0))
    assert low == pytest.approx(-1.0, abs=0.01)
    assert low > -1.0  # one seed was above it
    assert -0.55 < high < -0.3


def test_the_interval_does_not_depend_on_which_bound_is_near_or_on_the_unit() -> None:
    values = np.array([0.02, 0.0, 0.11, 0.01])
    low, high = of_means(values, (0.0, 1.0))
    assert of_means(1 - values, (0.0, 1.0)) == pytest.approx((1 - high, 1 - low))
    assert of_means(100 * values - 50, (-50.0, 50.0)) == pytest.approx((100 * low - 50, 100 * high - 50))


def test_in_the_middle_of_a_wide_span_the_interval_is_students() -> None:
    values = np.array([0.3, 1.7, 0.9, 4.0])
    expected = stats.t.interval(0.95, 3, loc=values.mean(), scale=stats.sem(values))
    assert of_means(values, (-1e4, 1e4)) == pytest.approx(expected, rel=1e-3)


def test_a_bound_on_one_side_cuts_students_interval_there() -> None:
    values = np.array([0.9, 0.2, 0.7])
    expected = stats.t.interval(0.95, 2, loc=values.mean(), scale=stats.sem(values))
    assert expected[1] > 1
    assert of_means(values, (-np.inf, 1.0)) == pytest.approx((expected[0], 1.0))


@pytest.mark.parametrize("other", [0.5, 0.99])
def test_a_value_at_a_bound_whose_seeds_vary_has_students_interval_cut_there(other: float) -> None:
    # Not a mean: the value without one seed can be inside though the value is at the bound.
    got = interval(1.0, np.array([1.0, other, 1.0]), span=(0.0, 1.0))
    error = np.sqrt(2) * np.std([1.0, other, 1.0])
    assert (got.low, got.high) == pytest.approx((max(0.0, 1.0 - stats.t.ppf(0.975, 2) * error), 1.0))


def test_seeds_that_differ_in_the_last_bits_have_no_width() -> None:
    assert interval_of_seeds(1.0, 1e-17, 11, (0.0, 1.0)) == (1.0, 1.0)


def test_seeds_whose_differences_are_0_but_for_the_last_bits_have_the_error_of_their_episodes() -> None:
    drawn = np.array([-0.1, 0.1])
    exact = interval(0.0, np.zeros(3), lambda: drawn, (-1.0, 1.0))
    assert exact.high is not None
    assert exact.high > 0.1
    assert interval(0.0, np.array([0.1 + 0.2 - 0.3, 0.0, 0.0]), lambda: drawn, (-1.0, 1.0)) == exact


def test_a_mean_of_two_seeds_at_both_bounds_keeps_wilsons_interval() -> None:
    low, high = of_means(np.array([0.0, 1.0]), (0.0, 1.0))  # the largest error that a mean can have
    assert 0 < low < 0.01
    assert 0.99 < high < 1


def test_an_error_that_no_mean_can_have_gives_students_interval_cut_at_the_bounds() -> None:
    # the error of a mean at one half is at most one half; the interval of that is inside, any other is cut
    low, high = interval_of_seeds(0.5, 0.5, 3, (0.0, 1.0))
    assert 0 < low < high < 1
    assert interval_of_seeds(0.5, 0.6, 3, (0.0, 1.0)) == (0.0, 1.0)
    reach = stats.t.ppf(0.975, 50) * 0.3
    assert interval_of_seeds(0.1, 0.301, 50, (0.0, 1.0))[1] == pytest.approx(0.1 + reach, abs=0.003)


@pytest.mark.parametrize("seeds", [3, 4, 5, 8])
@pytest.mark.parametrize("rate", [0.01, 0.03, 0.5, 0.99])
def test_intervals_hold_rates_near_0_and_1_about_as_often_as_they_should(seeds: int, rate: float) -> None:
    # Seeds of a beta distribution whose deviation is 0.05 at one half, and 200 episodes each.
    generator = np.random.default_rng(0)
    size = 0.25 / 0.05**2 - 1
    rates = generator.beta(rate * size, (1 - rate) * size, (2000, seeds))
    values = generator.binomial(200, rates) / 200
    # Seeds that agree exactly have an interval of episodes: here they count as misses.
    ends = [of_means(row, (0.0, 1.0)) for row in values[np.ptp(values, axis=1) > 0]]
    assert 0.92 <= sum(low <= rate <= high for low, high in ends) / 2000 <= 0.985


def test_a_quantity_without_value_for_some_seeds_has_no_interval() -> None:
    assert interval(1.0, np.array([1.0, np.nan])) == Estimate(1.0, None, None)
    assert interval(1.0, np.array([0.5, 1.5, np.nan])) == Estimate(1.0, None, None)
    assert interval(np.nan, np.array([1.0, 2.0])) == NO_ESTIMATE
    assert interval(1.0, np.zeros(0)) == Estimate(1.0, None, None)
    assert interval(1.0, np.zeros(0), lambda: np.array([1.0, np.nan])) == Estimate(1.0, None, None)


def test_a_ratio_has_the_interval_of_its_logarithm() -> None:
    # by hand: mean and Student's interval of the logarithms
    values = np.array([0.12, 0.36, 0.24, 1.31])
    logs = np.log(values)
    reach = stats.t.ppf(0.975, 3) * logs.std(ddof=1) / 2
    without_one = np.exp((logs.sum() - logs) / 3)
    got = interval(float(np.exp(logs.mean())), without_one, ratio=True)
    expected = np.exp([logs.mean() - reach, logs.mean() + reach])
    assert [got.low, got.high] == pytest.approx(expected)
    assert got.of_seeds
    of_seeds = mean_of_seeds([0.12, 0.36, 0.24, 1.31], (0.0, np.inf), ratio=True)
    assert [of_seeds.value, of_seeds.low, of_seeds.high] == pytest.approx(
        [float(np.exp(logs.mean())), got.low, got.high]
    )
    assert interval(0.0, np.array([0.0, 0.0]), ratio=True) == Estimate(0.0, None, None)  # no logarithm
    # a geometric mean of 0 without one of the seeds has no logarithm either: the interval is that of values
    some = np.array([0.0, 0.5, 1.0])
    assert interval(0.5, some, ratio=True) == interval(0.5, some)


# ---- metrics -----------------------------------------------------------------------------------------------


def _run(scores: Callable[..., Scores], ends: tuple[int, int] = (8, 12), earlier: float = 0.5) -> Scores:
    """Return a run of two skills and two targets, whose stages took `ends` steps to their criterion."""
    return scores(
        [[1, 1, 0, 0, 0], [0.5, 0.5, 1, 0, 0], [0.5, 0.5, earlier, 1, 0]],
        groups=(2, 2, 1),
        steps=(100,),
        ends=ends,
        captured=[0.5, 0.25],
        shift=[1.0, 2.0],
        sparsity=[[0.5], [0.4]],
        drift=[[1.0], [2.0]],
        answers={(stage, "left"): (50, 40) for stage in range(3)},
        relearning=Relearning("skill_0", 3, 14, True),
    )


WHOLE = {
    "activation_drift": 2.0,
    "criterion_met": 1.0,
    "instruction_capture": 0.375,
    "relearning_steps": 14.0,
    "shift": 1.5,
    "steps_to_criterion": 10.0,
    "update_sparsity": 0.4,
}
"""Metrics that no draw of episodes changes, with their values for `_run`."""


@pytest.mark.parametrize("seeds", [1, 3])
def test_seeds_that_agree_on_what_no_episode_draws_have_no_interval_of_it(
    seeds: int, scores: Callable[..., Scores]
) -> None:
    runs = dict.fromkeys(range(seeds), _run(scores))
    found = estimate(WHOLE, runs, np.random.default_rng(0), replicates=20)
    assert {name: one.value for name, one in found.items()} == pytest.approx(WHOLE)
    assert {(one.low, one.high) for one in found.values()} == {(None, None)}
    answers = estimate_quantity(
        lambda rates: rates["one"].answer_curves[..., 0, 0].mean(axis=-1),
        {"one": list(runs.values())},
        np.random.default_rng(0),
        replicates=20,
    )
    assert answers.value == pytest.approx(0.8)
    assert (answers.low, answers.high) == (None, None)


def test_the_speed_has_the_interval_of_its_logarithm(scores: Callable[..., Scores]) -> None:
    ends = [(8, 12), (8, 25), (39, 12), (2, 4)]
    runs = {seed: _run(scores, one) for seed, one in enumerate(ends)}
    scratch = dict.fromkeys(runs, _run(scores, (44, 77)))
    logs = np.array([np.mean(np.log([44 / first, 77 / second])) for first, second in ends])
    reach = stats.t.ppf(0.975, 3) * stats.sem(logs)
    references = {"from_scratch": scratch}
    found = estimate(["speed"], runs, np.random.default_rng(0), references=references)["speed"]
    expected = np.exp([logs.mean(), logs.mean() - reach, logs.mean() + reach])
    assert [found.value, found.low, found.high] == pytest.approx(expected)


def test_a_difference_may_be_as_large_as_both_ends_of_a_metric_are_apart(
    scores: Callable[..., Scores],
) -> None:
    # backward transfer is from -1 to 1: 0, -0.5 and 0 against -1 differ by up to 1, and could by 2
    runs = {seed: _run(scores, earlier=one) for seed, one in enumerate((1.0, 0.5, 1.0))}
    others = dict.fromkeys(runs, _run(scores, earlier=0.0))
    found = paired_difference("backward_transfer", runs, others, np.random.default_rng(0))
    differences = np.array([1.0, 0.5, 1.0])
    expected = interval_of_seeds(differences.mean(), stats.sem(differences), 2, (-2.0, 2.0))
    assert (found.low, found.high) == pytest.approx(expected)
    assert expected[1] > 1


def test_a_ratio_of_one_seed_has_the_percentiles_of_the_logarithms_of_its_draws() -> None:
    drawn = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    got = interval(4.0, np.zeros(0), lambda: drawn, ratio=True)
    ends = np.exp(np.percentile(np.log(drawn), [2.5, 97.5]))
    assert (got.low, got.high) == pytest.approx(tuple(ends))
    assert not got.of_seeds


def test_runs_are_paired_by_seed_in_whatever_order_their_seeds_are_given(
    scores: Callable[..., Scores],
) -> None:
    runs = {seed: _run(scores, earlier=one) for seed, one in enumerate((1.0, 0.5, 0.0))}
    backwards = dict(reversed(runs.items()))
    nothing = Estimate(0.0, 0.0, 0.0)  # each run minus itself
    found = estimate(["gain"], runs, np.random.default_rng(0), references={"sft": backwards})
    assert found["gain"] == nothing
    assert paired_difference("final_average", runs, backwards, np.random.default_rng(0)) == nothing


def test_an_interval_holds_its_value_even_if_the_draws_of_its_episodes_do_not() -> None:
    above, below = (interval(1.0, np.zeros(0), partial(np.full, 2, drawn)) for drawn in (2.0, 0.0))
    assert (above.low, above.high) == (1.0, 2.0)
    assert (below.low, below.high) == (0.0, 1.0)
