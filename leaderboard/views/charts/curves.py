"""Curves of a run with their intervals: success on the targets and on the old skills."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache

import numpy as np

from clbench.scoring.intervals import Estimate, draw_episodes, mean_of_seeds
from clbench.scoring.layout import Array, average
from clbench.scoring.rates import Rates
from clbench.scoring.scores import Scores

REPLICATES = 300
"""Bootstrap draws of episodes: with 2000, the ends move by less than the width of a line."""

Curve = Callable[[Rates], Array]
"""Maps rates with batch axes (...) to the points of a curve, (..., points)."""


def retained_curve(rates: Rates) -> Array:
    """Return the mean success on the retained skills, before the first step and at every point."""
    points = average(rates.retained_curves)
    before = average(rates.retained[..., :1, :])
    return np.concatenate([before, points.reshape(*points.shape[:-2], -1)], axis=-1)


def target_curves(rates: Rates) -> Array:
    """Return the success on target k before the first step of stage k and at its points."""
    points = np.concatenate([rates.starts[..., None], rates.learning_curves], axis=-1)
    return points.reshape(*points.shape[:-2], -1)


def estimated(
    curves: Mapping[str, Curve], runs: Sequence[Scores], generator: np.random.Generator
) -> dict[str, list[Estimate]]:
    """Return the points of `curves`, means over `runs`, with intervals as in `clbench.scoring.intervals`.

    Where an interval is over episodes, all points of all curves share the same draws.
    """

    @cache
    def with_other_episodes() -> list[Rates]:
        layout = runs[0].layout
        shape, episodes = (REPLICATES, len(layout.tasks)), len(layout.episodes)
        return [run.rates(draw_episodes(shape, episodes, generator)) for run in runs]

    found = {}
    for name, curve in curves.items():
        each = np.stack([curve(run.rates()) for run in runs])
        drawn = cache(lambda curve=curve: np.mean([curve(rates) for rates in with_other_episodes()], axis=0))
        found[name] = [_estimate(values, point, drawn) for point, values in enumerate(each.T)]
    return found


def _estimate(values: Array, point: int, drawn: Callable[[], Array]) -> Estimate:
    """Return a point of a curve, given its value for each run and all points with redrawn episodes."""
    return mean_of_seeds(values.tolist(), (0.0, 1.0), lambda: drawn()[:, point])
