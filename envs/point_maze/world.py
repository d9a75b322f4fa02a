"""The PointMaze world as one Gymnasium environment: a ball that is pushed through a maze."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.world import OneLaneWorld

from .mazes import GOALS
from .scene import camera
from .vector_world import PointMazeVectorWorld


class PointMazeWorld(OneLaneWorld):
    """A `PointMazeVectorWorld` of one lane, which says what states, actions and rewards are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    vector_world = PointMazeVectorWorld
    first_task = next(iter(GOALS))

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self._renderers: dict[mujoco.MjModel, mujoco.Renderer] = {}

    def picture(self) -> NDArray[np.uint8]:
        """Draw the maze from above, (480, 480, 3)."""
        model, data = self._world.picture_data(0)
        if model not in self._renderers:
            self._renderers[model] = mujoco.Renderer(model, 480, 480)
        renderer = self._renderers[model]
        renderer.update_scene(data, camera())
        picture: NDArray[np.uint8] = renderer.render()
        return picture

    def close(self) -> None:
        """Free the renderers."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
