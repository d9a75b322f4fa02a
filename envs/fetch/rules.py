"""The tasks of the Fetch world: where things lie at the start, the success condition, and the distance to it.

Things that a task does not need lie in a corner of the table. As in most real scenes, the state therefore
tells a policy something about the task.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from .state import BLOCK, BLOCK_FROM_GRIPPER, FINGERS, GRIPPER, GRIPPER_VELOCITY, REST_HEIGHT, TARGET

SUCCESS_BONUS = 1.0
"""Added to the reward of the successful step; the rest of the reward is minus the remaining metres."""

HOVER_HEIGHT = 0.12
"""Height in metres at which the gripper hovers above a thing. A grasp comes down from a lower place, so it
does not hover by chance."""
PRESS_HEIGHT = 0.047
"""Largest height in metres of the gripper above the block's centre in a press. The finger tips reach 0.0185
below the gripper, and touch the top of the block at 0.0435."""
LIFT_HEIGHT = 0.10
CARRY_DISTANCE = 0.10
"""Metres by which a held block is carried toward the robot."""
PUSH_DISTANCE = 0.10
PUSH_CONE = 0.4
"""Largest sideways error of a push per metre, 21.8 degrees: a diagonal push must not count as straight."""
NEAR = 0.05
"""Distance in metres below which the gripper or the block counts as at the target, as in Fetch's tasks."""
CLOSED = 0.02
"""Opening of both fingers in metres below which the gripper is closed; an empty one closes to 0.00."""
OPEN = 0.08
"""Opening of both fingers in metres above which the gripper is open; it opens to 0.10."""

Numbers: TypeAlias = list[float]
"""A state (28,) as plain numbers: for so few, NumPy takes three times as long."""
Condition: TypeAlias = Callable[[Numbers, Numbers], bool]
Distance: TypeAlias = Callable[[Numbers, Numbers], float]


@dataclass(frozen=True)
class Layout:
    """Where things are at the start of an episode, if not in front of the gripper."""

    block_aside: bool = False
    """Whether the block lies in a corner of the table."""
    target_aside: bool = False
    """Whether the target is in another corner."""
    block_held: bool = False
    """Whether the gripper holds the block, at the height where it starts."""


@dataclass(frozen=True)
class Rule:
    """The definition of one task. The functions take a state and the state at the start."""

    success: Condition
    """Returns whether the task is done."""
    distance: Distance
    """Returns the distance in metres that the gripper and the block still have to move."""
    target_on_table: bool = False
    """Whether the target is always on the table; otherwise it is there in half of the episodes."""
    layout: Layout = Layout()
    """Where things are at the start."""

    def judge(self, state: Numbers, start: Numbers) -> tuple[float, bool]:
        """Return the reward and whether the task is done.

        The reward is minus the remaining distance in metres, plus `SUCCESS_BONUS` on success.
        """
        success = self.success(state, start)
        return SUCCESS_BONUS * success - self.distance(state, start), success


def opening(state: Numbers) -> float:
    """Return the opening of both fingers in metres: 0 closed, 0.05 around the block, 0.10 open."""
    right, left = state[FINGERS]
    return right + left


def _gripper_to(state: Numbers, thing: slice, height: float) -> float:
    """Return the distance from the gripper to the point `height` above a thing, in metres."""
    x, y, z = state[thing]
    return math.dist(state[GRIPPER], (x, y, z + height))


def _block_to_target(state: Numbers) -> float:
    return math.dist(state[BLOCK], state[TARGET])


def _held(state: Numbers) -> bool:
    return math.hypot(*state[BLOCK_FROM_GRIPPER]) < 0.03 and CLOSED < opening(state) < OPEN


def _still(state: Numbers) -> bool:
    """Return whether the gripper moves less than 1 cm per step, a third of its full speed."""
    return math.hypot(*state[GRIPPER_VELOCITY]) < 0.01


def _reach() -> Rule:
    def success(state: Numbers, _: Numbers) -> bool:
        return _gripper_to(state, TARGET, 0.0) < NEAR and opening(state) < CLOSED and _still(state)

    return Rule(success, lambda state, _: _gripper_to(state, TARGET, 0.0) + opening(state))


def _hover(thing: slice) -> Rule:
    def success(state: Numbers, _: Numbers) -> bool:
        return _gripper_to(state, thing, HOVER_HEIGHT) < 0.03 and opening(state) > OPEN and _still(state)

    return Rule(
        success, lambda state, _: _gripper_to(state, thing, HOVER_HEIGHT) + max(0.0, 0.1 - opening(state))
    )


def _press() -> Rule:
    def success(state: Numbers, _: Numbers) -> bool:
        x, y, z = state[BLOCK_FROM_GRIPPER]
        return math.hypot(x, y) < 0.015 and 0.0 < -z < PRESS_HEIGHT and opening(state) < CLOSED

    return Rule(success, lambda state, _: _gripper_to(state, BLOCK, PRESS_HEIGHT) + opening(state))


def _pick_and_place() -> Rule:
    def success(state: Numbers, _: Numbers) -> bool:
        return _block_to_target(state) < NEAR and _held(state)

    return Rule(success, lambda state, _: _gripper_to(state, BLOCK, 0.0) + _block_to_target(state))


def _push() -> Rule:
    def success(state: Numbers, _: Numbers) -> bool:
        return _block_to_target(state) < NEAR and opening(state) < CLOSED

    return Rule(
        success,
        lambda state, _: _gripper_to(state, BLOCK, 0.0) + _block_to_target(state),
        target_on_table=True,
    )


def _push_along(x: float, y: float) -> Rule:
    """Return the rule for pushing the block over the table along the direction (x, y), of length 1."""

    def way(state: Numbers, start: Numbers) -> tuple[float, float]:
        # in single precision, as the states are
        dx, dy = (np.float32(state[BLOCK][axis] - start[BLOCK][axis]).item() for axis in (0, 1))
        return x * dx + y * dy, abs(x * dy - y * dx)

    def success(state: Numbers, start: Numbers) -> bool:
        along, across = way(state, start)
        on_table = abs(state[BLOCK][2] - REST_HEIGHT) < 0.02
        return along > PUSH_DISTANCE and across < PUSH_CONE * along and on_table and opening(state) < CLOSED

    def distance(state: Numbers, start: Numbers) -> float:
        along, across = way(state, start)
        return _gripper_to(state, BLOCK, 0.0) + max(0.0, PUSH_DISTANCE - along) + across

    return Rule(success, distance)


def _lift() -> Rule:
    def height(state: Numbers) -> float:
        return state[BLOCK][2] - REST_HEIGHT

    return Rule(
        lambda state, _: height(state) > LIFT_HEIGHT and _held(state),
        lambda state, _: _gripper_to(state, BLOCK, 0.0) + max(0.0, LIFT_HEIGHT - height(state)),
        # carrying the block to a target on the table stays below 0.06, and so does not lift it
        target_on_table=True,
    )


def _carry_back() -> Rule:
    def way(state: Numbers, start: Numbers) -> float:
        return start[BLOCK][0] - state[BLOCK][0]

    def success(state: Numbers, start: Numbers) -> bool:
        return way(state, start) > CARRY_DISTANCE and CLOSED < opening(state) < OPEN

    return Rule(success, lambda state, start: max(0.0, CARRY_DISTANCE - way(state, start)))


_RULES = {
    "reach": _reach(),
    "hover": _hover(BLOCK),
    "pick_and_place": _pick_and_place(),
    "push": _push(),
    "push_left": _push_along(0.0, 1.0),
    "push_away": _push_along(1.0, 0.0),
    "lift": _lift(),
    "push_right": _push_along(0.0, -1.0),
    "pull": _push_along(-1.0, 0.0),
    "press": _press(),
    "carry_back": _carry_back(),
    "hover_target": _hover(TARGET),
    "push_left_away": _push_along(math.sqrt(0.5), math.sqrt(0.5)),
}

_LAYOUTS = {
    Layout(block_aside=True): ("reach", "hover_target"),
    Layout(target_aside=True): (
        "hover",
        "push_left",
        "push_away",
        "push_right",
        "press",
        "lift",
        "push_left_away",
    ),
    Layout(target_aside=True, block_held=True): ("carry_back",),
    Layout(): ("pick_and_place", "push", "pull"),
}
"""Tasks by what is in front of the gripper: the target, the block, the block between the fingers, or both."""

RULES: dict[str, Rule] = {
    name: replace(_RULES[name], layout=layout) for layout, names in _LAYOUTS.items() for name in names
}
"""The rule of each task, by name."""
