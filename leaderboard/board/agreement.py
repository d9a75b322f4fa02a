"""Orders of the rows: Kendall's W of the seeds of a board, Kendall's tau of two boards, and of predictors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clbench.scoring.layout import Array
from clbench.scoring.metric import TIE

REPLICATES = 2000
"""Bootstrap draws of seeds."""
ORDERS = 20_000
"""Random orders of the rows in Kendall's test where rows tie: p is known to 0.002 at 0.05."""

SIGNIFICANCE = 0.05
"""Probability by chance below which an agreement is not attributed to chance."""

LEAST_SEEDS, LEAST_ROWS = 4, 6
"""Fewest seeds and rows of a board: Friedman's test and draws of seeds assume several seeds, and five rows
have few orders."""

PREDICTORS = {
    "the shift of the policy on the new data": ("shift", 1.0),
    "the share of the weights that changed": ("update_sparsity", -1.0),
    "activation drift": ("activation_drift", 1.0),
}
"""Metrics that may predict what a run forgets, by their names in a sentence; 1 if they rise with forgetting,
-1 if they fall."""

BOARDS = 10_000
"""Number of boards of equal methods that show how large a tau is by chance; no p is below 0.0001."""


@dataclass(frozen=True)
class Concordance:
    """Kendall's W: how alike the seeds of a board order its rows."""

    w: float
    """1 if all seeds have the same order, 0 if the sums of the ranks are equal."""
    chance: float
    """Probability of a W at least as large if each seed had a random order of the rows (Friedman's test)."""
    seeds: int
    """Number of seeds."""
    rows: int
    """Number of rows."""

    @property
    def certain(self) -> bool:
        """Whether chance is too unlikely to explain the agreement."""
        return self.chance < SIGNIFICANCE


@dataclass(frozen=True)
class RankCorrelation:
    """Kendall's tau between two orders of the rows, with its range over redrawn seeds."""

    tau: float
    """Kendall's tau: 1 for equal orders, -1 for opposite ones."""
    low: float
    """Lower end of the range that contains 95 % of the draws."""
    high: float
    """Upper end of the range."""
    rows: int
    """Number of rows."""
    chance: float
    """Probability of a tau at least as far from 0 by chance alone."""

    @property
    def direction(self) -> int:
        """1: the orders agree; -1: they are opposite; 0: chance or the seeds may explain it."""
        if self.chance >= SIGNIFICANCE or self.low <= 0 <= self.high:
            return 0
        return 1 if self.tau > 0 else -1


@dataclass(frozen=True)
class Prediction(RankCorrelation):
    """Kendall's tau between a predictor and forgetting over the methods; see `chance_among_equals`."""

    predictor: str
    """Name of the predictor in a sentence: a key of `PREDICTORS`."""


def kendall_tau(one: Array, other: Array) -> Array:
    """Return Kendall's tau-b between values (..., rows) and others of the same shape; NaN if all are equal.

    Pairs that are in the same order count 1, pairs in opposite orders -1, ties 0. The sum is divided by the
    geometric mean of the numbers of untied pairs: Kendall 1945, doi 10.2307/2332303.
    """
    first, second = np.triu_indices(one.shape[-1], 1)
    differences = (values[..., first] - values[..., second] for values in (one, other))
    signs, others = (np.where(np.abs(found) < TIE, 0.0, np.sign(found)) for found in differences)
    untied = np.sqrt(np.abs(signs).sum(axis=-1) * np.abs(others).sum(axis=-1))
    return np.asarray((signs * others).sum(axis=-1) / np.where(untied > 0, untied, np.nan))


def chance_of(one: Array, other: Array) -> float:
    """Return the two-sided p-value of Kendall's test that values (rows,) and others are unrelated.

    Without ties it is exact. With ties, SciPy has only the normal approximation: for 10 rows, this gave 0.11
    and 0.28 where 40,000 random orders gave 0.13 and 0.33. Random orders then stand in for all orders.
    """
    from scipy.stats import kendalltau, permutation_test  # a second, which reading a board does not need

    first, second = one.round(9), other.round(9)
    if len(np.unique(first)) == len(first) and len(np.unique(second)) == len(second):
        return float(kendalltau(first, second).pvalue)

    def tau(orders: Array, axis: int) -> Array:
        assert axis == -1
        return kendall_tau(orders, np.broadcast_to(second, orders.shape))

    test = permutation_test(
        (first,), tau, permutation_type="pairings", vectorized=True, n_resamples=ORDERS, axis=-1, rng=0
    )
    return float(test.pvalue)


def concordance(values: Array) -> Concordance | None:
    """Return how alike the seeds order the rows (Kendall, Babington Smith 1939, doi 10.1214/aoms/1177732186).

    Args:
        values: Value of each row and seed, (rows, seeds).

    Returns:
        None with too few rows or seeds, or if no seed orders the rows.
    """
    rows, seeds = values.shape
    rounded = values.round(9)  # values are quotients of whole numbers: equal ones may differ in the last bit
    if rows < LEAST_ROWS or seeds < LEAST_SEEDS or (rounded == rounded[0]).all():
        return None
    from scipy.stats import friedmanchisquare  # a second, which a small board does not need

    test = friedmanchisquare(*rounded)
    return Concordance(float(test.statistic) / (seeds * (rows - 1)), float(test.pvalue), seeds, rows)


def agreement_between(one: Array, other: Array, replicates: int = REPLICATES) -> RankCorrelation | None:
    """Return how far two boards of different runs agree on the order of the same rows.

    The range holds the percentiles of `replicates` pairs of boards whose seeds are drawn with replacement, in
    each board on its own; all rows share the draws, since seeds differ a lot. Two metrics of the same runs
    must not be compared like this: they share noise, which orders even equal methods alike.

    The range is not a confidence interval of the true tau. Redrawn seeds add noise to noisy means, which
    pulls tau towards 0: in simulations with 12 methods, the range contained the true tau on 47 to 86 % of the
    boards. `chance` is that of one board with the rows in a random order.

    Args:
        one: Value of each row and seed, (rows, seeds).
        other: The same for the other board, (rows, other seeds).
        replicates: Number of draws.

    Returns:
        None with too few rows or seeds, or if a board does not order the rows at all.
    """
    boards = (one, other)
    means = [board.mean(axis=1) for board in boards]
    tau = float(kendall_tau(*means))
    too_few = len(one) < LEAST_ROWS or min(board.shape[1] for board in boards) < LEAST_SEEDS
    if too_few or not np.isfinite(tau):
        return None
    generator = np.random.default_rng(0)
    draws = [generator.integers(board.shape[1], size=(replicates, board.shape[1])) for board in boards]
    drawn = [board[:, seeds].mean(axis=2).T for board, seeds in zip(boards, draws, strict=True)]
    low, high = np.nanpercentile(kendall_tau(*drawn), (2.5, 97.5))
    return RankCorrelation(tau, float(low), float(high), len(one), chance_of(*means))


# ---- predictors --------------------------------------------------------------------------------------------


def prediction_of(name: str, values: Array, replicates: int = REPLICATES) -> Prediction | None:
    """Return Kendall's tau between the means over seeds of a predictor and of forgetting.

    The range holds the percentiles of `replicates` draws of seeds with replacement. All rows and both
    quantities share the draws.

    Args:
        name: Name of the predictor.
        values: The predictor and forgetting by row and seed, (rows, seeds, 2).
        replicates: Number of draws.

    Returns:
        None if one of the two does not order the rows at all.
    """
    rows, seeds, _ = values.shape
    means = np.moveaxis(values.mean(axis=1), -1, 0)
    tau = float(kendall_tau(*means))
    if not np.isfinite(tau):
        return None
    draws = np.random.default_rng(0).integers(seeds, size=(replicates, seeds))
    drawn = values[:, draws].mean(axis=2)  # (rows, replicates, 2)
    low, high = np.nanpercentile(kendall_tau(drawn[..., 0].T, drawn[..., 1].T), (2.5, 97.5))
    return Prediction(tau, float(low), float(high), rows, chance_among_equals(tau, values), name)


def chance_among_equals(tau: float, values: Array, boards: int = BOARDS) -> float:
    """Return the probability of a tau at least as large, of either sign, if all methods were equal.

    Both quantities come from the same runs, so their noise correlates, and Kendall's own test finds an order
    among equal methods. Here the noise of a row is what remains without the means of rows and seeds. It
    is resampled by seed with replacement, for both quantities together.

    Args:
        tau: Kendall's tau of the board.
        values: The predictor and forgetting by row and seed, (rows, seeds, 2).
        boards: Number of boards of equal methods.
    """
    rows, seeds, _ = values.shape
    noise = values - values.mean(axis=1, keepdims=True)
    noise -= noise.mean(axis=0, keepdims=True)
    draws = np.random.default_rng(0).integers(seeds, size=(boards, rows, seeds))
    means = noise[np.arange(rows)[:, None], draws].mean(axis=2)  # (boards, rows, 2)
    taus = kendall_tau(means[..., 0], means[..., 1])
    taus = taus[np.isfinite(taus)]
    return float((1 + np.sum(np.abs(taus) >= abs(tau) - 1e-9)) / (1 + len(taus)))
