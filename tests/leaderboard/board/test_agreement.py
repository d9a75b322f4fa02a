"""Agreement on the order of the rows, against SciPy's Kendall's tau and a count of random orders."""

import itertools

import numpy as np
import pytest
from scipy.stats import kendalltau

from clbench.base.entry_points import resolve

Concordance = resolve("clbench.leaderboard.board.agreement:Concordance")
RankCorrelation = resolve("clbench.leaderboard.board.agreement:RankCorrelation")
agreement_between = resolve("clbench.leaderboard.board.agreement:agreement_between")
concordance = resolve("clbench.leaderboard.board.agreement:concordance")
kendall_tau = resolve("clbench.leaderboard.board.agreement:kendall_tau")


@pytest.mark.parametrize("levels", [3, 1000])
def test_tau_is_that_of_scipy_with_and_without_ties(levels: int) -> None:
    values = np.random.default_rng(levels).integers(levels, size=(20, 2, 7)) / 7
    expected = [kendalltau(one, other).statistic for one, other in values]
    np.testing.assert_allclose(kendall_tau(values[:, 0], values[:, 1]), expected, atol=1e-12)


def test_equal_values_that_differ_in_the_last_bit_are_ties() -> None:
    assert kendall_tau(np.array([0.1 + 0.2, 0.3, 1.0]), np.array([0.3, 0.3, 1.0])) == pytest.approx(1.0)


def test_seeds_with_one_order_agree_and_seeds_with_random_orders_do_not() -> None:
    generator = np.random.default_rng(0)
    clear = np.arange(8)[:, None] / 8 + generator.normal(0, 0.01, (8, 8))
    found = concordance(clear)
    assert (found.w, found.seeds, found.rows, found.certain) == (pytest.approx(1.0), 8, 8, True)
    noise = [concordance(generator.normal(0, 1, (8, 6))) for _ in range(200)]
    assert sum(one.certain for one in noise) <= 20


def test_w_is_that_of_its_definition_and_its_chance_that_of_random_orders() -> None:
    generator = np.random.default_rng(3)
    values = np.arange(6)[:, None] / 4 + generator.normal(0, 1, (6, 5))

    def w(ranks: np.ndarray) -> float:
        """Return 12 S / (m^2 (n^3 - n)) of ranks (rows, seeds); S is the scatter of their sums."""
        rows, seeds = ranks.shape
        sums = ranks.sum(axis=1)
        return float(12 * ((sums - sums.mean()) ** 2).sum() / (seeds**2 * (rows**3 - rows)))

    found = concordance(values)
    assert found.w == pytest.approx(w(values.argsort(axis=0).argsort(axis=0)))
    drawn = [w(generator.permuted(np.tile(np.arange(6)[:, None], 5), axis=0)) for _ in range(4000)]
    assert found.chance == pytest.approx(np.mean(np.array(drawn) >= found.w - 1e-9), abs=0.02)


def test_the_chance_is_that_of_a_random_order_of_the_rows() -> None:
    # of the 720 orders of six rows, 2 are as far from chance as equal ones, and 12 as far as one swap
    six = np.arange(6)[:, None] + np.zeros((6, 4))
    assert agreement_between(six, six).chance == pytest.approx(2 / 720)
    assert agreement_between(six, 6 - six).direction == -1
    assert agreement_between(six, six[[1, 0, 2, 3, 4, 5]]).chance == pytest.approx(12 / 720)
    farther = agreement_between(six, six[[2, 1, 0, 3, 5, 4]])  # 98 orders have up to 4 inversions
    assert farther.chance == pytest.approx(2 * 98 / 720)
    assert farther.low > 0
    assert farther.direction == 0


def test_with_rows_that_tie_the_chance_is_that_of_a_random_order_too() -> None:
    tied, other = np.array([0.0, 1.0, 1.0, 2.0, 3.0, 4.0]), np.array([1.0, 0.0, 2.0, 3.0, 5.0, 4.0])
    taus = [kendalltau(tied[list(order)], other).statistic for order in itertools.permutations(range(6))]
    as_far = np.abs(taus) >= abs(taus[0]) - 1e-9
    seeds = np.zeros((6, 4))
    found = agreement_between(tied[:, None] + seeds, other[:, None] + seeds)
    assert found.chance == pytest.approx(as_far.mean())
    assert found.chance == agreement_between(other[:, None] + seeds, tied[:, None] + seeds).chance
    assert abs(found.chance - kendalltau(tied, other).pvalue) > 0.01  # SciPy's normal approximation


def test_means_that_differ_in_the_last_bit_are_ties_of_the_chance() -> None:
    tied, other = np.array([0.3, 0.3, 1.0, 2.0, 3.0, 4.0]), np.array([1.0, 0.0, 2.0, 3.0, 5.0, 4.0])
    nearly = tied + np.eye(6)[0] * 4e-16
    assert nearly[0] != nearly[1]
    seeds = np.zeros((6, 4))
    found = [agreement_between(one[:, None] + seeds, other[:, None] + seeds) for one in (tied, nearly)]
    assert found[0].chance == found[1].chance


def test_one_seed_of_a_board_shows_no_agreement() -> None:
    six = np.arange(6)[:, None] + np.zeros((6, 4))
    assert agreement_between(six, six[:, :3]) is None
    assert agreement_between(six[:5], six[:5]) is None


def test_boards_whose_orders_have_nothing_in_common_rarely_agree() -> None:
    generator = np.random.default_rng(1)

    def board() -> np.ndarray:
        return generator.normal(0, 1, (8, 1)) + generator.normal(0, 0.1, (8, 4))

    found = [agreement_between(board(), board(), 200) for _ in range(200)]
    assert sum(one.low > 0 or one.high < 0 for one in found) > 100  # the seeds alone say little of it
    assert sum(one.direction != 0 for one in found) <= 16


@pytest.mark.parametrize("shape", [(4, 8), (5, 8), (8, 3)])
def test_few_rows_or_seeds_have_no_agreement(shape: tuple[int, int]) -> None:
    assert concordance(np.random.default_rng(0).random(shape)) is None


def test_rows_of_one_value_have_no_agreement() -> None:
    assert concordance(np.ones((6, 4))) is None


def test_the_range_is_that_of_boards_whose_seeds_are_drawn_each_on_its_own() -> None:
    generator = np.random.default_rng(2)
    one = generator.normal(0, 1, (7, 1)) + generator.normal(0, 1, (7, 5))
    other = one[:, :4] + generator.normal(0, 1, (7, 4))
    found = agreement_between(one, other, replicates=300)
    drawn = np.random.default_rng(0)
    first, second = drawn.integers(5, size=(300, 5)), drawn.integers(4, size=(300, 4))
    taus = [
        kendalltau(one[:, some].mean(axis=1), other[:, others].mean(axis=1)).statistic
        for some, others in zip(first, second, strict=True)
    ]
    assert (found.low, found.high) == pytest.approx(tuple(np.percentile(taus, (2.5, 97.5))))
    assert found.tau == pytest.approx(kendalltau(one.mean(axis=1), other.mean(axis=1)).statistic)
    assert found.rows == 7


@pytest.mark.parametrize(("chance", "certain"), [(0.04, True), (0.049, True), (0.05, False), (0.06, False)])
def test_chance_is_excluded_below_one_in_twenty(chance: float, certain: bool) -> None:
    assert Concordance(0.5, chance, seeds=4, rows=6).certain == certain
    for tau, low, high in ((0.5, 0.1, 0.9), (-0.5, -0.9, -0.1)):
        agreement = RankCorrelation(tau, low, high, rows=6, chance=chance)
        assert agreement.direction == (np.sign(tau) if certain else 0)
    assert RankCorrelation(0.5, -0.1, 0.9, rows=6, chance=chance).direction == 0


@pytest.mark.parametrize(("tau", "low", "high"), [(0.5, 0.0, 0.9), (-0.5, -0.9, 0.0)])
def test_a_range_that_ends_at_zero_has_no_direction(tau: float, low: float, high: float) -> None:
    assert RankCorrelation(tau, low, high, rows=6, chance=0.01).direction == 0


def test_rows_that_differ_in_the_last_bit_alone_are_ties_of_a_seed() -> None:
    values = np.random.default_rng(4).integers(4, size=(6, 5)) / 4
    nearly = values + np.arange(6)[:, None] * 1e-12
    assert concordance(nearly) == concordance(values)
