"""The command `clbench experts measure`."""

from __future__ import annotations

import sys

from rich.console import Console

from clbench.cli.arguments import at_least, checked_input
from clbench.data.expert_rates import complaint, table
from clbench.data.expert_rates import measure as measure_experts
from clbench.jobs.bars import Bars
from clbench.spec.registry import load_scenario


def measure(scenario: str, /, *tasks: str, episodes: int = 100) -> None:
    """Measure the experts of SCENARIO, or of its TASKS alone: their success and what their episodes return.

    Args:
        scenario: Gymnasium id of the scenario.
        tasks: Names of tasks; all of the scenario if not given.
        episodes: How many of each task.
    """
    with checked_input():
        at_least(1, "--episodes", episodes)
        loaded = load_scenario(scenario)
        chosen = [loaded.task(name) for name in tasks] or list(loaded.tasks)
    with Bars(len(chosen) * episodes) as bars:
        bars.start(loaded.id, len(chosen) * episodes)
        rows = measure_experts(loaded, chosen, episodes, lambda done: bars.advance(loaded.id, done))
    Console().print(table(loaded, rows, episodes))
    complaints = [text for task, row in zip(chosen, rows, strict=True) if (text := complaint(task, row))]
    for text in complaints:
        Console(stderr=True).print(text, style="bold red", highlight=False, markup=False, soft_wrap=True)
    if complaints:
        sys.exit(1)
