"""The costs of a method, from its records."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from clbench.scoring.reading import is_number
from clbench.spec.references import BASELINE

from .runs import Run
from .summary import COSTS, mean_of


def step_ratio(run: Run) -> float | None:
    """Return the time of a step of a run divided by plain fine-tuning's, None if it was not measured."""
    if run.label == BASELINE:
        return 1.0
    value: Any = run.record.timing.get("step_ratio")
    return float(value) if is_number(value) and value > 0 else None


def mean_step_ratio(runs: Sequence[Run]) -> float | None:
    """Return the geometric mean of `step_ratio` over the runs that measured it, None if none did."""
    known = [ratio for ratio in map(step_ratio, runs) if ratio is not None]
    return statistics.geometric_mean(known) if known else None


def costs_of(runs: Sequence[Run], baseline: Sequence[Run]) -> dict[str, float | None]:
    """Return the costs of the runs of a method, each a mean over seeds.

    `relative_cost` is the time of all optimiser steps, preparation included, divided by the baseline's: the
    ratio of the steps times the ratio of the time of a step, which each run measures on its own machine. It
    is None where no run measured it, unless the method takes no steps.

    Args:
        runs: Runs of the method.
        baseline: Runs of plain fine-tuning on the same scenario; may be empty. The relative cost compares the
            seeds that both have; it is None if there are none.
    """
    costs = {column: _mean(runs, name) for column, name in COSTS.items()}
    common = {run.seed for run in runs} & {run.seed for run in baseline}
    same, usual = ([run for run in members if run.seed in common] for members in (runs, baseline))
    taken, theirs = (_mean(members, "optimiser_steps") for members in (same, usual))
    step = mean_step_ratio(same)
    relative = None
    if costs["steps"] == 0:
        relative = 0.0
    elif taken is not None and theirs and step is not None:
        relative = taken / theirs * step
    return {"relative_cost": relative, **costs}


def _mean(runs: Sequence[Run], name: str) -> float | None:
    """Return the mean of a cost over runs, None if a run does not state it."""
    values = [getattr(run.record.costs, name) for run in runs]
    return mean_of(values) if all(map(is_number, values)) else None
