"""The controller of the arm: robosuite's OSC_POSE with LIBERO's settings, and the gripper.

The inputs of the physics follow from an action as in `controllers/osc.py`, `controllers/config/osc_pose.json`
and `models/grippers/panda_gripper.py` of robosuite 1.4.0. Operations and layouts in memory are the same, so
results are equal bit for bit. Two differences save time:

1. robosuite computes the dynamics before the controller, again inside it, and a third time in the physics
   step. Once is enough: `mj_step1` computes the positions, velocities, inertia and bias forces that the
   controller needs, and `mj_step2` continues from there.
2. An action, 25 physics steps with the controller between their halves, is one compiled function that calls
   MuJoCo's library and releases the interpreter lock. From Python, calls and the lock took two fifths of a
   step, and a second thread made it only 1.4 times as fast.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from .original import njit, nullspace_torques, opspace_matrices, orientation_error, set_goal_orientation

Vector = NDArray[np.float64]

SUBSTEPS = 25
"""Physics steps of 2 ms per action: 20 actions per second."""
JOINTS = 7
"""Number of joints of the arm. They come first in every model; those of the two fingers follow."""
REST = np.array([0.0, -1.61037389e-01, 0.0, -2.44459747, 0.0, 2.2267522, np.pi / 4])
"""Joint positions at which LIBERO's robots begin, and to which the redundant joint is drawn (7,)."""
SCALE = np.array([0.05, 0.05, 0.05, 0.5, 0.5, 0.5])
"""Displacement of the hand's goal for an action of 1, in metres and radians (6,)."""
STIFFNESS, DAMPING = 150.0, 2 * math.sqrt(150.0)
"""Gains on the errors of position and orientation, and on the velocities; the damping is critical."""
FINGERS = (-1.0, 1.0)
"""Directions in which the two fingers close."""
FINGER_SPEED = 0.01
"""Change of a finger's control in a physics step, as a share of half its range."""
SITE = "gripper0_grip_site"
"""The point between the finger tips that the controller moves."""


def _compiled_physics() -> tuple[Any, ...]:
    """Return `mj_step1`, `mj_step2`, `mj_fullM` and `mj_jacSite` for compiled code, which passes addresses.

    In compiled code, an error of MuJoCo ends the process; from Python it would raise.
    """
    import numba  # robosuite brings it, which `original` finds or asks for
    from llvmlite.binding import load_library_permanently

    types: Any = numba.types
    folder = Path(mujoco.__file__).parent
    (library,) = [*folder.glob("libmujoco.*"), *folder.glob("mujoco.dll")]
    load_library_permanently(str(library))  # Python's functions call the same one
    both, address = (types.uintp, types.uintp), types.uintp
    return (
        types.ExternalFunction("mj_step1", types.void(*both)),
        types.ExternalFunction("mj_step2", types.void(*both)),
        types.ExternalFunction("mj_fullM", types.void(*both, address)),
        types.ExternalFunction("mj_jacSite", types.void(*both, address, address, types.int32)),
    )


_step1, _step2, _full_inertia, _jacobian = _compiled_physics()


class Sensed(NamedTuple):
    """What the controller reads from the physics, apart from the bias forces."""

    place: Vector
    """Position of the hand (3,)."""
    axes: Vector
    """Orientation of the hand (3, 3)."""
    jacobian: Vector
    """Jacobian of the position, then of the orientation (6, nv)."""
    inertia: Vector
    """Inertia of all joints (nv, nv)."""
    speeds: Vector
    """Velocities of all joints (nv,)."""
    joints: Vector
    """Positions of the arm's joints (7,)."""


class Aim(NamedTuple):
    """The goals of the controller in an action."""

    place: Vector
    """Goal of the hand's position (3,)."""
    axes: Vector
    """Goal of the hand's orientation (3, 3)."""
    closing: Vector
    """Shares to which the fingers are closed (2,), which each physics step changes."""
    direction: float
    """1 to close the fingers, -1 to open them, 0 to leave them."""


class Motors(NamedTuple):
    """What the controller sets, and what it must know to do so: views of the physics."""

    bias: Vector
    """Bias forces of the joints (7,)."""
    limits: Vector
    """Lowest and highest controls (9, 2)."""
    controls: Vector
    """The controls (9,)."""


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator, unused-ignore]  # typed where numba is
def _drive(sensed: Sensed, aim: Aim, motors: Motors) -> None:
    """Set the controls of a physics step: torques of the joints, and places of the fingers.

    Matrices have the memory layout of robosuite's, column by column: another layout changes the last bit.
    """
    jacobian, speeds = sensed.jacobian, sensed.speeds
    of_both = jacobian[:, :JOINTS].T.copy().T
    of_place, of_axes = jacobian[:3, :JOINTS].T.copy().T, jacobian[3:, :JOINTS].T.copy().T
    inertia = sensed.inertia[:JOINTS, :JOINTS].T.copy().T
    _, place_mass, axes_mass, null_space = opspace_matrices(inertia, of_both, of_place, of_axes)
    force = (aim.place - sensed.place) * STIFFNESS - np.dot(jacobian[:3], speeds) * DAMPING
    turn = orientation_error(aim.axes, sensed.axes)
    torque = turn * STIFFNESS - np.dot(jacobian[3:], speeds) * DAMPING
    wrench = np.concatenate((np.dot(place_mass, force), np.dot(axes_mass, torque)))
    to_rest = nullspace_torques(inertia, null_space, REST, sensed.joints, speeds[:JOINTS].copy())
    controls, limits, closing = motors.controls, motors.limits, aim.closing
    controls[:JOINTS] = np.dot(of_both.T, wrench) + motors.bias + to_rest
    for joint in range(JOINTS):
        controls[joint] = min(max(controls[joint], limits[joint, 0]), limits[joint, 1])
    for finger in range(2):
        low, high = limits[JOINTS + finger]
        moved = closing[finger] + FINGERS[finger] * FINGER_SPEED * aim.direction
        closing[finger] = min(max(moved, -1.0), 1.0)
        controls[JOINTS + finger] = 0.5 * (high + low) + 0.5 * (high - low) * closing[finger]


@njit(nogil=True, cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def _finish(model: int, data: int, site: int, sensed: Sensed, aim: Aim, motors: Motors) -> None:
    """Do the rest of an action, from the second half of its first physics step.

    Args:
        model: Address of the scene.
        data: Address of the episode's physics.
        site: Number of the point that the controller moves.
        sensed: The episode's own views and buffers, which change with the physics.
        aim: Goals of the action.
        motors: The episode's motors.
    """
    _step2(model, data)
    for _ in range(SUBSTEPS - 1):
        _step1(model, data)
        _jacobian(model, data, sensed.jacobian.ctypes.data, sensed.jacobian[3:].ctypes.data, site)
        _full_inertia(model, data, sensed.inertia.ctypes.data)
        _drive(sensed, aim, motors)
        _step2(model, data)


class Arm:
    """The controller in one episode.

    Args:
        model: Compiled scene.
        data: Physics of the episode.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        site = int(model.site(SITE).id)
        self._data, self._site = data, site
        self._now = Sensed(
            data.site_xpos[site],
            data.site_xmat[site].reshape(3, 3),
            np.zeros((6, model.nv)),
            np.zeros((model.nv, model.nv)),
            data.qvel,
            data.qpos[:JOINTS],
        )
        self._motors = Motors(data.qfrc_bias[:JOINTS], model.actuator_ctrlrange.copy(), data.ctrl)

    def begin(self, rest: Sensed) -> None:
        """Begin an episode: the goal of the hand is its place at rest.

        The first physics step of an episode uses what was sensed at rest, wherever the episode puts the arm.
        So does robosuite, whose controller senses the arm before LIBERO sets the initial state.
        """
        self._first: Sensed | None = rest
        self._goal, self._goal_axes = rest.place, rest.axes
        self._closing = np.zeros(2)

    def follow(self, other: Arm) -> None:
        """Take over the goals of another controller."""
        self._first, self._goal, self._goal_axes = other._first, other._goal, other._goal_axes
        self._closing = other._closing.copy()

    def sense(self, model: mujoco.MjModel) -> Sensed:
        """Return what the controller reads now: views and buffers, which change with the physics."""
        now = self._now
        mujoco.mj_jacSite(model, self._data, now.jacobian[:3], now.jacobian[3:], self._site)
        mujoco.mj_fullM(model, self._data, now.inertia)
        return now

    def move(self, model: mujoco.MjModel, action: NDArray[np.float32]) -> None:
        """Advance the physics by an action.

        Args:
            model: Scene of the episode, or its copy.
            action: Displacement of the hand's goal and closing of the fingers (7,), in [-1, 1].
        """
        mujoco.mj_step1(model, self._data)
        sensed = self._first or self.sense(model)
        self._first = None
        displacement = action[:6] * SCALE
        self._goal = sensed.place + displacement[:3]
        if displacement[3:].any():  # robosuite keeps the goal of an earlier action otherwise
            self._goal_axes = set_goal_orientation(displacement[3:], sensed.axes)
        aim = Aim(self._goal, self._goal_axes, self._closing, float(np.sign(action[6])))
        _drive(sensed, aim, self._motors)
        _finish(model._address, self._data._address, self._site, self._now, aim, self._motors)
