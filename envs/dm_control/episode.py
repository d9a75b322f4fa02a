"""One episode of a task of the dm_control world: the physics, without padding and without success."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.worlds.perturbation import Perturbation

from .rules import RULES, Rule
from .scene import Start, start, start_with_mass
from .state import Observation


class Episode:
    """Runs episodes of any tasks, one after the other, and keeps the physics of each body that it has had."""

    rule: Rule
    task: str

    def __init__(self) -> None:
        self._kept: dict[Start, tuple[mujoco.MjData, Callable[[], Observation]]] = {}

    def reset(self, task: str, seed: int, perturbation: Perturbation | None = None) -> Observation:
        """Begin an episode of a task and return dm_control's observation (K,).

        Args:
            task: Name of the task.
            seed: Seed of the initial state.
            perturbation: Perturbation of the episode; None for a plain episode.

        Raises:
            UnknownNameError: No task has this name; the error names the nearest one.
        """
        if task not in RULES:
            raise unknown("task of the dm_control world", task, RULES)
        self.task, self.rule = task, RULES[task]
        begin = start(self.rule.body, self.rule.start)
        if perturbation:
            begin = start_with_mass(self.rule.body, self.rule.start, perturbation.mass)
        self._take(begin)
        begin.begin(seed, self.data)
        if perturbation:
            self._push(perturbation.start)
        return self._observe()

    def _take(self, begin: Start) -> None:
        """Make the physics of a body the current one."""
        if begin not in self._kept:
            data = mujoco.MjData(begin.model)
            self._kept[begin] = (data, begin.body.observer(begin.model, data))
        self.start, (self.data, self._observe) = begin, self._kept[begin]
        self.control = self.data.ctrl

    def __deepcopy__(self, _: dict[int, Any]) -> Episode:
        """Return an episode with its own physics, in the same state."""
        copied = Episode()
        copied.task, copied.rule = self.task, self.rule
        copied._take(self.start)
        mujoco.mj_copyData(copied.data, self.start.model, self.data)
        return copied

    def _push(self, start: tuple[float, float, float]) -> None:
        """Add a share, from -1 to 1 for each of two axes, of the largest speeds to the body's joints."""
        for joint, speed in enumerate(self.start.body.starts):
            self.data.qvel[joint] += speed * start[joint % 2]
        mujoco.mj_forward(self.start.model, self.data)

    def step(self, action: NDArray[np.float32]) -> Observation:
        """Move by an action in [-1, 1]; the motors of the body take its first numbers."""
        self.control[:] = action[: len(self.control)]
        self.start.advance(self.data)
        return self._observe()

    def reward(self, observation: Observation) -> float:
        """Return the reward of the step that led to `observation` (K,)."""
        return float(self.rule.reward(observation, self.control))

    def training_reward(self, observation: Observation) -> float:
        """Return the reward of the step that led to `observation` (K,), as experts are trained on it."""
        return float(self.rule.training_reward(observation, self.control))
