"""The pixel scenario: the tasks of the Fetch scenario, of which a policy sees a camera's picture."""

from __future__ import annotations

import dataclasses

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

from . import SCENARIO as FETCH

__all__ = ["SCENARIO"]


def _seen(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
    """Return the tasks with the pixel scenario's world, where no target hangs in the air, and its camera."""
    return tuple(
        dataclasses.replace(
            task,
            suite="fetch-pixels",
            world="clbench.envs.fetch.pixel_world:FetchPixelsWorld",
            camera="clbench.envs.fetch.camera:FetchCamera",
        )
        for task in tasks
    )


SCENARIO = Scenario(
    id="clbench/FetchPixels-v0",
    description="The tasks of Fetch, seen in a picture: only the robot itself is known in numbers.",
    retained=_seen(FETCH.retained),
    target=_seen(FETCH.target),
    held_out=_seen(FETCH.held_out),
    questions="clbench.envs.fetch.pixel_questions:PIXEL_QUESTIONS",
    budget=Budget(demonstrations=500, question_episodes=1200, pretraining_steps=4000),
)
"""The sequence of `clbench/Fetch-v0`; nothing tells a policy where block and target are but the picture."""
