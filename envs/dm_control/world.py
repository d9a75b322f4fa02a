"""The dm_control world as one Gymnasium environment: a body, its target, and a return to reach."""

from __future__ import annotations

import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

from clbench.worlds.world import OneLaneWorld

from .rules import RULES
from .vector_world import DMControlVectorWorld


class DMControlWorld(OneLaneWorld):
    """A `DMControlVectorWorld` of one lane, which says what states, actions and rewards are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector_world = DMControlVectorWorld
    first_task = next(iter(RULES))

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self._renderers: dict[mujoco.MjModel, MujocoRenderer] = {}

    def picture(self) -> NDArray[np.uint8]:
        """Draw the body, (480, 480, 3)."""
        model, data, camera = self._world.picture(0)
        if model not in self._renderers:
            self._renderers[model] = MujocoRenderer(model, data, camera, 480, 480)
        picture: NDArray[np.uint8] = self._renderers[model].render("rgb_array")
        return picture

    def close(self) -> None:
        """Free the renderers."""
        for renderer in self._renderers.values():
            renderer.close()  # type: ignore[no-untyped-call]
        self._renderers.clear()
