"""The PointMaze world as one Gymnasium environment: a ball that is pushed through a maze."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from .mazes import GOALS
from .scene import camera
from .state import State
from .vector_world import PointMazeVectorWorld


class PointMazeWorld(gymnasium.Env[State, NDArray[np.float32]]):
    """A `PointMazeVectorWorld` of one lane, which says what states, actions and rewards are."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    vector_world = PointMazeVectorWorld

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._world = PointMazeVectorWorld(lanes=1)
        self.observation_space = self._world.single_observation_space
        self.action_space = self._world.single_action_space
        self._renderers: dict[mujoco.MjModel, mujoco.Renderer] = {}
        self._task = next(iter(GOALS))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default the first.

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        task = (options or {}).get("task", next(iter(GOALS)))
        state = self._world.reset([0], [seed], [task])[0]
        self._task = task
        return state, {"success": False, "task": task}

    def step(self, action: NDArray[np.float32]) -> tuple[State, float, bool, bool, dict[str, Any]]:
        """Move for one step of 0.1 s.

        Raises:
            ValueError: The action has another shape than (2,), or a number in it is not finite.
        """
        states, rewards, successes = self._world.step([0], np.asarray(action, np.float32)[None])
        success = bool(successes[0])
        return states[0], float(rewards[0]), success, False, {"success": success, "task": self._task}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3) of the maze from above if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
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
