"""Intervals over seeds against SciPy and simulations, in the middle of a span and at its bounds."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from clbench.scoring.intervals import NO_ESTIMATE, Estimate, interval, interval_of_seeds


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


def test_a_mean_of_two_seeds_at_both_bounds_keeps_wilsons_interval() -> None:
    low, high = of_means(np.array([0.0, 1.0]), (0.0, 1.0))  # the largest error that a mean can have
    assert 0 < low < 0.01
    assert 0.99 < high < 1


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
    assert interval(0.0, np.array([0.0, 0.0]), ratio=True) == Estimate(0.0, None, None)  # no logarithm
