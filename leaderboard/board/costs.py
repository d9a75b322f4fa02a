"""The costs of a method, from its records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from clbench.spec.references import BASELINE

from .runs import Run, is_number
from .summary import COSTS


def step_ratio(run: Run) -> float | None:
    """Return the time of a step of a run divided by plain fine-tuning's, None if it was not measured."""
    if run.method == BASELINE:
        return 1.0
    value: Any = run.record.timing.get("step_ratio")
    return float(value) if is_number(value) and value > 0 else None


def costs_of(runs: Sequence[Run], baseline: Sequence[Run]) -> dict[str, float | None]:
    """Return the costs of the runs of a method, each a mean over seeds.

    `relative_cost` is the time of all optimiser steps, preparation included, divided by the baseline's: the
    ratio of the steps times the ratio of the time of one, which each run measures on its own machine. It is
    None where no run measured it, unless the method takes no steps.

    Args:
        runs: Runs of the method.
        baseline: Runs of plain fine-tuning on the same scenario; may be empty. Those with the seeds of `runs`
            count: without one of them the relative cost is None.
    """
    costs = {column: _mean(runs, name) for column, name in COSTS.items()}
    seeds = {run.seed for run in runs}
    same = [run for run in baseline if run.seed in seeds]
    steps, usual = costs["steps"], _mean(same, "optimiser_steps") if len(same) == len(seeds) else None
    times = [ratio for run in runs if (ratio := step_ratio(run)) is not None]
    relative = None
    if steps == 0:
        relative = 0.0
    elif steps is not None and usual and times:
        relative = steps / usual * math.fsum(times) / len(times)
    return {"relative_cost": relative, **costs}


def _mean(runs: Sequence[Run], name: str) -> float | None:
    """Return the mean of a cost over runs, None if a run does not state it."""
    values = [getattr(run.record.costs, name) for run in runs]
    numbers = [value for value in values if value is not None and is_number(value)]
    return math.fsum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else None
