"""The toy: a point on a plane moves left, right, up or down, as instructed. A run takes seconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.data.access import check_episodes
from clbench.data.questions import QuestionKind
from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.perturbation import draw_perturbation

State = NDArray[np.float32]
Action = NDArray[np.float32]

_DIRECTIONS = {
    "left": (-1.0, 0.0),
    "up": (0.0, 1.0),
    "right": (1.0, 0.0),
    "down": (0.0, -1.0),
    "up_left": (-1.0, 1.0),
}


class ToyWorld(gymnasium.Env[State, Action]):
    """A point and a marker. State: point (2,), marker (2,). Action: velocity (2,).

    A task succeeds when the point has moved by 1 in the direction of the task, to within 0.3 on both axes.

    Args:
        render_mode: "rgb_array", or None to draw nothing.
        perturbed: Whether the start of the point is shifted by up to 0.1, and its mass changes its speed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    perturbable: ClassVar[bool] = True

    def __init__(self, render_mode: str | None = None, perturbed: bool = False) -> None:
        self.render_mode, self.perturbed = render_mode, perturbed

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Place point and marker at random; `options={"task": name}` chooses the task."""
        super().reset(seed=seed)
        self._task = (options or {}).get("task", "left")
        if self._task not in _DIRECTIONS:
            raise unknown("task of the toy world", self._task, _DIRECTIONS)
        self._state, self._mass = self.np_random.uniform(-1.0, 1.0, 4).astype(np.float32), 1.0
        if self.perturbed and seed is not None:
            perturbation = draw_perturbation(seed)
            self._state[:2] += 0.1 * np.array(perturbation.start[:2], np.float32)
            self._mass = perturbation.mass
        self._start = self._state[:2].copy()
        return self._state.copy(), {"task": self._task, "success": False}

    def step(self, action: Action) -> tuple[State, float, bool, bool, dict[str, Any]]:
        """Move the point by a fifth of the velocity, divided by its mass.

        Raises:
            LeakError: A hook of a method plays a task whose demonstrations it may not read.
        """
        check_episodes([(self._task, "validation")])  # Gymnasium knows no splits
        self._state[:2] += 0.2 / self._mass * np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        error = float(np.abs(self._start + _DIRECTIONS[self._task] - self._state[:2]).max())
        success = error < 0.3
        return (
            self._state.copy(),
            float(success) - error,
            success,
            False,
            {"task": self._task, "success": success},
        )

    def render(self) -> Any:
        """Return a picture (32, 32, 3) with the point in white."""
        frame = np.zeros((32, 32, 3), np.uint8)
        column, row = np.clip(16 + 5 * self._state[:2] * (1, -1), 0, 31).astype(int)
        frame[row, column] = 255
        return frame


def toy_expert(task: str) -> Callable[[State], Action]:
    """Return the expert of a toy task: it moves in the right direction at full speed."""
    direction = np.array(_DIRECTIONS[task], np.float32)
    return lambda _: direction


def _sign(column: int) -> Callable[[State], NDArray[np.int64]]:
    """Return a function that tells on which side of the marker the point is, along a column of the state."""

    def answer(state: State) -> NDArray[np.int64]:
        difference = state[:, column] - state[:, column + 2]
        return np.where(np.abs(difference) < 0.1, -1, difference > 0).astype(np.int64)

    return answer


TOY_QUESTIONS = (
    QuestionKind("side", ("on which side of the target is it",), ("left", "right"), _sign(0)),
    QuestionKind("height", ("is it above or below the target",), ("below", "above"), _sign(1)),
)


def _toy_task(name: str, *instructions: str) -> Task:
    return Task(name, "toy", instructions, 12, "clbench.testing:ToyWorld", "clbench.testing:toy_expert")


TOY = Scenario(
    id="clbench/Toy-v0",
    description="A point on a plane; for tests.",
    retained=(_toy_task("left", "go left", "move to the left"), _toy_task("up", "go up", "move up")),
    target=(_toy_task("right", "go right", "move to the right"), _toy_task("down", "go down", "move down")),
    held_out=(_toy_task("up_left", "go up and left"),),
    questions="clbench.testing:TOY_QUESTIONS",
    budget=Budget(
        demonstrations=10,
        question_episodes=40,
        test_questions=100,
        pretraining_steps=150,
        pretraining_learning_rate=2e-3,
        adaptation_steps=60,
        learning_rate=1e-3,
        batch_size=16,
        policy_width=32,
        policy_layers=1,
        evaluation_points=3,
        validation_episodes=4,
        test_episodes=6,
        curve_episodes=3,
    ),
)
