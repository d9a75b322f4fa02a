"""The scenes of the PointMaze world: the ball of gymnasium-robotics' PointMaze inside a maze."""

from __future__ import annotations

import functools
import importlib.util
from pathlib import Path

import mujoco
import numpy as np

from clbench.worlds.perturbation import with_mass

from .mazes import MAZES, SIZE, Cell, centre

TARGET = "target"
"""Name of the site that marks the goal in pictures."""

SUBSTEPS = 10
"""Physics steps of 0.01 s per action: PointMaze is made for 10 Hz."""

WALL_HEIGHT = 0.4
WALL_COLOURS = {"red": (0.70, 0.20, 0.15), "blue": (0.15, 0.30, 0.65), "green": (0.12, 0.45, 0.22)}
CAMERA = {"distance": 9.2, "azimuth": 90.0, "elevation": -90.0, "lookat": np.zeros(3)}
"""A view from above that shows the whole maze: left is left, and up is up."""

FLOOR, BALL, GOAL = (0.75, 0.75, 0.72), (0.10, 0.10, 0.10), (0.95, 0.75, 0.10)


@functools.cache
def scene(colour: str) -> mujoco.MjModel:
    """Return the compiled scene of a maze. All worlds of a process share it and only read it.

    It equals gymnasium-robotics' scene of the same map, but building it there would leave a file behind.
    """
    specification = mujoco.MjSpec.from_file(str(_point_file()))
    for cell in _walls(colour):
        x, y = centre(cell)
        specification.worldbody.add_geom(
            name=f"block_{cell[0] + 1}_{cell[1] + 1}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(x, y, WALL_HEIGHT / 2),
            size=(0.5, 0.5, WALL_HEIGHT / 2),
            contype=1,
            conaffinity=1,
            rgba=(*WALL_COLOURS[colour], 1.0),
        )
    specification.worldbody.add_site(
        name=TARGET,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=(0.0, 0.0, 0.0),
        size=(0.45, 0.01, 0.0),
        rgba=(*GOAL, 0.6),
    )
    model = specification.compile()
    model.geom("ground").matid = -1
    model.geom("ground").rgba = (*FLOOR, 1.0)
    model.site("particle_site").rgba = (*BALL, 1.0)
    return model


@functools.cache
def scene_with_mass(colour: str, mass: float) -> mujoco.MjModel:
    """Return the scene of a maze whose ball is `mass` times as heavy; all perturbed worlds share it."""
    model = scene(colour)
    return with_mass(model, [int(model.body("particle").id)], mass)


def _point_file() -> Path:
    """Return the file that describes the ball. Importing its package would load all its robots."""
    specification = importlib.util.find_spec("gymnasium_robotics")
    assert specification is not None
    assert specification.origin is not None
    return Path(specification.origin).parent / "envs" / "assets" / "point" / "point.xml"


def _walls(colour: str) -> list[Cell]:
    """Return the cells with walls, row by row, including those around the maze."""
    around = range(-1, SIZE + 1)
    return [(row, column) for row in around for column in around if (row, column) not in MAZES[colour].free]
