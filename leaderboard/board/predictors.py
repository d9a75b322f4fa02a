"""Predictors of forgetting: how well each orders the methods by what they forget."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from clbench.scoring.layout import Array

from .agreement import LEAST_ROWS, LEAST_SEEDS, REPLICATES, Agreement, kendall_tau
from .rows import Row, values_by_seed

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
class Prediction(Agreement):
    """Kendall's tau between a predictor and forgetting over the methods, with its range over drawn seeds."""

    predictor: str
    """Name of the predictor in a sentence: a key of `PREDICTORS`."""


def predictions(rows: Iterable[Row]) -> list[Prediction]:
    """Return how well each predictor orders the competing rows of a scenario as forgetting does.

    The seeds are the baseline's. A row without one of them, or without a value, is left out.
    """
    to_criterion = [row for row in rows if row.to_criterion]
    kept = values_by_seed(to_criterion, "kept_share")
    found = []
    for name, (metric, sign) in PREDICTORS.items():
        values = values_by_seed(to_criterion, metric)
        pairs = np.array([np.transpose([values[one], kept[one]]) for one in values if one in kept])
        if len(pairs) >= LEAST_ROWS and pairs.shape[1] >= LEAST_SEEDS:
            found.append(prediction_of(name, pairs * (sign, -1.0)))
    return [one for one in found if one is not None]


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
    return Prediction(tau, float(low), float(high), seeds, rows, chance_among_equals(tau, values), name)


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
