"""The experts of the Fetch world: each acts on the state alone, and so can label noisy episodes."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown

from .rules import HOVER_HEIGHT, OPEN, opening
from .state import BLOCK, GRIPPER, REST_HEIGHT, TARGET, State

Action: TypeAlias = NDArray[np.float32]
Vector: TypeAlias = NDArray[np.float64]

GAIN = 10.0
"""Action per metre of error: 20 would correct all of it in one step; slower is easier to clone."""
CLOSE, OPEN_UP = -1.0, 1.0
PRESS_DEPTH = 0.035
"""Height in metres above the block's centre that a press aims at: the fingers touch at 0.0435."""
CARRYING = 0.6
"""Action that carries a held block, small enough that the block does not slip."""
TRAVEL_HEIGHT = 0.11
"""Height in metres at which the closed gripper travels above a place, clear of the block, as at its start."""
UP = np.array([0.0, 0.0, 1.0])
BEHIND = 0.07
"""Distance in metres from the block at which the closed gripper comes down: it touches at 0.040 to 0.056."""


def expert(task: str) -> Callable[[State], Action]:
    """Return the expert of the task, which maps a state (28,) to an action (4,).

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
    """
    if task not in _EXPERTS:
        raise unknown("expert of the Fetch world", task, _EXPERTS)
    return _EXPERTS[task]


def _action(velocity: Vector, fingers: float) -> Action:
    action: Action = np.clip(np.append(velocity, fingers), -1.0, 1.0).astype(np.float32)
    return action


def _toward(state: State, place: Vector, fingers: float) -> Action:
    """Return the action that moves the gripper straight to a place (3,)."""
    return _action(GAIN * (place - state[GRIPPER]), fingers)


def _descend(state: State, place: Vector, clearance: float, fingers: float) -> Action:
    """Return the action that brings the gripper down on a place (3,) from `clearance` metres above.

    The gripper follows a funnel: the farther it is from the place in the plane, the higher it goes. Below the
    funnel it rises first, so that it passes over the block and not through it.
    """
    error = place - state[GRIPPER]
    height = min(max(4.0 * (math.hypot(error[0], error[1]) - 0.012), 0.0), clearance)
    error[2] += height
    error[:2] *= min(max(1.0 - (error[2] - 0.02) / 0.03, 0.0), 1.0)
    return _action(GAIN * error, fingers)


def _hover(state: State, thing: slice) -> Action:
    return _toward(state, state[thing].astype(np.float64) + HOVER_HEIGHT * UP, OPEN_UP)


def _reach(state: State) -> Action:
    return _toward(state, state[TARGET].astype(np.float64), CLOSE)


def _press(state: State) -> Action:
    """Return the action that presses on the top of the block, aiming a little below its surface."""
    return _descend(state, state[BLOCK].astype(np.float64) + PRESS_DEPTH * UP, 0.06, CLOSE)


def _grasp(state: State) -> Action | None:
    """Return the action that grasps the block, or None if the gripper holds it."""
    block = state[BLOCK].astype(np.float64)
    x, y, z = (block - state[GRIPPER]).tolist()
    apart = opening(state.tolist())
    if math.hypot(x, y) < 0.02 and abs(z) < 0.02:
        return None if apart < 0.06 else _toward(state, block, CLOSE)
    clearance = 0.06 if apart > OPEN else 0.08
    if apart < OPEN and math.hypot(x, y) < 0.04:
        # fingers that are not open yet would come down on the block
        return _toward(state, block + clearance * UP, OPEN_UP)
    return _descend(state, block, clearance, OPEN_UP)


def _pick_and_place(state: State) -> Action:
    """Return the action that carries the block to the target, above the table rather than along it."""
    action = _grasp(state)
    if action is not None:
        return action
    error = state[TARGET].astype(np.float64) - state[BLOCK]
    error[2] += min(0.5 * max(math.hypot(error[0], error[1]) - 0.02, 0.0), 0.04)
    return _action(GAIN * error, CLOSE)


def _lift(state: State) -> Action:
    """Return the action that grasps the block and raises it."""
    action = _grasp(state)
    return _action(UP, CLOSE) if action is None else action


def _carry_back(state: State) -> Action:
    """Return the action that carries the held block toward the robot, two centimetres per step."""
    return _action(np.array([-CARRYING, 0.0, 0.0]), CLOSE)


def _push(state: State, direction: Vector) -> Action:
    """Return the action that pushes the block along a direction (2,) of length 1 with the closed gripper."""
    block, gripper = state[BLOCK].astype(np.float64), state[GRIPPER].astype(np.float64)
    offset = gripper[:2] - block[:2]
    along = float(offset @ direction)
    across = offset - along * direction
    low = gripper[2] < REST_HEIGHT + 0.03
    if low and -0.12 < along < -0.02 and math.hypot(across[0], across[1]) < 0.025:
        velocity = 0.6 * direction - GAIN * across
        return _action(np.append(velocity, GAIN * (REST_HEIGHT - gripper[2])), CLOSE)
    place = np.append(block[:2] - BEHIND * direction, REST_HEIGHT)
    return _descend(state, place, TRAVEL_HEIGHT, CLOSE)


def _push_to_target(state: State) -> Action:
    way = (state[TARGET] - state[BLOCK])[:2].astype(np.float64)
    return _push(state, way / max(float(np.linalg.norm(way)), 1e-6))


def _push_along(x: float, y: float) -> Callable[[State], Action]:
    return functools.partial(_push, direction=np.array([x, y]))


_EXPERTS: dict[str, Callable[[State], Action]] = {
    "reach": _reach,
    "hover": functools.partial(_hover, thing=BLOCK),
    "pick_and_place": _pick_and_place,
    "push": _push_to_target,
    "push_left": _push_along(0.0, 1.0),
    "push_away": _push_along(1.0, 0.0),
    "lift": _lift,
    "push_right": _push_along(0.0, -1.0),
    "pull": _push_along(-1.0, 0.0),
    "press": _press,
    "carry_back": _carry_back,
    "hover_target": functools.partial(_hover, thing=TARGET),
    "push_left_away": _push_along(math.sqrt(0.5), math.sqrt(0.5)),
}
