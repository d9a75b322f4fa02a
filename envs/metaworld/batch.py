"""Episodes of one task side by side: what `Episode.advance` does, computed for all of them at once.

Each number has the bits that it has there; `rewards` says what that takes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .episode import Episode
from .rewards import Mixed, Vector, closed, norm
from .state import SIZE

Numbers: TypeAlias = NDArray[np.float32]
Verdict: TypeAlias = tuple[Vector, NDArray[np.bool_]]
"""The rewards (N,) and which of the episodes succeeded (N,)."""

_KINDS = {"body": mujoco.mjtObj.mjOBJ_BODY, "site": mujoco.mjtObj.mjOBJ_SITE, "geom": mujoco.mjtObj.mjOBJ_GEOM}
_PLACES = {"body": "xpos", "site": "site_xpos", "geom": "geom_xpos"}
_AXES = {"body": "xmat", "geom": "geom_xmat"}

NOW = 18
"""How many numbers of an observation say how things are: as many follow of the step before, then the goal."""


@dataclass(frozen=True)
class Part:
    """A thing that is part of the observation: its place, and its rotation as a quaternion."""

    kind: Literal["body", "site", "geom"]
    """What has its place."""
    name: str
    """Of what has its place."""
    offset: tuple[float, float, float] | None = None
    """Added to the place, in metres."""
    turned: str | None = None
    """The body whose quaternion is the rotation; zeros stand for it if this is None, and `axes` too."""
    axes: tuple[Literal["body", "geom"], str] | None = None
    """What has the rotation, where it is computed from a matrix."""


@dataclass(frozen=True)
class Rule:
    """What Meta-World shows and rewards in a task."""

    judge: Callable[[Batch], Verdict]
    """Computes rewards and successes."""
    parts: tuple[Part, ...]
    """What the observation is about."""


class Batch:
    """Episodes of one task, which take their steps together.

    Args:
        rule: Of the task.
        episodes: Begun, and not begun again while this is used.
    """

    def __init__(self, rule: Rule, episodes: Sequence[Episode]) -> None:
        self._rule, self.episodes = rule, tuple(episodes)
        self._first = self.episodes[0]
        bounds = self._first.sawyer_observation_space
        self._low, self._high = bounds.low, bounds.high
        self._views: dict[str, list[NDArray[np.float64]]] = {}
        self._starts: dict[str, Vector] = {}
        self._indices: dict[tuple[str, str], int] = {}
        self._goals = self.start("_target_pos")
        self._mocaps = [episode.data.mocap_pos[0] for episode in self.episodes]
        self._controls = [episode.data.ctrl for episode in self.episodes]
        self._read: dict[str, NDArray[np.float64]] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> Batch:
        """Return a batch that looks at copies of the episodes."""
        return Batch(self._rule, copy.deepcopy(self.episodes, memo))

    def aim(self, actions: Numbers) -> None:
        """Set what the physics is to do in the next step, by actions (N, 4) in [-1, 1]."""
        self._actions = actions
        first = self._first
        goals = np.concatenate(self._mocaps).reshape(-1, 3) + actions[:, :3] * first.action_scale
        goals = np.clip(goals, first.mocap_low, first.mocap_high)
        fingers = np.stack([actions[:, 3], -actions[:, 3]], axis=1)
        for mocap, goal, control, effort in zip(self._mocaps, goals, self._controls, fingers, strict=True):
            mocap[:], control[:] = goal, effort

    def outcome(self) -> tuple[Vector, Vector, NDArray[np.bool_]]:
        """Return the observations (N, 39), the rewards (N,) and the successes (N,) after the physics' step."""
        self._read.clear()
        observation = np.zeros((len(self.episodes), SIZE))
        self._show(observation[:, :NOW])
        observation[:, NOW : 2 * NOW] = np.array([episode.before for episode in self.episodes])
        observation[:, 2 * NOW :] = self._goals
        for episode, now in zip(self.episodes, observation[:, :NOW].copy(), strict=True):
            episode.before = now
        self.observation: Vector = np.clip(observation, self._low, self._high)
        return self.observation, *self._rule.judge(self)

    def _show(self, now: Vector) -> None:
        """Write how things are (N, 18)."""
        now[:, :3] = self.hand
        apart = norm(self.place("body", "rightclaw") - self.place("body", "leftclaw"))
        now[:, 3] = np.clip(apart / 0.1, 0.0, 1.0)
        for number, part in enumerate(self._rule.parts):
            first = 4 + 7 * number
            place = self.place(part.kind, part.name)
            now[:, first : first + 3] = place if part.offset is None else place + np.array(part.offset)
            if part.turned is not None:
                now[:, first + 3 : first + 7] = self._rows("xquat", 4)[:, self._index("body", part.turned)]
            elif part.axes is not None:
                matrices = self._rows(_AXES[part.axes[0]], 9)[:, self._index(*part.axes)]
                turns = Rotation.from_matrix(matrices.reshape(-1, 3, 3), assume_valid=True)
                now[:, first + 3 : first + 7] = turns.as_quat()

    # ---- what rules ask for ----------------------------------------------------------------------------

    @property
    def hand(self) -> Vector:
        """Places of the hand (N, 3)."""
        return self.place("body", "hand")

    @property
    def tcp(self) -> Vector:
        """Places between the fingers (N, 3)."""
        center: Vector = (self.place("site", "rightEndEffector") + self.place("site", "leftEndEffector")) / 2.0
        return center

    @property
    def hand_seen(self) -> Vector:
        """Places of the hand (N, 3) as they are observed, which is within bounds."""
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
    def goal(self) -> Vector:
        """Where the thing is to go (N, 3): not as it is observed, which is within bounds."""
        return self._goals

    def closed(self, effort: float = 1.0, counts: NDArray[np.bool_] | bool = True) -> Mixed:
        """Return how far the actions close the fingers, as a share of an effort, where that `counts`; else 0."""
        return closed(self._actions[:, 3], effort, counts)

    def place(self, kind: Literal["body", "site", "geom"], name: str) -> Vector:
        """Return the places (N, 3) of a body, a site or a geom."""
        return self._rows(_PLACES[kind], 3)[:, self._index(kind, name)]

    def joint(self, name: str) -> Vector:
        """Return the position (N,) of a hinge or a slide."""
        address = self._first.model.joint(name).qposadr[0]
        return self._rows("qpos", 1)[:, address, 0]

    def start(self, name: str) -> Vector:
        """Return what Meta-World's reset measured, as `obj_init_pos` or `init_tcp`, of each episode."""
        if name not in self._starts:
            self._starts[name] = np.array([getattr(episode, name) for episode in self.episodes], np.float64)
        return self._starts[name]

    def _rows(self, name: str, size: int) -> Vector:
        """Return an array of the physics, (N, rows of it, size), as it is after this step."""
        if name not in self._read:
            if name not in self._views:
                self._views[name] = [getattr(episode.data, name) for episode in self.episodes]
            views = self._views[name]
            self._read[name] = np.concatenate(views).reshape(len(views), -1, size)
        return self._read[name]

    def _index(self, kind: str, name: str) -> int:
        if (kind, name) not in self._indices:
            self._indices[kind, name] = mujoco.mj_name2id(self._first.model, _KINDS[kind], name)
        return self._indices[kind, name]
