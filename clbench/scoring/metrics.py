"""All metrics by name, and their values for a run."""

from __future__ import annotations

import math
from collections.abc import Mapping

from clbench.base.entry_points import unknown
from clbench.scoring import ours, published  # noqa: F401 - each enters its metrics into the registry
from clbench.scoring.metric import REGISTRY, Metric
from clbench.scoring.scores import Scores, rates_of

METRICS: Mapping[str, Metric] = REGISTRY
"""All metrics by name, in the order of the columns of leaderboard.csv."""

TITLES = {"adaptation": "learned", "retention": "kept skills"}
"""Titles of metrics on boards with a criterion, where they are beside `kept` and `kept_targets`."""


def load_metric(name: str) -> Metric:
    """Return the metric with this name, or with this title on the board.

    Raises:
        UnknownNameError: No metric has this name; the message names the nearest one.
    """
    names = {title.replace(" ", "_"): one for one, title in TITLES.items()}
    wanted = name.replace(" ", "_")
    wanted = names.get(wanted, wanted)
    if wanted not in METRICS:
        raise unknown("metric", name, METRICS)
    return METRICS[wanted]


def measure(name: str, scores: Scores, references: Mapping[str, Scores] | None = None) -> float | None:
    """Return the value of a metric for one run, None if something that it needs is missing.

    Args:
        name: Name of the metric.
        scores: The run.
        references: Runs of reference methods with the same scenario and seed, by the method's name.
    """
    rates = rates_of([scores], {key: [run] for key, run in (references or {}).items()})
    value = float(load_metric(name).over_runs(rates))
    return value if math.isfinite(value) else None
