"""The physics of the Meta-World world: many episodes side by side, of any tasks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.perturbation import draw_perturbation
from clbench.world import Team, checked_actions, no_episode

from .batch import Batch
from .episode import Episode, new_episode
from .rules import RULES
from .state import SIZE, State

_Kind: TypeAlias = tuple[str, float | None]
"""A task, and how many times as heavy its things are if they are perturbed: what a place for episodes is made
for."""


@dataclass(eq=False)
class _Lane:
    """An episode in its place; the next one there is another lane."""

    kind: _Kind
    episode: Episode


class MetaWorldVectorWorld:
    """Meta-World's tasks with their own physics, observations, rewards and rules of success, bit for bit.

    An action (4,) in [-1, 1] moves the hand by up to 1 cm along x, y and z, and closes (+1) or opens (-1) the
    fingers; a step takes 0.0125 s. The state is Meta-World's observation with the goal in it, the reward its
    own from 0 to 10. An episode ends with success only; whoever uses the world counts its steps. It is a
    `clbench.world.VectorWorld`.

    Args:
        lanes: Places for episodes. A task's scene is compiled when it is first reset to.
        threads: Threads that advance the physics of the tasks of `RULES`; MuJoCo releases the interpreter lock.
            Each but the first makes copies of the models that it needs, 19 MB a task. Results do not depend on
            it.
        perturbed: Whether things are heavier or lighter, and the hand starts elsewhere.
    """

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._perturbed = perturbed
        self._lanes: list[_Lane | None] = [None] * lanes
        self._idle: defaultdict[_Kind, list[Episode]] = defaultdict(list)
        self._batches: dict[tuple[_Lane, ...], Batch] = {}
        self._team = Team(threads)

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
            self._idle[before.kind].append(before.episode)
        self._lanes[lane] = _Lane(kind, episode)
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
        moved = [self._lane(lane) for lane in lanes]
        states = np.empty((len(lanes), SIZE), np.float32)
        rewards, successes = np.empty(len(lanes)), np.empty(len(lanes), np.bool_)
        batches = self._by_task(moved)
        for batch, rows in batches:
            batch.aim(actions[rows])
        self._team.each(Episode.move, [lane.episode for lane in moved if lane.kind[0] in RULES])
        for batch, rows in batches:
            states[rows], rewards[rows], successes[rows] = batch.outcome()
        for row, lane in enumerate(moved):
            if lane.kind[0] not in RULES:
                states[row], rewards[row], successes[row] = lane.episode.advance(actions[row])
        return states, rewards, successes

    def _by_task(self, lanes: Sequence[_Lane]) -> list[tuple[Batch, list[int]]]:
        """Return batches of the lanes whose task has a rule, with the rows of each."""
        by_task: defaultdict[str, list[int]] = defaultdict(list)
        for row, lane in enumerate(lanes):
            if lane.kind[0] in RULES:
                by_task[lane.kind[0]].append(row)
        known, self._batches, batches = self._batches, {}, []
        for task, rows in by_task.items():
            members = tuple(lanes[row] for row in rows)
            batch = known.get(members) or Batch(RULES[task], [lane.episode for lane in members])
            self._batches[members] = batch
            batches.append((batch, rows))
        return batches

    def picture_of(self, lane: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the scene of a lane, with things where they stand in its episode, and its physics."""
        episode = self._lane(lane).episode
        episode.place()
        mujoco.mj_forward(episode.model, episode.data)  # what is drawn is more than what a step computes
        return episode.model, episode.data

    def close(self) -> None:
        """Forget all episodes, and end the threads."""
        self._team.close()
        self._batches.clear()
        self._lanes = [None] * len(self._lanes)
        self._idle.clear()

    def _lane(self, number: int) -> _Lane:
        lane = self._lanes[number]
        if lane is None:
            raise no_episode(number, "Meta-World")
        return lane
