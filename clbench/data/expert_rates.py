"""Success rates and returns of experts, measured in episodes of their tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import derive_seed
from clbench.data.demonstrations import demonstrate
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.world import opened_worlds


@dataclass(frozen=True)
class Measurement:
    """Success rate and returns of the expert of one task."""

    task: str
    """Name of the task."""
    group: str
    """Part of the scenario that the task belongs to, see `Scenario.group`."""
    success: float
    """Share of the episodes that succeeded, from 0 to 1."""
    mean_return: float
    """Mean over the episodes of the sum of rewards."""
    lowest_return: float
    """Sum of rewards of the worst episode."""
    mean_steps: float
    """Mean length of an episode in steps."""


def measure(
    scenario: Scenario,
    tasks: Sequence[Task],
    episodes: int = 100,
    progress: ProgressCallback = no_progress,
) -> list[Measurement]:
    """Measure the expert of each task; every call plays the same episodes.

    Args:
        scenario: Scenario of the tasks.
        tasks: Tasks whose experts are measured.
        episodes: Episodes per task.
        progress: Called with the number of episodes done since its last call.
    """
    measured = []
    with opened_worlds() as world:
        for task in tasks:
            successes, returns, steps = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes)
            for number in range(episodes):
                seed = derive_seed("expert measure", task.seed_suite, task.name, number)
                episode = demonstrate(world(task), task, seed, noisy=False)
                successes[number], returns[number] = episode.success, episode.reward.sum()
                steps[number] = len(episode.reward)
                progress(1)
            row = (successes.mean(), returns.mean(), returns.min(), steps.mean())
            measured.append(Measurement(task.name, scenario.group(task.name), *map(float, row)))
    return measured


def complaint(task: Task, row: Measurement) -> str | None:
    """Return a message about an expert that fails more often than it succeeds, None for any other."""
    if row.success >= 0.5:
        return None
    return (
        f"The expert of {task.name!r} succeeds in {row.success:.0%} of its episodes: clbench cannot "
        f"collect demonstrations from it. Fix {task.expert} or the success rule; if the expert was trained, "
        "train it longer."
    )
