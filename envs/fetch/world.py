"""The Fetch world as one Gymnasium environment: a robot arm, a table, a block and a target marker."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

from .rules import RULES
from .scene import CAMERA, scene
from .state import State
from .vector_world import FetchVectorWorld


class FetchWorld(gymnasium.Env[State, NDArray[np.float32]]):
    """A `FetchVectorWorld` of one lane, which says what states, actions and rewards are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector_world: ClassVar[type[FetchVectorWorld]] = FetchVectorWorld

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._world = self.vector_world(1)
        self.observation_space = self._world.single_observation_space
        self.action_space = self._world.single_action_space
        self._renderer: MujocoRenderer | None = None
        self._task = next(iter(RULES))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default the first.

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        task = (options or {}).get("task", next(iter(RULES)))
        state = self._world.reset([0], [seed], [task])[0]
        self._task = task
        return state, {"success": False, "task": task}

    def step(self, action: NDArray[np.float32]) -> tuple[State, float, bool, bool, dict[str, Any]]:
        """Move for one step of 0.04 s.

        Raises:
            ValueError: The action has another shape than (4,), or a number in it is not finite.
        """
        states, rewards, successes = self._world.step([0], np.asarray(action, np.float32)[None])
        success = bool(successes[0])
        return states[0], float(rewards[0]), success, False, {"success": success, "task": self._task}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3) of the scene if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        data = self._world.picture_data(0)
        if self._renderer is None:
            self._renderer = MujocoRenderer(scene().model, data, CAMERA, 480, 480)
        picture: NDArray[np.uint8] = self._renderer.render(self.render_mode)
        return picture

    def close(self) -> None:
        """Free the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()  # type: ignore[no-untyped-call]
            self._renderer = None
