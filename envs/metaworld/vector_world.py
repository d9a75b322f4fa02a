"""The physics of the Meta-World world: many episodes side by side, of any tasks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import TypeAlias

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.perturbation import draw_perturbation
from clbench.world import checked_actions, no_episode

from .episode import Episode, new_episode
from .state import SIZE, State

_Kind: TypeAlias = tuple[str, float | None]
"""A task, and how many times as heavy its things are if they are perturbed: what a place for episodes is made
for."""


class MetaWorldVectorWorld:
    """Meta-World's tasks with their own physics, observations, rewards and rules of success, bit for bit.

    An action (4,) in [-1, 1] moves the hand by up to 1 cm along x, y and z, and closes (+1) or opens (-1) the
    fingers; a step takes 0.0125 s. The state is Meta-World's observation with the goal in it, the reward its
    own from 0 to 10. An episode ends with success only; whoever uses the world counts its steps. It is a
    `clbench.world.VectorWorld`.

    Args:
        lanes: Places for episodes. A task's scene is compiled when it is first reset to.
        threads: Not used: an episode has its own physics, but shares the model, in which things stand where
            they stand in one episode at a time.
        perturbed: Whether things are heavier or lighter, and the hand starts elsewhere.
    """

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._perturbed = perturbed
        self._lanes: list[tuple[_Kind, Episode] | None] = [None] * lanes
        self._idle: defaultdict[_Kind, list[Episode]] = defaultdict(list)

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 39); all follows from the seed alone.

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        return np.stack([self._begin(*start) for start in zip(lanes, seeds, tasks, strict=True)])

    def _begin(self, lane: int, seed: int, task: str) -> State:
        perturbation = draw_perturbation(seed) if self._perturbed else None
        kind = task, perturbation.mass if perturbation else None
        episode = self._idle[kind].pop() if self._idle[kind] else new_episode(*kind)
        before = self._lanes[lane]
        if before is not None:
            self._idle[before[0]].append(before[1])
        self._lanes[lane] = kind, episode
        return episode.begin(seed, perturbation.start if perturbation else None)

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Move each of `lanes` for one step of 0.0125 s by its row of actions (N, 4).

        Returns the states (N, 39), the rewards (N,) and which of the episodes succeeded (N,).

        Raises:
            ValueError: An action has another shape than (4,), or a number in it is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "Meta-World")
        outcomes = [self._episode(lane).advance(action) for lane, action in zip(lanes, actions, strict=True)]
        states, rewards, successes = zip(*outcomes, strict=True)
        return np.stack(states), np.array(rewards), np.array(successes)

    def picture_of(self, lane: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the scene of a lane, with things where they stand in its episode, and its physics."""
        episode = self._episode(lane)
        episode.place()
        return episode.model, episode.data

    def close(self) -> None:
        """Forget all episodes."""
        self._lanes = [None] * len(self._lanes)
        self._idle.clear()

    def _episode(self, lane: int) -> Episode:
        found = self._lanes[lane]
        if found is None:
            raise no_episode(lane, "Meta-World")
        return found[1]
