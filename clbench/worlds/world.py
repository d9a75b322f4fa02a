"""Worlds: the interface of one episode, and of many side by side."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.errors import InputError

World = gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]

States: TypeAlias = NDArray[np.float32]
"""States of N lanes, (N, S)."""
Outcomes: TypeAlias = tuple[States, NDArray[np.float64], NDArray[np.bool_]]
"""What a step led to in N lanes: states (N, S), rewards (N,), and which episodes succeeded (N,)."""


class VectorWorld(Protocol):
    """Many episodes of one world side by side, each in a lane.

    A suite has its own where stepping many episodes together is faster than one after the other: the
    attribute `vector_world` of its world makes it, from the number of lanes and of threads. Each episode is
    bit for bit that of the plain world, whatever the other lanes do. Who uses it resets a lane before
    stepping it, counts the steps, and lets a lane rest once its episode has succeeded.

    A world can be perturbed if what makes it takes `perturbed` besides, the vector world or, where there is
    none, the plain world. Its episodes are then disturbed as `clbench.worlds.perturbation.draw_perturbation` says.
    """

    single_observation_space: spaces.Box
    """Of the state in one lane."""
    single_action_space: spaces.Box

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> States:
        """Start an episode of a task in each of `lanes`, and return the states."""
        ...

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Move each of `lanes`, none twice, by its row of actions (N, A)."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class OneLaneWorld(World, ABC):
    """A suite's own vector world with one lane, as the plain world: one physics serves both.

    A suite names its vector world and its first task, and draws the picture in `picture`; its metadata say
    how many steps a second has.

    Args:
        render_mode: "rgb_array", or None to draw nothing.
    """

    vector_world: ClassVar[Callable[[int, int], Any]]
    """Makes the vector world, from the number of lanes and of threads."""
    first_task: ClassVar[str]
    """What `reset` starts if no task is asked for."""

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._world = type(self).vector_world(1, 1)
        self.observation_space = self._world.single_observation_space
        self.action_space = self._world.single_action_space
        self._task = self.first_task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[States, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default of the first, and return the state (S,).

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        task = (options or {}).get("task", self.first_task)
        state = self._world.reset([0], [seed], [task])[0]
        self._task = task
        return state, {"success": False, "task": task}

    def step(self, action: NDArray[np.float32]) -> tuple[States, float, bool, bool, dict[str, Any]]:
        """Move for one step.

        Raises:
            ValueError: The action has another shape than the action space, or a number in it is not finite.
        """
        states, rewards, successes = self._world.step([0], np.asarray(action, np.float32)[None])
        success = bool(successes[0])
        return (states[0], float(rewards[0]), success, False, {"success": success, "task": self._task})

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3) if the render mode is "rgb_array"."""
        return None if self.render_mode is None else self.picture()

    @abstractmethod
    def picture(self) -> NDArray[np.uint8]:
        """Draw the scene, (480, 480, 3)."""


def checked_actions(actions: NDArray[np.float32], space: spaces.Box, world: str) -> NDArray[np.float32]:
    """Return actions (N, A) within the bounds of the action space of a world.

    Raises:
        ValueError: An action has another shape than the space, or a number in it is not finite.
    """
    actions = np.asarray(actions, np.float32)
    if actions.shape[1:] != space.shape:
        raise InputError(f"An action of the {world} world has shape {space.shape}, not {actions.shape[1:]}.")
    finite = np.isfinite(actions)
    if not finite.all():
        wrong = actions[~finite.all(axis=1)][0]
        raise InputError(f"An action of the {world} world is finite, not {wrong.tolist()}.")
    return np.minimum(np.maximum(actions, space.low), space.high)


def no_episode(lane: int, world: str) -> gymnasium.error.ResetNeeded:
    """Return the error for a lane that is used before its first episode."""
    return gymnasium.error.ResetNeeded(f"Lane {lane} of the {world} world has no episode: reset it.")
