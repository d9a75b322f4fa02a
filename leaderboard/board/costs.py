"""What a method costs, beside plain fine-tuning."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from clbench.scoring.intervals import Estimate

from .runs import Run, is_number

STEP_TIME = Path("benchmarks/results/step_time.json")
"""What the speed benchmark left, seen from the working directory."""


COSTS = {
    "steps": "optimiser_steps",
    "bytes_kept": "bytes_kept",
    "parameters": "parameters",
    "parameters_added": "parameters_added",
    "environment_steps": "environment_steps",
}
"""Column of the table, and where a record's costs have it."""


def step_time_of(records: Path) -> Path:
    """Return where it lies, seen from a folder of records: the same wherever the table is drawn."""
    return records.resolve().parents[1] / STEP_TIME


def read_step_times(path: Path) -> dict[str, Estimate]:
    """Return the time of a step divided by that of sft, by method; none if the file is not there or torn."""
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
    """Return what the runs of a method cost, each a mean over seeds.

    `relative_cost` is the time of all its optimiser steps, those of its preparation included, divided by that
    of sft: steps from the records, the time of one from the speed benchmark.

    Args:
        runs: The runs of the method.
        baseline: Those of sft on the same scenario; there may be none.
        times: Time of a step divided by that of sft, by method.
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
    """Return the mean of a cost, None if a run does not say it as a number."""
    values = [run.record.costs.get(name) for run in runs]
    numbers = [value for value in values if value is not None and is_number(value)]
    return math.fsum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else None
