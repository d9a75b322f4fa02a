"""The expert of the PointMaze world: it acts on the state alone, and so can label perturbed episodes."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .mazes import MAZES, goal_of
from .state import COLOUR, PLACE, VELOCITY, State

Action: TypeAlias = NDArray[np.float32]

SPEED = 2.5
"""Metres per second on the way: a quarter of a cell a step, and slow enough to turn within a cell."""
APPROACH = 2.5
"""Speed per metre that is left to go, near the goal."""
GAIN = 0.25
"""Action per metre per second of error: 0.42 would ask for all of it in one step; less is easier to clone."""


def expert(task: str) -> Callable[[State], Action]:
    """Return the expert of the task: it maps a state (11,) to an action (2,).

    It goes to the task's room by the shortest way through the maze that the state shows.

    Raises:
        LookupError: No task has this name; the nearest one is named.
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
