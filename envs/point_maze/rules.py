"""The goal of each task of the PointMaze world, its reward and its condition of success."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clbench.base.entry_points import unknown

from .mazes import MAZES, ROOMS, Maze, centre
from .state import PLACE, VELOCITY, State

NEAR = 0.45
"""Distance in metres to the centre of the room below which the ball is in it, as in PointMaze."""
SLOW = 0.5
"""Speed in metres per second below which the ball counts as stopped, not just passing through the room."""
SUCCESS_BONUS = 1.0
"""Added to the reward of the successful step; the rest of the reward is minus the remaining way in metres."""


@dataclass(frozen=True)
class Goal:
    """The room of a maze in which the ball must stop."""

    maze: Maze
    room: str

    def judge(self, state: State) -> tuple[float, bool]:
        """Return the reward in a state (11,), and whether the ball has stopped in the room."""
        x, y = state[PLACE].tolist()
        there = math.dist((x, y), centre(ROOMS[self.room])) < NEAR
        success = there and math.hypot(*state[VELOCITY].tolist()) < SLOW
        _, metres = self.maze.way((x, y), self.room)
        return SUCCESS_BONUS * success - metres, success


GOALS: dict[str, Goal] = {
    f"{colour}_{room}": Goal(maze, room) for colour, maze in MAZES.items() for room in ROOMS
}
"""The goal of each task by name; every room of every maze is a task."""


def goal_of(task: str) -> Goal:
    """Return the goal of a task.

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
    """
    if task not in GOALS:
        raise unknown("task of the PointMaze world", task, GOALS)
    return GOALS[task]
