"""Pictures of demonstrations from a simulator's own cameras: the episodes are played again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing

import numpy as np

from clbench.base.errors import InputError
from clbench.data.demonstrations import Demonstration
from clbench.evaluation.views import SimulatorCameras
from clbench.spec.task import Task
from clbench.worlds.camera import Images
from clbench.worlds.lanes import Lanes
from clbench.worlds.world import States


def drawn(
    task: Task, episodes: Sequence[Demonstration], cameras: SimulatorCameras
) -> Iterator[dict[str, Images]]:
    """Yield the pictures (T, N, N, 3) before each step of the episodes of a task, by camera.

    A dataset holds the numbers of a world's state, from which no scene can be drawn. So each episode begins
    again with its seed, and its actions are executed.

    Args:
        task: Task of the demonstrations.
        episodes: Demonstrations of the task's expert.
        cameras: Cameras of the simulator.

    Raises:
        InputError: A state differs from the demonstration's, so that the pictures would not show it.
        RenderingError: This machine cannot draw.
    """
    with closing(Lanes(1)) as lanes:
        for number, episode in enumerate(episodes):
            assert episode.seed is not None, "the expert's demonstrations have seeds"
            (state,) = lanes.reset([0], [episode.seed], [task])
            pictures = []
            for step, action in enumerate(episode.executed):
                _check_state(task, number, step, state, episode.state[step])
                pictures.append(cameras.draw(lanes, 0, task))
                (state,), _, _ = lanes.step([0], action[None])
            yield {name: np.stack([each[name] for each in pictures]) for name in cameras.names}


def _check_state(task: Task, number: int, step: int, found: States, expected: States) -> None:
    if not np.array_equal(found, expected):
        raise InputError(
            f"Demonstration {number} of {task.name} cannot be drawn: played again, it is in another state at "
            f"step {step}. If another machine collected its dataset, delete it, and collect it here."
        )
