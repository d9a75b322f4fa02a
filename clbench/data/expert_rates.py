"""Experts, measured: how often each succeeds at its task, and what its episodes return."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from clbench.base.entry_points import resolve
from clbench.base.seeding import derive_seed
from clbench.data.demonstrations import demonstrate
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.world import World

COLUMNS = ("task", "group", "success", "mean return", "lowest return", "mean steps")


@dataclass(frozen=True)
class Measurement:
    """What the expert of one task did."""

    task: str
    """Name of the task."""
    group: str
    """Which part of the scenario the task belongs to."""
    success: float
    """Share of the episodes that succeeded."""
    mean_return: float
    """Sum of an episode's rewards, on average."""
    lowest_return: float
    """Of the worst episode."""
    mean_steps: float
    """Steps until the end of an episode, on average."""

    @property
    def cells(self) -> tuple[str, ...]:
        """Return what stands in the columns of a table."""
        numbers = (f"{self.mean_return:.2f}", f"{self.lowest_return:.2f}", f"{self.mean_steps:.1f}")
        return (self.task, self.group.replace("_", " "), f"{self.success:.2f}", *numbers)


def measure(
    scenario: Scenario,
    tasks: Sequence[Task],
    episodes: int = 100,
    progress: Callable[[float], None] = lambda _: None,
) -> list[Measurement]:
    """Return what the expert of each task does in the same episodes at every call.

    Args:
        scenario: Where the tasks come from.
        tasks: Whose experts to measure.
        episodes: How many, of each task.
        progress: Called with the number of episodes done since its last call.
    """
    worlds: dict[str, World] = {}
    measured = []
    for task in tasks:
        if task.world not in worlds:
            worlds[task.world] = resolve(task.world)()
        successes, returns, steps = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes)
        for number in range(episodes):
            seed = derive_seed("expert measure", task.suite, task.name, number)
            episode = demonstrate(worlds[task.world], task, seed, noisy=False)
            successes[number], returns[number] = episode.success, episode.reward.sum()
            steps[number] = len(episode.reward)
            progress(1)
        row = (successes.mean(), returns.mean(), returns.min(), steps.mean())
        measured.append(Measurement(task.name, scenario.group(task.name), *map(float, row)))
    for world in worlds.values():
        world.close()
    return measured


def table(scenario: Scenario, rows: Sequence[Measurement], episodes: int) -> Table:
    """Return the measurements as a table of the terminal."""
    grid = Table(title=f"Experts of {scenario.id}, {episodes} episodes each")
    for number, column in enumerate(COLUMNS):
        grid.add_column(column, no_wrap=number == 0, justify="left" if number < 2 else "right")
    for row in rows:
        grid.add_row(*row.cells)
    return grid


def complaint(task: Task, row: Measurement) -> str | None:
    """Return what to do about an expert that fails more than it succeeds, or None."""
    if row.success >= 0.5:
        return None
    return (
        f"The expert of {task.name!r} succeeds in {row.success:.0%} of its episodes: no demonstrations can "
        f"be collected of it. Mend {task.expert} or the success rule; train it longer where it was trained."
    )
