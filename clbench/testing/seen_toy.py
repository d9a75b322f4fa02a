"""The toy as a camera sees it: how high the point is, and where the marker lies, only the picture shows.

The camera needs no graphics: what policies are shown can be tried where nothing draws. Ask for it as
"clbench.testing.seen_toy:clbench/SeenToy-v0".
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
from gymnasium.envs.registration import register

from clbench.camera import Images, States
from clbench.task import Task
from clbench.testing.toy import TOY

REACH = 2.5
"""How far from the middle the picture reaches, in the units of the toy."""


class ToyCamera:
    """Draws the point as a red blob and the marker as a green one."""

    image_size: ClassVar[int] = 16
    state_size: ClassVar[int] = 1

    @staticmethod
    def proprioception(states: States) -> States:
        """Return how far right the point is, (N, 1)."""
        return states[:, :1]

    def draw(self, states: States) -> Images:
        """Return pictures (N, 16, 16, 3); up is where it is in the plane."""
        centres = np.linspace(-REACH, REACH, self.image_size)
        images = np.zeros((len(states), self.image_size, self.image_size, 3), np.uint8)
        for channel, thing in enumerate((states[:, :2], states[:, 2:4])):
            right = np.exp(-(((centres - thing[:, :1]) / 0.4) ** 2))
            up = np.exp(-(((centres[::-1] - thing[:, 1:]) / 0.4) ** 2))
            images[..., channel] = np.round(255 * up[:, :, None] * right[:, None, :])
        return images


def _seen(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
    camera = "clbench.testing.seen_toy:ToyCamera"
    return tuple(dataclasses.replace(task, suite="seen-toy", camera=camera) for task in tasks)


SEEN_TOY = dataclasses.replace(
    TOY,
    id="clbench/SeenToy-v0",
    description="A point on a plane, seen through a camera; for tests.",
    retained=_seen(TOY.retained),
    target=_seen(TOY.target),
    held_out=_seen(TOY.held_out),
)

register(
    id=SEEN_TOY.id,
    entry_point="clbench.scenario_env:ScenarioEnv",
    vector_entry_point="clbench.scenario_vector_env:ScenarioVectorEnv",
    kwargs={"scenario": "clbench.testing.seen_toy:SEEN_TOY"},
)
