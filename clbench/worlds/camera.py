"""Cameras: the picture and the numbers that a policy sees of a world whose state it must not know.

The states of a task with a camera hold everything: experts act on them, questions are answered from them,
and pictures are drawn from them alone. A policy sees some of the numbers, and the picture. Demonstrations
therefore stay small datasets of states. A picture is drawn when it is needed: when a policy replans, and once
for each state of the demonstrations and the questions (`clbench.worlds.observation`).
"""

from __future__ import annotations

from typing import ClassVar, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import WrongTypeError
from clbench.worlds.world import States

Images: TypeAlias = NDArray[np.uint8]
Views: TypeAlias = NDArray[np.float32]
"""Perturbations of pictures (N, 4): azimuth, elevation and distance of the camera, and the light, from -1 to
1. They are 0 except in perturbed episodes (`clbench.worlds.perturbation`)."""

VIEW_SIZE = 4


class Camera(Protocol):
    """Draws the states of a world. The constructor has no arguments, and runs in a process that may draw."""

    image_size: ClassVar[int]
    """Width and height of a picture, in pixels."""
    state_size: ClassVar[int]
    """Number of values of a state that a policy sees."""

    @staticmethod
    def proprioception(states: States) -> States:
        """Return the part (N, `state_size`) of the states (N, S) that a policy sees as numbers."""
        ...

    @staticmethod
    def pictured(states: States) -> States:
        """Return numbers (N, K) that pictures of the states (N, S) show; vision learns to predict them.

        No policy sees these numbers.
        """
        ...

    def draw(self, states: States, views: Views) -> Images:
        """Return a picture of each of the states (N, S), (N, `image_size`, `image_size`, 3).

        A picture depends on its state and its view alone, not on earlier pictures.

        Args:
            states: States to draw, (N, S).
            views: Perturbation of each picture as shares of the camera's own scales, (N, 4).
        """
        ...


def load_camera(entry_point: str) -> type[Camera]:
    """Return the camera at "module:attribute".

    Raises:
        UnknownNameError: There is nothing at the entry point.
        WrongTypeError: The object lacks a member of a camera.
    """
    camera: type[Camera] = resolve(entry_point)
    members = [name for name in (*Camera.__annotations__, *vars(Camera)) if not name.startswith("_")]
    missing = [name for name in members if not hasattr(camera, name)]
    if missing:
        raise WrongTypeError(
            f"{entry_point} is no camera: it lacks {', '.join(missing)}. docs/guide/pixels.md shows one."
        )
    return camera
