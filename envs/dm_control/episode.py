"""One episode of a task of the dm_control world: its physics, unpadded and unjudged."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.worlds.perturbation import Perturbation

from .bodies import Start, start, start_with_mass
from .rules import RULES, Rule
from .state import Observation


class Episode:
    """A place for episodes, one after the other, of any tasks. It keeps the physics of each body it had."""

    rule: Rule
    task: str

    def __init__(self) -> None:
        self._kept: dict[Start, tuple[mujoco.MjData, Callable[[], Observation]]] = {}

    def reset(self, task: str, seed: int, perturbation: Perturbation | None = None) -> Observation:
        """Begin an episode of a task, perturbed if that is given, and return what dm_control observes (K,).

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        if task not in RULES:
            raise unknown("task of the dm_control world", task, RULES)
        self.task, self.rule = task, RULES[task]
        begin = start(self.rule.body, self.rule.start)
        if perturbation:
            begin = start_with_mass(self.rule.body, self.rule.start, perturbation.mass)
        self.start = begin
        if begin not in self._kept:
            data = mujoco.MjData(begin.model)
            self._kept[begin] = (data, begin.body.observer(begin.model, data))
        self.data, self._observe = self._kept[begin]
        self.control = self.data.ctrl
        begin.begin(seed, self.data)
        if perturbation:
            self._push(perturbation.start)
        return self._observe()

    def _push(self, start: tuple[float, float, float]) -> None:
        """Give the body's joints a share `start` of their speeds, from -1 to 1 along an axis of the plane."""
        for joint, speed in enumerate(self.start.body.starts):
            self.data.qvel[joint] += speed * start[joint % 2]
        mujoco.mj_forward(self.start.model, self.data)

    def step(self, action: NDArray[np.float32]) -> Observation:
        """Move by an action in [-1, 1], of which the motors of the body take the first numbers."""
        self.control[:] = action[: len(self.control)]
        self.start.advance(self.data)
        return self._observe()

    def reward(self, observation: Observation) -> float:
        """Return what the step that led to `observation` (K,) was worth."""
        return float(self.rule.reward(observation, self.control))

    def training_reward(self, observation: Observation) -> float:
        """Return what an expert that trains is told that step was worth."""
        return float(self.rule.training_reward(observation, self.control))
