"""The scenario clbench/FetchPixels-v0: the tasks of clbench/Fetch-v0, seen in camera pictures."""

from __future__ import annotations

import dataclasses

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

from .scenario import SCENARIO as FETCH


def _seen(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
    """Return the tasks with the pixel world, where every target is on the table, and with its camera."""
    return tuple(
        dataclasses.replace(
            task,
            suite="fetch_pixels",
            seed_name="fetch-pixels",
            world="clbench.envs.fetch.pixel_world:FetchPixelsWorld",
            camera="clbench.envs.fetch.camera:FetchCamera",
        )
        for task in tasks
    )


SCENARIO = Scenario(
    id="clbench/FetchPixels-v0",
    description="The tasks of Fetch, seen by a camera: a policy gets numbers about the robot itself only.",
    retained=_seen(FETCH.retained),
    target=_seen(FETCH.target),
    held_out=_seen(FETCH.held_out),
    questions="clbench.envs.fetch.pixel_questions:PIXEL_QUESTIONS",
    budget=Budget(demonstrations=500, question_episodes=1200, pretraining_steps=4000),
)
"""The sequence of clbench/Fetch-v0; only the picture shows a policy where the block and the target are."""
