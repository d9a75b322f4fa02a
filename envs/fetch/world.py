"""The Fetch world as one Gymnasium environment: a robot arm, a table, a block and a target marker."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

from clbench.worlds.world import OneLaneWorld

from .rules import RULES
from .scene import CAMERA, scene
from .vector_world import FetchVectorWorld


class FetchWorld(OneLaneWorld):
    """A `FetchVectorWorld` of one lane, which says what states, actions and rewards are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector_world: ClassVar[type[FetchVectorWorld]] = FetchVectorWorld
    first_task = next(iter(RULES))

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self._renderer: MujocoRenderer | None = None

    def picture(self) -> NDArray[np.uint8]:
        """Draw the scene, (480, 480, 3)."""
        data = self._world.picture_data(0)
        if self._renderer is None:
            self._renderer = MujocoRenderer(scene().model, data, CAMERA, 480, 480)
        picture: NDArray[np.uint8] = self._renderer.render("rgb_array")
        return picture

    def close(self) -> None:
        """Free the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()  # type: ignore[no-untyped-call]
            self._renderer = None
