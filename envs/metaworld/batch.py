"""Episodes side by side: the work of `Episode.advance`, done for all of them at once.

Each number has the same bits as in `Episode.advance`; the module `rewards` explains how. Rewards and
successes depend on the task, so they are computed in groups of episodes of one task.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .episode import Episode, Look
from .rewards import Mixed, Vector, closed, norm
from .state import SIZE

Numbers: TypeAlias = NDArray[np.float32]
Verdict: TypeAlias = tuple[Vector, NDArray[np.bool_]]
"""The rewards (N,) and which of the episodes succeeded (N,)."""

NOW = 18
"""Size of the current part of an observation; as many numbers of the previous step follow, then the goal."""
_PARTS = (slice(4, 7), slice(7, 11)), (slice(11, 14), slice(14, 18))
"""Places in an observation of the position and the rotation of its first and its second part."""
_ARM: tuple[Look, ...] = (
    ("body", "hand", "xpos"),
    ("body", "rightclaw", "xpos"),
    ("body", "leftclaw", "xpos"),
    ("body", "rightpad", "xpos"),
    ("body", "leftpad", "xpos"),
    ("site", "rightEndEffector", "xpos"),
    ("site", "leftEndEffector", "xpos"),
)
"""Positions of the robot that observations and rewards need."""
_FINGERS = np.array([1.0, -1.0], np.float32)
"""Factor of an action's last number for each finger."""


@dataclass(frozen=True)
class Part:
    """An object in the observation: its position, and its rotation as a quaternion."""

    place: Look
    """Source of the position."""
    offset: tuple[float, float, float] | None = None
    """Offset added to the position, in metres."""
    rotation: Look | None = None
    """Source of the rotation, a quaternion or a matrix; the observation has zeros if None."""


@dataclass(frozen=True)
class Rule:
    """Meta-World's observation and reward of a task."""

    judge: Callable[[Group], Verdict]
    """Computes rewards and successes."""
    parts: tuple[Part, ...]
    """The one or two objects in the observation."""


class Group:
    """Episodes of one task that take their steps together, with everything that the task's rule reads.

    Args:
        rule: Rule of the task.
        episodes: Running episodes; none may begin anew while the group is in use.
    """

    actions: Numbers
    """Actions of this step (N, 4)."""
    observation: Vector
    """Observations after the step (N, 39), clipped to their bounds."""
    arm: Vector
    """Positions of the robot (N, 7, 3), in the order of `_ARM`."""
    tcp: Vector
    """Midpoints between the fingers (N, 3)."""

    def __init__(self, rule: Rule, episodes: Sequence[Episode]) -> None:
        self.rule, self.episodes = rule, episodes
        self._starts: dict[str, Vector] = {}
        self.goal = self.start("_target_pos")
        """Goal positions (N, 3), not clipped as in the observation."""

    @property
    def hand(self) -> Vector:
        """Observed positions of the hand (N, 3)."""
        return self.observation[:, :3]

    @property
    def opening(self) -> Vector:
        """Openings of the fingers (N,), from 0 to 1."""
        return self.observation[:, 3]

    @property
    def thing(self) -> Vector:
        """Positions (N, 3) of the first object in the observation."""
        return self.observation[:, 4:7]

    @property
    def pads(self) -> Vector:
        """Positions of the finger pads along y (2, N), the right one first."""
        return self.arm[:, 3:5, 1].T

    def closed(self, effort: float = 1.0, counts: NDArray[np.bool_] | bool = True) -> Mixed:
        """Return the share of an effort by which actions close the fingers; 0 where it does not count."""
        return closed(self.actions[:, 3], effort, counts)

    def start(self, name: str) -> Vector:
        """Return a measurement of Meta-World's reset in each episode, such as `init_tcp` (N, K)."""
        if name not in self._starts:
            self._starts[name] = np.array([getattr(episode, name) for episode in self.episodes], np.float64)
        return self._starts[name]

    def look(self, look: Look) -> Vector:
        """Return the present values of an array of the physics (N, size)."""
        return _rows([episode.look(look) for episode in self.episodes])


class Batch:
    """Episodes that take their steps together.

    Args:
        groups: One group per task; the batch has their episodes in this order.
    """

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups, self.episodes = groups, [episode for group in groups for episode in group.episodes]
        self._mocaps = [episode.data.mocap_pos[0] for episode in self.episodes]
        # carried from step to step instead of read again: nothing else sets them while the batch is in use
        self._hands, self._before = np.stack(self._mocaps), np.stack([one.before for one in self.episodes])
        self._controls = [episode.data.ctrl for episode in self.episodes]
        self._reach = [
            np.array([getattr(one, name) for one in self.episodes]) for name in ("mocap_low", "mocap_high")
        ]
        bounds = [episode.sawyer_observation_space for episode in self.episodes]
        self._bounds = [np.array([getattr(one, name) for one in bounds]) for name in ("low", "high")]
        self._goals = np.concatenate([group.goal for group in groups])
        parts = [group.rule.parts for group in groups for _ in group.episodes]
        self._parts = [_Parts(self.episodes, parts, number) for number in range(max(map(len, parts)))]
        arms = [episode.look(look) for episode in self.episodes for look in _ARM]
        # read all at once: after the physics, its data fill the processor's caches
        self._views = [view for views in (arms, *(part.views for part in self._parts)) for view in views]

    def aim(self, actions: Numbers) -> None:
        """Set the controls of the next physics step from actions (N, 4) in [-1, 1]."""
        self._actions = actions
        low, high = self._reach
        hands = self._hands + actions[:, :3] * self.episodes[0].action_scale
        self._hands = np.minimum(np.maximum(hands, low), high)
        efforts = actions[:, 3:] * _FINGERS
        for mocap, hand, control, effort in zip(
            self._mocaps, self._hands, self._controls, efforts, strict=True
        ):
            mocap[:], control[:] = hand, effort

    def outcome(self) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        """Return observations (N, 39), rewards (N,) and successes (N,) after the physics has advanced."""
        numbers, arms = np.concatenate(self._views), len(self.episodes) * len(_ARM) * 3
        arm = numbers[:arms].reshape(len(self.episodes), -1, 3)
        observation = self._observe(arm, numbers[arms:])
        tcp = (arm[:, 5] + arm[:, 6]) / 2.0
        rewards, successes = np.empty(len(tcp)), np.empty(len(tcp), np.bool_)
        first = 0
        # a margin can be 0 by chance: beyond it the reward is 0, as at an infinite distance
        with np.errstate(divide="ignore", invalid="ignore"):
            for group in self._groups:
                rows = slice(first, first + len(group.episodes))
                group.actions, group.observation = self._actions[rows], observation[rows]
                group.arm, group.tcp = arm[rows], tcp[rows]
                rewards[rows], successes[rows] = group.rule.judge(group)
                first = rows.stop
        return observation, rewards, successes

    def _observe(self, arm: Vector, numbers: Vector) -> Vector:
        """Return observations (N, 39) from the positions of the arm (N, 7, 3) and the values of the parts."""
        observation = np.zeros((len(self.episodes), SIZE))
        observation[:, :3] = arm[:, 0]
        apart = norm(arm[:, 1] - arm[:, 2]) / 0.1
        observation[:, 3] = np.minimum(np.maximum(apart, 0.0), 1.0)
        for part in self._parts:
            part.show(numbers[: part.size], observation)
            numbers = numbers[part.size :]
        observation[:, NOW : 2 * NOW] = self._before
        observation[:, 2 * NOW :] = self._goals
        self._before = observation[:, :NOW].copy()
        for episode, now in zip(self.episodes, self._before, strict=True):
            episode.before = now
        low, high = self._bounds
        seen: Vector = np.minimum(np.maximum(observation, low), high)
        return seen


class _Parts:
    """The first objects in all observations, or the second ones."""

    views: list[Vector]
    """Views of positions (P, 3), then quaternions (Q, 4), then matrices (M, 9)."""
    size: int
    """Total number of values in the views."""

    def __init__(self, episodes: Sequence[Episode], parts: Sequence[tuple[Part, ...]], number: int) -> None:
        self._place, self._rotation = _PARTS[number]
        shown = [(row, part[number]) for row, part in enumerate(parts) if len(part) > number]
        moved = [(row, part.offset) for row, part in shown if part.offset is not None]
        self._rows = [row for row, _ in shown]
        self._moved = [row for row, _ in moved]
        self._offsets = np.array([offset for _, offset in moved])
        turned = [(row, episodes[row].look(part.rotation)) for row, part in shown if part.rotation]
        quaternions = [(row, view) for row, view in turned if view.size == 4]
        matrices = [(row, view) for row, view in turned if view.size == 9]
        self._quaternions, self._matrices = [row for row, _ in quaternions], [row for row, _ in matrices]
        self.views = [episodes[row].look(part.place) for row, part in shown]
        self.views += [view for _, view in quaternions + matrices]
        self._ends = 3 * len(shown), 3 * len(shown) + 4 * len(quaternions)
        self.size = sum(view.size for view in self.views)

    def show(self, numbers: Vector, observation: Vector) -> None:
        """Write the objects into observations (N, 39), from the values of the views."""
        places, turns = self._ends
        observation[self._rows, self._place] = numbers[:places].reshape(-1, 3)
        if self._moved:
            observation[self._moved, self._place] += self._offsets
        if self._quaternions:
            observation[self._quaternions, self._rotation] = numbers[places:turns].reshape(-1, 4)
        if self._matrices:
            # MuJoCo's matrices are rotations already: skip the orthogonalisation
            rotations = Rotation.from_matrix(numbers[turns:].reshape(-1, 3, 3), assume_valid=True)
            observation[self._matrices, self._rotation] = rotations.as_quat()


def _rows(views: Sequence[Vector]) -> Vector:
    """Return the values of views of one size, (N, size)."""
    return np.concatenate(views).reshape(len(views), -1)
