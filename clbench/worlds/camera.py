"""Cameras: what a policy is shown of a world whose state it must not know.

The states of a task with a camera hold everything: experts act on them, questions are answered from them,
and pictures are drawn from them alone. A policy is shown a part of the numbers, and the picture. So
demonstrations stay small data sets of states, and a picture is drawn where it is looked at: when a policy
replans, and once for each state of the demonstrations and of the questions (`clbench.worlds.observation`).
"""

from __future__ import annotations

from typing import ClassVar, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import WrongTypeError

States: TypeAlias = NDArray[np.float32]
Images: TypeAlias = NDArray[np.uint8]
Views: TypeAlias = NDArray[np.float32]
"""How a picture is disturbed: the camera's azimuth, elevation and distance, and the light, from -1 to 1,
(N, 4). They are 0 but in perturbed episodes (`clbench.worlds.perturbation`)."""

VIEW_SIZE = 4


class Camera(Protocol):
    """Looks at the states of a world. Made without arguments in a process that may draw."""

    image_size: ClassVar[int]
    """Width and height of a picture, in pixels."""
    state_size: ClassVar[int]
    """How many numbers of a state a policy is shown."""

    @staticmethod
    def proprioception(states: States) -> States:
        """Return the part (N, `state_size`) of the states (N, S) that a policy is shown as numbers."""
        ...

    @staticmethod
    def pictured(states: States) -> States:
        """Return in numbers (N, K) what pictures of the states (N, S) show: eyes learn to tell it.

        No policy is shown these numbers.
        """
        ...

    def draw(self, states: States, views: Views) -> Images:
        """Return a picture of each of the states (N, S), (N, `image_size`, `image_size`, 3).

        A picture depends on its state and its view alone, not on those that were drawn before.

        Args:
            states: What is drawn.
            views: By what share of the camera's own scales each picture is disturbed, (N, 4).
        """
        ...


def load_camera(entry_point: str) -> type[Camera]:
    """Return the camera at "module:attribute".

    Raises:
        LookupError: There is none.
        TypeError: It lacks a member of a camera.
    """
    camera: type[Camera] = resolve(entry_point)
    members = [name for name in (*Camera.__annotations__, *vars(Camera)) if not name.startswith("_")]
    missing = [name for name in members if not hasattr(camera, name)]
    if missing:
        raise WrongTypeError(
            f"{entry_point} is no camera: it lacks {', '.join(missing)}. docs/guide/pixels.md shows one."
        )
    return camera
