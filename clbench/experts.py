"""Experts, measured: how often each succeeds at its task, and the page that says so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from clbench.demonstrations import demonstrate
from clbench.seeding import derive_seed
from clbench.task import Scenario, Task, resolve
from clbench.world import World

COLUMNS = ("task", "group", "success", "mean return", "lowest return", "mean steps")

_HEAD = """# Experts

What demonstrates each task, measured undisturbed on episodes that are used for nothing else: the share that
succeeded, and what they returned. Each section is made again, with the same bytes, by the command below it.
"""


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
            episode = demonstrate(worlds[task.world], task, seed, disturb=False)
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


def write_page(path: Path, scenario: Scenario, rows: Sequence[Measurement], episodes: int) -> None:
    """Put the section of a scenario into a page such as docs/experts.md, and leave the others as they are."""
    sections = {scenario.id: _section(scenario, rows, episodes)}
    if path.exists():
        for section in path.read_text(encoding="utf-8").split("\n## ")[1:]:
            sections.setdefault(section.partition("\n")[0], f"## {section.rstrip()}\n")
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "\n".join([_HEAD, *(sections[name] for name in sorted(sections))])
    path.write_text(text, encoding="utf-8", newline="\n")


def _section(scenario: Scenario, rows: Sequence[Measurement], episodes: int) -> str:
    grid = [COLUMNS, ("---", "---", *["---:"] * (len(COLUMNS) - 2)), *(row.cells for row in rows)]
    lines = [f"## {scenario.id}", "", *("| " + " | ".join(row) + " |" for row in grid), ""]
    lines.append(
        f"    clbench experts measure {scenario.id} --episodes {episodes} --markdown docs/experts.md"
    )
    return "\n".join(lines) + "\n"
