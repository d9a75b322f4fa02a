"""The scene of the Fetch world: FetchPickAndPlace-v4 with its arm moved to the start."""

from __future__ import annotations

import contextlib
import functools
import io
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.perturbation import with_mass

# otherwise each worker prints a notice about Adroit's hand, which is not used here
with contextlib.redirect_stderr(io.StringIO()):
    import gymnasium_robotics
    from gymnasium_robotics.envs.fetch.pick_and_place import MujocoFetchPickAndPlaceEnv
    from gymnasium_robotics.utils.rotations import mat2euler

CAMERA = {"distance": 1.2, "azimuth": 60.0, "elevation": -25.0, "lookat": np.array([1.3, 0.75, 0.56])}
"""A view from the right beside the robot: left is left, away goes right, small pictures show the block."""

__all__ = ["CAMERA", "Scene", "mat2euler", "scene", "scene_file", "scene_with_mass"]


@dataclass(frozen=True)
class Scene:
    """The compiled scene with its constants. All worlds of a process share it and only read it."""

    model: mujoco.MjModel
    time: float
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    gripper: NDArray[np.float64]
    """Position of the gripper at the start (3,)."""
    rest_height: float
    step_seconds: float
    substeps: int
    gripper_site: int
    block_site: int
    target_site: int
    hand_body: int
    block_qpos: int
    fingers_qpos: NDArray[np.int64]
    """Addresses of the right and the left finger (2,)."""
    fingers_qvel: NDArray[np.int64]
    actuators_qpos: NDArray[np.int64]
    """Addresses of the joints that the actuators move (2,)."""


@functools.cache
def scene() -> Scene:
    """Return the scene; this takes 0.2 s, once per process."""
    original = MujocoFetchPickAndPlaceEnv()
    model = original.model

    def site(name: str) -> int:
        return int(model.site(name).id)

    # hide the green beams, 2 m long, that mark the goal of the hand
    model.geom_rgba[model.body_mocapid[model.geom_bodyid] >= 0, 3] = 0.0
    fingers = [model.joint(f"robot0:{side}_gripper_finger_joint") for side in ("r", "l")]
    return Scene(
        model=model,
        time=original.initial_time,
        qpos=original.initial_qpos,
        qvel=original.initial_qvel,
        gripper=original.initial_gripper_xpos,
        rest_height=float(original.height_offset),
        step_seconds=original.dt,
        substeps=original.n_substeps,
        gripper_site=site("robot0:grip"),
        block_site=site("object0"),
        target_site=site("target0"),
        hand_body=int(model.body("robot0:gripper_link").id),
        block_qpos=int(model.joint("object0:joint").qposadr[0]),
        fingers_qpos=np.array([finger.qposadr[0] for finger in fingers]),
        fingers_qvel=np.array([finger.dofadr[0] for finger in fingers]),
        actuators_qpos=model.jnt_qposadr[model.actuator_trnid[:, 0]].astype(np.int64),
    )


@functools.cache
def scene_with_mass(mass: float) -> Scene:
    """Return the scene whose block is `mass` times as heavy; all perturbed worlds share it."""
    model = scene().model
    return replace(scene(), model=with_mass(model, [int(model.body("object0").id)], mass))


def scene_file() -> Path:
    """Return the source file of the scene."""
    return Path(gymnasium_robotics.__file__).parent / "envs/assets/fetch/pick_and_place.xml"
