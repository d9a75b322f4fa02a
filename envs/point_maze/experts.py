"""The expert of the PointMaze world: it acts on the state alone, and so can label noisy episodes."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .mazes import MAZES
from .rules import goal_of
from .state import COLOUR, PLACE, VELOCITY, State

Action: TypeAlias = NDArray[np.float32]

SPEED = 2.5
"""Speed on the way, in metres per second: a quarter of a cell per step, slow enough to turn within a cell."""
APPROACH = 2.5
"""Speed near the goal, per metre of remaining way, in 1/s."""
GAIN = 0.25
"""Action per metre per second of error: 0.42 would correct all of it in one step; less is easier to clone."""


def expert(task: str) -> Callable[[State], Action]:
    """Return the expert of the task, which maps a state (11,) to an action (2,).

    It takes the shortest way to the task's room, through the maze that the state shows.

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
    """
    return functools.partial(_act, goal_of(task).room)


def _act(room: str, state: State) -> Action:
    maze = tuple(MAZES.values())[int(state[COLOUR].argmax())]
    x, y = state[PLACE].tolist()
    point, metres = maze.way((x, y), room)
    towards = np.subtract(point, (x, y))
    speed = min(SPEED, APPROACH * metres)
    wish = towards * (speed / max(math.hypot(*towards), 1e-6))
    action: Action = np.clip(GAIN * (wish - state[VELOCITY]), -1.0, 1.0).astype(np.float32)
    return action
