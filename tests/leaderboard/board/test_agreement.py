"""Agreement of two halves of the seeds, against SciPy's Kendall's tau."""

import numpy as np
import pytest
from scipy.stats import kendalltau

from clbench.base.entry_points import resolve

agreement_between = resolve("clbench.leaderboard.board.agreement:agreement_between")
agreement_of = resolve("clbench.leaderboard.board.agreement:agreement_of")
kendall_tau = resolve("clbench.leaderboard.board.agreement:kendall_tau")


@pytest.mark.parametrize("levels", [3, 1000])
def test_tau_is_that_of_scipy_with_and_without_ties(levels: int) -> None:
    values = np.random.default_rng(levels).integers(levels, size=(20, 2, 7)) / 7
    expected = [kendalltau(one, other).statistic for one, other in values]
    np.testing.assert_allclose(kendall_tau(values[:, 0], values[:, 1]), expected, atol=1e-12)


def test_equal_values_that_differ_in_the_last_bit_are_ties() -> None:
    assert kendall_tau(np.array([0.1 + 0.2, 0.3, 1.0]), np.array([0.3, 0.3, 1.0])) == pytest.approx(1.0)


def test_rows_far_apart_agree_and_rows_of_noise_do_not() -> None:
    generator = np.random.default_rng(0)
    clear = np.arange(8)[:, None] / 8 + generator.normal(0, 0.01, (8, 8))
    found = agreement_of(clear)
    assert (found.tau, found.low, found.high, found.seeds, found.rows) == (1.0, 1.0, 1.0, 8, 8)
    assert found.direction == 1
    noise = agreement_of(generator.normal(0, 1, (8, 8)))
    assert noise.low < 0 < noise.high
    assert noise.direction == 0


def test_the_chance_is_that_of_a_random_order_of_the_rows() -> None:
    # of the 120 orders of five rows, 2 are as far from chance as equal ones, and 10 as far as one swap
    five = np.arange(5)[:, None] + np.zeros((5, 4))
    assert agreement_between(five, five).chance == pytest.approx(2 / 120)
    assert agreement_between(five, 5 - five).direction == -1
    swapped = agreement_between(five, five[[1, 0, 2, 3, 4]])
    assert swapped.chance == pytest.approx(10 / 120)
    assert swapped.low > 0
    assert swapped.direction == 0


def test_boards_whose_orders_have_nothing_in_common_rarely_agree() -> None:
    generator = np.random.default_rng(1)

    def board() -> np.ndarray:
        return generator.normal(0, 1, (8, 1)) + generator.normal(0, 0.1, (8, 4))

    found = [agreement_between(board(), board(), 200) for _ in range(200)]
    assert sum(one.low > 0 or one.high < 0 for one in found) > 100  # the seeds alone say little of it
    assert sum(one.direction != 0 for one in found) <= 16


@pytest.mark.parametrize("shape", [(4, 8), (8, 3)])
def test_few_rows_or_seeds_have_no_agreement(shape: tuple[int, int]) -> None:
    assert agreement_of(np.random.default_rng(0).random(shape)) is None


def test_rows_of_one_value_have_no_agreement() -> None:
    assert agreement_of(np.ones((5, 4))) is None
