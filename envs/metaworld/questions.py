"""Questions about a state of the Meta-World world, answered from the state alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clbench.data.questions import Answers, QuestionKind, sign, which

from .state import GOAL, HAND, HAND_BEFORE, OBJECT, OBJECT_BEFORE, OPENING, State

MARGIN = 0.02
"""Smallest difference in metres, of places along an axis or of distances, at which there is an answer."""

Numbers = NDArray[np.float32]


def _outside(value: Numbers, high: float, low: float) -> Answers:
    """Return 0 where the value (N,) is above `high`, 1 where it is below `low`, else -1."""
    return which(value > high, value < low)


def _between(first: slice, second: slice, axis: int) -> Callable[[State], Answers]:
    """Return a rule that answers whether the first thing is further along an axis than the second."""
    return lambda states: sign(states[:, first][:, axis] - states[:, second][:, axis], MARGIN)


def _distance(states: State, first: slice, second: slice) -> Numbers:
    """Return the distances (N,) between two things."""
    distance: Numbers = np.linalg.norm(states[:, first] - states[:, second], axis=1)
    return distance


def _nearest(states: State) -> Answers:
    return sign(_distance(states, GOAL, HAND) - _distance(states, OBJECT, HAND), MARGIN)


def _touching(states: State) -> Answers:
    return sign(0.09 - _distance(states, OBJECT, HAND), MARGIN)


def _gripper_opening(states: State) -> Answers:
    return _outside(states[:, OPENING], 0.85, 0.65)


def _gripper_moving(states: State) -> Answers:
    return _outside(_distance(states, HAND, HAND_BEFORE), 0.004, 0.0015)


def _object_moving(states: State) -> Answers:
    return _outside(_distance(states, OBJECT, OBJECT_BEFORE), 0.002, 0.0005)


def _gripper_motion(axis: int) -> Callable[[State], Answers]:
    """Return a rule that answers which way the hand moves along an axis."""
    return lambda states: sign(states[:, HAND][:, axis] - states[:, HAND_BEFORE][:, axis], 0.002)


def _gripper_height(states: State) -> Answers:
    return _outside(states[:, HAND][:, 2], 0.17, 0.13)


def _object_height(states: State) -> Answers:
    return _outside(states[:, OBJECT][:, 2], 0.12, 0.08)


def _kind(
    name: str, answers: tuple[str, str], rule: Callable[[State], Answers], *wordings: str
) -> QuestionKind:
    return QuestionKind(name, wordings, answers, rule)


QUESTIONS: tuple[QuestionKind, ...] = (
    _kind(
        "object_side",
        ("right", "left"),
        _between(OBJECT, HAND, 0),
        "is the object left or right of the gripper",
        "on which side of the gripper is the object",
        "seen from the gripper is the object left or right",
    ),
    _kind(
        "object_depth",
        ("farther", "nearer"),
        _between(OBJECT, HAND, 1),
        "is the object nearer or farther than the gripper",
        "is the object nearer to the robot or farther than the gripper",
        "seen from the robot is the object nearer or farther",
    ),
    _kind(
        "object_level",
        ("above", "below"),
        _between(OBJECT, HAND, 2),
        "is the object above or below the level of the gripper",
        "is the object above the gripper or below it",
        "at what level is the object above or below the gripper",
    ),
    _kind(
        "target_side",
        ("right", "left"),
        _between(GOAL, HAND, 0),
        "is the target left or right of the gripper",
        "on which side of the gripper is the target",
        "seen from the gripper is the target left or right",
    ),
    _kind(
        "target_depth",
        ("farther", "nearer"),
        _between(GOAL, HAND, 1),
        "is the target nearer or farther than the gripper",
        "is the target nearer to the robot or farther than the gripper",
        "seen from the robot is the target nearer or farther",
    ),
    _kind(
        "target_level",
        ("above", "below"),
        _between(GOAL, HAND, 2),
        "is the target above or below the level of the gripper",
        "is the target above the gripper or below it",
        "at what level is the target above or below the gripper",
    ),
    _kind(
        "target_side_of_object",
        ("right", "left"),
        _between(GOAL, OBJECT, 0),
        "is the target left or right of the object",
        "on which side of the object is the target",
        "seen from the object is the target left or right",
    ),
    _kind(
        "nearest",
        ("object", "target"),
        _nearest,
        "which is nearer to the gripper the object or the target",
        "is the object or the target nearer to the gripper",
        "what is closest to the gripper the object or the target",
    ),
    _kind(
        "near_object",
        ("yes", "no"),
        _touching,
        "is the gripper near the object",
        "is the gripper close to the object",
        "is the object near the gripper",
    ),
    _kind(
        "gripper_opening",
        ("open", "closed"),
        _gripper_opening,
        "is the gripper open or closed",
        "are the fingers open or closed",
        "how is the gripper open or closed",
    ),
    _kind(
        "gripper_moving",
        ("yes", "no"),
        _gripper_moving,
        "is the gripper moving",
        "does the gripper move",
        "is the gripper in motion",
    ),
    _kind(
        "gripper_vertical",
        ("up", "down"),
        _gripper_motion(2),
        "is the gripper moving up or down",
        "does the gripper move up or down",
        "which way does the gripper move up or down",
    ),
    _kind(
        "gripper_lateral",
        ("right", "left"),
        _gripper_motion(0),
        "is the gripper moving left or right",
        "does the gripper move to the left or right",
        "which way does the gripper move left or right",
    ),
    _kind(
        "object_moving",
        ("yes", "no"),
        _object_moving,
        "is the object moving",
        "does the object move",
        "is the object in motion",
    ),
    _kind(
        "gripper_height",
        ("high", "low"),
        _gripper_height,
        "is the gripper high or low",
        "is the gripper high or low over the table",
        "how high is the gripper high or low",
    ),
    _kind(
        "object_height",
        ("high", "low"),
        _object_height,
        "is the object high or low",
        "is the object high or low over the table",
        "how high is the object high or low",
    ),
)
"""All kinds of questions about a state of the Meta-World world."""
