"""The PointMaze scenario: a ball, three mazes of nine rooms, and words that say in which room to stop."""

from __future__ import annotations

from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

__all__ = ["SCENARIO"]

_WORDS = {
    "upper_left": ("upper left", "top left", "north west"),
    "upper": ("upper middle", "top middle", "north"),
    "upper_right": ("upper right", "top right", "north east"),
    "left": ("left", "left side", "west"),
    "right": ("right", "right side", "east"),
    "lower_left": ("lower left", "bottom left", "south west"),
    "lower": ("lower middle", "bottom middle", "south"),
    "lower_right": ("lower right", "bottom right", "south east"),
}
"""What each room is called."""


def _task(colour: str, room: str) -> Task:
    plain, edge, compass = _WORDS[room]
    return Task(
        name=f"{colour}_{room}",
        suite="point-maze",
        instructions=(
            f"go to the {plain} room of the {colour} maze",
            f"roll into the {edge} room of the {colour} maze",
            f"in the {colour} maze stop in the {compass} room",
            f"find the {plain} room in the {colour} maze and stay there",
        ),
        horizon=60,
        world="clbench.envs.point_maze.world:PointMazeWorld",
        expert="clbench.envs.point_maze.experts:expert",
        packages=("gymnasium-robotics",),
    )


SCENARIO = Scenario(
    id="clbench/PointMaze-v0",
    description="A ball learns the way to four rooms of two mazes, after eight rooms of three.",
    retained=(
        _task("red", "upper_left"),
        _task("red", "lower_right"),
        _task("red", "left"),
        _task("blue", "upper_right"),
        _task("blue", "lower_left"),
        _task("blue", "upper"),
        _task("green", "upper_left"),
        _task("green", "lower_right"),
    ),
    target=(
        _task("red", "upper_right"),
        _task("blue", "lower_right"),
        _task("red", "lower_left"),
        _task("blue", "upper_left"),
    ),
    held_out=(
        _task("green", "upper_right"),
        _task("green", "lower_left"),
    ),
    questions="clbench.envs.point_maze.questions:QUESTIONS",
)
"""Eight rooms to keep, four to learn the way to, and two whose words are known, but not in their maze."""
