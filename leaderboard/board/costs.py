"""The costs of a method: from its records, and from the speed benchmark for the time of a step.

All but `relative_cost` is made from the records alone.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from clbench.scoring.intervals import Estimate

from .places import STEP_TIME
from .runs import Run, is_number

COSTS = {
    "steps": "optimiser_steps",
    "bytes_kept": "bytes_kept",
    "parameters": "parameters",
    "parameters_added": "parameters_added",
    "environment_steps": "environment_steps",
}
"""Fields of `Record.costs` by column of the table."""


def step_time_of(records: Path) -> Path:
    """Return the path of the benchmark's result for a folder of records, from any working directory."""
    return records.resolve().parents[1] / STEP_TIME


def read_step_times(path: Path) -> dict[str, Estimate]:
    """Return the time of a step over the baseline's, by method; empty if the file is missing or torn."""
    try:
        ratios = json.loads(path.read_text(encoding="utf-8"))["ratios"]
        found = {
            method: tuple(entry.get(key) for key in ("median_ratio", "low", "high"))
            for method, entry in ratios.items()
        }
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return {}
    return {
        method: Estimate(*(value if is_number(value) else None for value in values))
        for method, values in found.items()
        if is_number(values[0])
    }


def costs_of(
    runs: Sequence[Run], baseline: Sequence[Run], times: Mapping[str, Estimate]
) -> dict[str, float | None]:
    """Return the costs of the runs of a method, each a mean over seeds.

    `relative_cost` is the time of all optimiser steps, preparation included, divided by the baseline's. The
    number of steps comes from the records, the time of one step from the speed benchmark. Without a result of
    that benchmark `relative_cost` is None, unless the method takes no steps.

    Args:
        runs: Runs of the method.
        baseline: Runs of plain fine-tuning on the same scenario; may be empty.
        times: Time of a step divided by the baseline's, by method.
    """
    costs = {column: _mean(runs, name) for column, name in COSTS.items()}
    steps, usual = costs["steps"], _mean(baseline, "optimiser_steps")
    time = times.get(runs[0].method, Estimate(None, None, None)).value
    relative = None
    if steps == 0:
        relative = 0.0
    elif steps is not None and usual and time is not None:
        relative = steps / usual * time
    return {"relative_cost": relative, **costs}


def _mean(runs: Sequence[Run], name: str) -> float | None:
    """Return the mean of a cost over runs, None if a run does not state it."""
    values = [getattr(run.record.costs, name) for run in runs]
    numbers = [value for value in values if value is not None and is_number(value)]
    return math.fsum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else None
