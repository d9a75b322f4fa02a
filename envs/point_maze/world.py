"""The PointMaze world as one Gymnasium environment: a ball that actions push through a maze."""

from __future__ import annotations

from clbench.worlds.world import MujocoWorld

from .physics import PointMazeVectorWorld
from .rules import GOALS


class PointMazeWorld(MujocoWorld):
    """A `PointMazeVectorWorld` with one lane; that class documents states, actions and rewards."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    vector_world = PointMazeVectorWorld
    first_task = next(iter(GOALS))
