"""Episodes side by side: what `Episode.advance` does, computed for all of them at once.

Each number has the bits that it has there; `rewards` says what that takes. Rewards and successes depend on
the task, and are computed in groups of episodes of one task.
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
"""How many numbers of an observation say how things are: as many follow of the step before, then the goal."""
_PARTS = (slice(4, 7), slice(7, 11)), (slice(11, 14), slice(14, 18))
"""Where an observation has the place and the rotation of its first part, and of its second."""
_ARM: tuple[Look, ...] = (
    ("body", "hand", "xpos"),
    ("body", "rightclaw", "xpos"),
    ("body", "leftclaw", "xpos"),
    ("body", "rightpad", "xpos"),
    ("body", "leftpad", "xpos"),
    ("site", "rightEndEffector", "xpos"),
    ("site", "leftEndEffector", "xpos"),
)
"""What is looked at of the robot."""
_FINGERS = np.array([1.0, -1.0], np.float32)
"""The share of an action's last number that each finger gets."""


@dataclass(frozen=True)
class Part:
    """A thing that is part of the observation: its place, and its rotation as a quaternion."""

    place: Look
    """What has its place."""
    offset: tuple[float, float, float] | None = None
    """Added to the place, in metres."""
    rotation: Look | None = None
    """What has its rotation, as a quaternion or a matrix; zeros stand for it if this is None."""


@dataclass(frozen=True)
class Rule:
    """What Meta-World shows and rewards in a task."""

    judge: Callable[[Group], Verdict]
    """Computes rewards and successes."""
    parts: tuple[Part, ...]
    """What the observation is about, one thing or two."""


class Group:
    """Episodes of one task, which take their steps together: what its rule asks for.

    Args:
        rule: Of the task.
        episodes: Begun, and not begun again while this is used.
    """

    actions: Numbers
    """What was asked for in this step (N, 4)."""
    observation: Vector
    """What is observed after it (N, 39), within its bounds."""
    arm: Vector
    """Places of the parts of the robot (N, 7, 3), as `_ARM` names them."""
    tcp: Vector
    """Places between the fingers (N, 3)."""

    def __init__(self, rule: Rule, episodes: Sequence[Episode]) -> None:
        self.rule, self.episodes = rule, episodes
        self._starts: dict[str, Vector] = {}
        self.goal = self.start("_target_pos")
        """Where the thing is to go (N, 3): not as it is observed, which is within bounds."""

    @property
    def hand(self) -> Vector:
        """Places of the hand (N, 3), as they are observed."""
        return self.observation[:, :3]

    @property
    def opening(self) -> Vector:
        """How far the fingers are apart (N,), from 0 to 1."""
        return self.observation[:, 3]

    @property
    def thing(self) -> Vector:
        """Places (N, 3) of the first thing that is part of the observation."""
        return self.observation[:, 4:7]

    @property
    def pads(self) -> Vector:
        """Places of the pads of the fingers along y (2, N), first that of the right one."""
        return self.arm[:, 3:5, 1].T

    def closed(self, effort: float = 1.0, counts: NDArray[np.bool_] | bool = True) -> Mixed:
        """Return how far actions close the fingers, as a share of an effort; 0 where that does not count."""
        return closed(self.actions[:, 3], effort, counts)

    def start(self, name: str) -> Vector:
        """Return what Meta-World's reset measured, as `obj_init_pos` or `init_tcp`, of each episode."""
        if name not in self._starts:
            self._starts[name] = np.array([getattr(episode, name) for episode in self.episodes], np.float64)
        return self._starts[name]

    def look(self, look: Look) -> Vector:
        """Return something of the physics (N, its size) as it is now."""
        return _rows([episode.look(look) for episode in self.episodes])


class Batch:
    """Episodes that take their steps together.

    Args:
        groups: Of the tasks; their episodes are those of the batch, in this order.
    """

    def __init__(self, groups: Sequence[Group]) -> None:
        self._groups, self.episodes = groups, [episode for group in groups for episode in group.episodes]
        self._mocaps = [episode.data.mocap_pos[0] for episode in self.episodes]
        # carried from step to step, rather than read again: while a batch stands, nothing else sets them
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
        # read all at once: whatever comes after the physics finds the processor's caches full of that
        self._views = [view for views in (arms, *(part.views for part in self._parts)) for view in views]

    def aim(self, actions: Numbers) -> None:
        """Set what the physics is to do in the next step, by actions (N, 4) in [-1, 1]."""
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
        """Return observations (N, 39), rewards (N,) and successes (N,), once the physics has advanced."""
        numbers, arms = np.concatenate(self._views), len(self.episodes) * len(_ARM) * 3
        arm = numbers[:arms].reshape(len(self.episodes), -1, 3)
        observation = self._observe(arm, numbers[arms:])
        tcp = (arm[:, 5] + arm[:, 6]) / 2.0
        rewards, successes = np.empty(len(tcp)), np.empty(len(tcp), np.bool_)
        first = 0
        # beyond a margin of 0, as may happen by chance, the reward is 0: that of an infinite distance
        with np.errstate(divide="ignore", invalid="ignore"):
            for group in self._groups:
                rows = slice(first, first + len(group.episodes))
                group.actions, group.observation = self._actions[rows], observation[rows]
                group.arm, group.tcp = arm[rows], tcp[rows]
                rewards[rows], successes[rows] = group.rule.judge(group)
                first = rows.stop
        return observation, rewards, successes

    def _observe(self, arm: Vector, numbers: Vector) -> Vector:
        """Return observations (N, 39), from the places of the arm (N, 7, 3) and the numbers of the parts."""
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
    """What observations show of their first parts, or of their second."""

    views: list[Vector]
    """All that is looked at: places (P, 3), then quaternions (Q, 4), then matrices (M, 9)."""
    size: int
    """How many numbers that is."""

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
        """Write them into observations (N, 39), from the numbers that the views hold."""
        places, turns = self._ends
        observation[self._rows, self._place] = numbers[:places].reshape(-1, 3)
        if self._moved:
            observation[self._moved, self._place] += self._offsets
        if self._quaternions:
            observation[self._quaternions, self._rotation] = numbers[places:turns].reshape(-1, 4)
        if self._matrices:
            # MuJoCo's are rotations: what is skipped is to make them so
            rotations = Rotation.from_matrix(numbers[turns:].reshape(-1, 3, 3), assume_valid=True)
            observation[self._matrices, self._rotation] = rotations.as_quat()


def _rows(views: Sequence[Vector]) -> Vector:
    """Return what views of one size are of, (N, size)."""
    return np.concatenate(views).reshape(len(views), -1)
