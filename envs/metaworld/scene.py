"""The scenes of the Meta-World world: one compiled model per task, shared by all its episodes."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from numpy.typing import NDArray

from clbench.worlds.perturbation import with_mass
from clbench.worlds.threads import Copies

Vector = NDArray[np.float64]

CAMERA = {"distance": 1.4, "azimuth": 135.0, "elevation": -30.0, "lookat": np.array([0.0, 0.6, 0.15])}
"""A view from the right behind the robot, above the table."""


@dataclass(frozen=True)
class Scene:
    """The compiled scene of a task, shared by all its episodes in a process."""

    model: mujoco.MjModel
    body_pos: Vector
    """Compiled places of the bodies, (bodies, 3); an episode begins by moving some of them."""
    site_pos: Vector
    """Compiled places of the sites, (sites, 3)."""
    start: mujoco.MjData
    """The physics with the hand at its start."""
    models: Copies[tuple[mujoco.MjModel, Vector, Vector]] = field(init=False)
    """The model with views of its places, for threads that advance episodes at the same time: each moves the
    bodies in its own copy, of 19 MB. Making the views anew in each step would cost time."""

    def __post_init__(self) -> None:
        model = self.model
        copies = Copies(_with_views(model), lambda: _with_views(copy.copy(model)))
        object.__setattr__(self, "models", copies)

    def with_mass(self, mass: float) -> Scene:
        """Return the scene with all movable objects `mass` times as heavy."""
        model = copy.copy(self.model)
        model.body_pos[:], model.site_pos[:] = self.body_pos, self.site_pos  # episodes move them
        return replace(self, model=with_mass(model, _things(model), mass))


def scene_of(original: type[SawyerXYZEnv]) -> Scene:
    """Compile the scene of Meta-World's environment of a task, and move the hand to its start."""
    env: Any = original()
    env._reset_hand()
    model = env.model
    return Scene(model, model.body_pos.copy(), model.site_pos.copy(), env.data)


def _with_views(model: mujoco.MjModel) -> tuple[mujoco.MjModel, Vector, Vector]:
    return model, model.body_pos, model.site_pos


def _things(model: mujoco.MjModel) -> list[int]:
    """Return the movable bodies that are not part of the robot."""
    robot, moved = model.body("base").id, model.body_weldid != 0
    return [int(body) for body in np.flatnonzero(moved & (model.body_rootid != robot))]
