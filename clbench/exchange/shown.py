"""The content of a dataset for other libraries: what a policy sees in a demonstration, and its actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from clbench.base.errors import InputError
from clbench.data.demonstrations import Demonstration
from clbench.evaluation.views import SimulatorCameras
from clbench.exchange.replayed import drawn
from clbench.spec.task import Task
from clbench.worlds.camera import Images
from clbench.worlds.lanes import control_rate
from clbench.worlds.observation import observed
from clbench.worlds.world import States


@dataclass(frozen=True)
class Shown:
    """An episode of T steps with the observations of a policy."""

    episode: Demonstration
    """The demonstration."""
    state: States
    """Numbers that a policy sees before each step, (T, P)."""
    image: Images
    """Pictures that a policy sees before each step, (T, N, N, 3); N is 0 without a camera."""
    pictures: dict[str, Images]
    """Pictures before each step, (T, N, N, 3), of each of the simulator's cameras that were asked for."""


def shown(
    task: Task, episodes: Sequence[Demonstration], cameras: SimulatorCameras | None = None
) -> Iterator[Shown]:
    """Yield the episodes of a task with the observations of a policy.

    Args:
        task: Task of the demonstrations.
        episodes: The demonstrations, in the order of their dataset.
        cameras: Cameras of the simulator whose pictures to add; None adds none.

    Raises:
        InputError: An episode cannot be played again for the pictures of `cameras`.
        RenderingError: The task has a camera or `cameras` are given, and this machine cannot draw.
    """
    state, image = observed(task, np.concatenate([episode.state[:-1] for episode in episodes]))
    ends = np.cumsum([len(episode.executed) for episode in episodes])
    starts = [0, *ends[:-1]]
    pictures = ({} for _ in episodes) if cameras is None else drawn(task, episodes, cameras)
    for episode, start, end, seen in zip(episodes, starts, ends, pictures, strict=True):
        yield Shown(episode, state[start:end], image[start:end], seen)


def steps_per_second(task: Task) -> float:
    """Return the control rate of a task in its world.

    Raises:
        InputError: The world gives no rate.
    """
    rate = control_rate(task)
    if rate is None:
        raise InputError(
            f"The world {task.world} of the task {task.name} does not give its steps per second, which a "
            'data set holds: add them to its class, for example metadata = {"render_fps": 25}.'
        )
    return rate
