"""The scenario clbench/PointMaze-v0: the instruction names the maze and the room where the ball must stop."""

from __future__ import annotations

from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

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
"""Names of each room in the instructions: plain, by the sides of the maze, and by compass."""


def _task(colour: str, room: str) -> Task:
    plain, edge, compass = _WORDS[room]
    return Task(
        name=f"{colour}_{room}",
        suite="point_maze",
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
        seed_name="point-maze",
    )


SCENARIO = Scenario(
    id="clbench/PointMaze-v0",
    description="A ball learns the way to four rooms in two mazes, after eight rooms in three mazes.",
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
"""Eight rooms to keep, four to learn, and two held-out rooms whose names were learned in other mazes."""
