"""The physics of the Meta-World world: many episodes side by side, of any tasks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import gymnasium
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.threads import Team
from clbench.worlds.world import Drawable, checked_actions, lane_at, rows_by_task

from .batch import Batch, Group
from .episode import Episode, new_episode
from .rules import RULES
from .scene import CAMERA
from .state import SIZE, State

_Kind: TypeAlias = tuple[str, float | None]
"""The kind of an episode: its task, and the factor on the masses of objects if it is perturbed."""


@dataclass(eq=False)
class _Lane:
    """An episode in its lane; the next episode in the lane is another `_Lane`."""

    kind: _Kind
    episode: Episode


class _Order:
    """Lanes in the order of their steps: first those whose task has a rule, task by task.

    Args:
        lanes: The lanes that take the step.
        known: Groups of the previous order; unchanged ones are reused.
    """

    def __init__(self, lanes: Sequence[_Lane], known: Mapping[tuple[_Lane, ...], Group]) -> None:
        by_task = rows_by_task(lane.kind[0] for lane in lanes)
        self.lanes = lanes
        self.others = [(row, lane.episode) for row, lane in enumerate(lanes) if lane.kind[0] not in RULES]
        self.rows = [row for task, rows in by_task.items() if task in RULES for row in rows]
        self.groups: dict[tuple[_Lane, ...], Group] = {}
        for task, rows in by_task.items():
            members = tuple(lanes[row] for row in rows)
            if task in RULES:
                new = members not in known
                episodes = [lane.episode for lane in members]
                self.groups[members] = Group(RULES[task], episodes) if new else known[members]
        self.batch = Batch(list(self.groups.values())) if self.groups else None

    def __deepcopy__(self, _: dict[int, Any]) -> None:
        """Return None: a copied world makes an order of its own physics."""


class MetaWorldVectorWorld:
    """Meta-World's tasks with their own physics, observations, rewards and success conditions, bit for bit.

    An action (4,) in [-1, 1] moves the hand by up to 1 cm along x, y and z, and closes (+1) or opens (-1) the
    fingers; a step takes 0.0125 s. The reward is Meta-World's own, from 0 to 10.

    It is a `clbench.worlds.world.VectorWorld`. Only success ends an episode; the caller counts its steps.

    Args:
        lanes: Number of lanes. The first reset to a task compiles its scene.
        threads: Number of threads that advance the physics; MuJoCo releases the interpreter lock. Results do
            not depend on their number. Each thread but one copies the models that it needs, of 19 MB.
        perturbed: Whether objects are heavier or lighter, and the hand starts elsewhere.
    """

    perturbable: ClassVar[bool] = True

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._perturbed = perturbed
        self._lanes: list[_Lane | None] = [None] * lanes
        self._idle: defaultdict[_Kind, list[Episode]] = defaultdict(list)
        self._order: _Order | None = None
        self._team = Team(threads)

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 39), which the seeds alone determine.

        Raises:
            UnknownNameError: No task has this name; the error names the nearest one.
        """
        return np.stack([self._begin(*start) for start in zip(lanes, seeds, tasks, strict=True)])

    def _begin(self, lane: int, seed: int, task: str) -> State:
        perturbation = draw_perturbation(seed) if self._perturbed else None
        kind = task, perturbation.mass if perturbation else None
        before, self._lanes[lane] = self._lanes[lane], None
        if before is not None:  # comes first: a task that begins again keeps its physics, and its renderer
            self._idle[before.kind].append(before.episode)
        episode = self._idle[kind].pop() if self._idle[kind] else new_episode(*kind)
        self._lanes[lane] = _Lane(kind, episode)
        return episode.begin(seed, perturbation.start if perturbation else None)

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Step each of `lanes` for 0.0125 s with its row of the actions (N, 4).

        Returns:
            The states (N, 39), the rewards (N,), and which episodes succeeded (N,).

        Raises:
            InputError: An action has another shape than (4,), or contains a number that is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "Meta-World", len(lanes))
        order = self._order_of([self._lane(lane) for lane in lanes])
        states = np.empty((len(lanes), SIZE), np.float32)
        rewards, successes = np.empty(len(lanes)), np.empty(len(lanes), np.bool_)
        if order.batch is not None:
            rows = order.rows
            order.batch.aim(actions[rows])
            self._team.each(Episode.move, order.batch.episodes)
            states[rows], rewards[rows], successes[rows] = order.batch.outcome()
        for row, episode in order.others:
            states[row], rewards[row], successes[row] = episode.advance(actions[row])
        return states, rewards, successes

    def _order_of(self, lanes: Sequence[_Lane]) -> _Order:
        """Return the order in which lanes take their steps; the same lanes keep their order."""
        if self._order is None or self._order.lanes != lanes:
            self._order = _Order(lanes, {} if self._order is None else self._order.groups)
        return self._order

    def drawable(self, lane: int) -> Drawable:
        """Return the scene of a lane with the objects in place; the next step is independent of this call."""
        episode = self._lane(lane).episode
        episode.complete()
        return Drawable(episode.model, episode.data, CAMERA)

    def close(self) -> None:
        """Release all episodes, and end the threads."""
        self._team.close()
        self._order = None
        self._lanes = [None] * len(self._lanes)
        self._idle.clear()

    def _lane(self, number: int) -> _Lane:
        return lane_at(self._lanes, number, "Meta-World")
