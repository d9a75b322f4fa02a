"""The Meta-World world as one Gymnasium environment: a robot arm, a table and what stands on it."""

from __future__ import annotations

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

from clbench.worlds.world import OneLaneWorld

from .vector_world import MetaWorldVectorWorld

CAMERA = {"distance": 1.4, "azimuth": 135.0, "elevation": -30.0, "lookat": np.array([0.0, 0.6, 0.15])}
"""From the front left, above the table."""


class MetaWorldWorld(OneLaneWorld):
    """A `MetaWorldVectorWorld` of one lane, which says what states, actions and rewards are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 80}  # noqa: RUF012
    vector_world = MetaWorldVectorWorld
    first_task = "drawer_open"

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self._renderer: MujocoRenderer | None = None
        self._drawn: mujoco.MjData | None = None

    def picture(self) -> NDArray[np.uint8]:
        """Draw the scene, (480, 480, 3)."""
        model, data = self._world.picture_of(0)
        if self._renderer is None or self._drawn is not data:
            self.close()
            self._renderer, self._drawn = MujocoRenderer(model, data, CAMERA, 480, 480), data
        picture: NDArray[np.uint8] = self._renderer.render("rgb_array")
        return picture

    def close(self) -> None:
        """Free the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()  # type: ignore[no-untyped-call]
            self._renderer = None
