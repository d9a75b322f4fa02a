"""Questions about a state of the Fetch world, answered from the state alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clbench.data.questions import Answers, QuestionKind, sign, which

from .state import (
    BLOCK,
    BLOCK_FROM_GRIPPER,
    BLOCK_FROM_GRIPPER_VELOCITY,
    FINGERS,
    GRIPPER,
    GRIPPER_VELOCITY,
    REST_HEIGHT,
    TARGET,
    State,
)

SIDE_MARGIN = 0.015
"""Smallest distance in metres along an axis at which one thing counts as left, nearer or farther."""
DISTANCE_MARGIN = 0.02
"""Smallest difference in metres at which one of two distances counts as the shorter."""


def _opening(states: State) -> NDArray[np.float32]:
    """Return the opening of both fingers (N,) in metres."""
    opening: NDArray[np.float32] = states[:, FINGERS].sum(axis=1)
    return opening


def _height(states: State, thing: slice) -> NDArray[np.float32]:
    """Return the height (N,) of a thing above a block at rest, in metres."""
    return states[:, thing][:, 2] - np.float32(REST_HEIGHT)


def _length(vectors: State) -> NDArray[np.float32]:
    """Return the lengths (N,) of vectors (N, 3)."""
    lengths: NDArray[np.float32] = np.linalg.norm(vectors, axis=1)
    return lengths


def _block_side(states: State) -> Answers:
    return sign(states[:, BLOCK_FROM_GRIPPER][:, 1], SIDE_MARGIN)


def _block_depth(states: State) -> Answers:
    return sign(-states[:, BLOCK_FROM_GRIPPER][:, 0], SIDE_MARGIN)


def _gripper_above(states: State) -> Answers:
    above = -states[:, BLOCK_FROM_GRIPPER][:, 2]
    return which(above > 0.07, above < 0.05)


def _gripper_opening(states: State) -> Answers:
    """Answer whether the gripper is open; around the block, at 0.05, it is neither open nor closed."""
    return which(_opening(states) > 0.08, _opening(states) < 0.02)


def _gripper_holding(states: State) -> Answers:
    distance, opening = _length(states[:, BLOCK_FROM_GRIPPER]), _opening(states)
    return which((distance < 0.02) & (opening > 0.03) & (opening < 0.055), distance > 0.035)


def _gripper_moving(states: State) -> Answers:
    speed = _length(states[:, GRIPPER_VELOCITY])
    return which(speed > 0.01, speed < 0.004)


def _block_place(states: State) -> Answers:
    return which(_height(states, BLOCK) > 0.02, abs(_height(states, BLOCK)) < 0.01)


def _block_moving(states: State) -> Answers:
    speed = _length(states[:, BLOCK_FROM_GRIPPER_VELOCITY] + states[:, GRIPPER_VELOCITY])
    return which(speed > 0.004, speed < 0.001)


def _target_side(states: State) -> Answers:
    return sign((states[:, TARGET] - states[:, BLOCK])[:, 1], SIDE_MARGIN)


def _target_side_of_gripper(states: State) -> Answers:
    return sign((states[:, TARGET] - states[:, GRIPPER])[:, 1], SIDE_MARGIN)


def _target_place(states: State) -> Answers:
    return which(_height(states, TARGET) > 0.02, abs(_height(states, TARGET)) < 0.01)


def _target_higher(states: State) -> Answers:
    higher = (states[:, TARGET] - states[:, BLOCK])[:, 2]
    return which(higher > 0.03, higher < 0.015)


def _nearest(states: State) -> Answers:
    to_target = _length(states[:, TARGET] - states[:, GRIPPER])
    return sign(to_target - _length(states[:, BLOCK_FROM_GRIPPER]), DISTANCE_MARGIN)


def _farthest(states: State) -> Answers:
    return sign((states[:, BLOCK] - states[:, TARGET])[:, 0], DISTANCE_MARGIN)


QUESTIONS: tuple[QuestionKind, ...] = (
    QuestionKind(
        "block_side",
        (
            "is the block left or right of the gripper",
            "on which side of the gripper is the block",
            "seen from the gripper is the block left or right",
        ),
        ("left", "right"),
        _block_side,
    ),
    QuestionKind(
        "block_depth",
        (
            "is the block nearer or farther than the gripper",
            "is the block nearer to the robot or farther than the gripper",
            "seen from the robot is the block nearer or farther",
        ),
        ("nearer", "farther"),
        _block_depth,
    ),
    QuestionKind(
        "gripper_above",
        (
            "is the gripper high above the block",
            "is the gripper much higher than the block",
            "is the block far below the gripper",
        ),
        ("yes", "no"),
        _gripper_above,
    ),
    QuestionKind(
        "gripper_opening",
        (
            "is the gripper open or closed",
            "are the fingers open or closed",
            "how is the gripper open or closed",
        ),
        ("open", "closed"),
        _gripper_opening,
    ),
    QuestionKind(
        "gripper_holding",
        (
            "is the gripper holding the block",
            "does the gripper hold the block",
            "is the block held between the fingers",
        ),
        ("yes", "no"),
        _gripper_holding,
    ),
    QuestionKind(
        "gripper_moving",
        (
            "is the gripper moving",
            "does the gripper move",
            "is the gripper in motion",
        ),
        ("yes", "no"),
        _gripper_moving,
    ),
    QuestionKind(
        "block_place",
        (
            "is the block in the air or on the table",
            "where is the block in the air or on the table",
            "does the block hang in air or lie on the table",
        ),
        ("air", "table"),
        _block_place,
    ),
    QuestionKind(
        "block_moving",
        (
            "is the block moving",
            "does the block move",
            "is the block in motion",
        ),
        ("yes", "no"),
        _block_moving,
    ),
    QuestionKind(
        "target_side",
        (
            "is the target left or right of the block",
            "on which side of the block is the target",
            "seen from the block is the target left or right",
        ),
        ("left", "right"),
        _target_side,
    ),
    QuestionKind(
        "target_side_of_gripper",
        (
            "is the target left or right of the gripper",
            "on which side of the gripper is the target",
            "seen from the gripper is the target left or right",
        ),
        ("left", "right"),
        _target_side_of_gripper,
    ),
    QuestionKind(
        "target_place",
        (
            "is the target in the air or on the table",
            "where is the target in the air or on the table",
            "does the target hang in air or lie on the table",
        ),
        ("air", "table"),
        _target_place,
    ),
    QuestionKind(
        "target_higher",
        (
            "is the target higher than the block",
            "is the target above the level of the block",
            "is the block lower than the target",
        ),
        ("yes", "no"),
        _target_higher,
    ),
    QuestionKind(
        "nearest",
        (
            "which is nearer to the gripper the block or the target",
            "is the block or the target nearer to the gripper",
            "what is closest to the gripper the block or the target",
        ),
        ("block", "target"),
        _nearest,
    ),
    QuestionKind(
        "farthest",
        (
            "which is farther from the robot the block or the target",
            "is the block or the target farther from the robot",
            "what is farthest from the robot the block or the target",
        ),
        ("block", "target"),
        _farthest,
    ),
)
"""All kinds of questions about a state of the Fetch world."""
