"""Questions about a state of the scene of libero_goal, answered from the state alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clbench.data.questions import Answers, QuestionKind, sign, which

from .state import FINGERS, HAND, State, thing

MARGIN = 0.02
"""Smallest difference in metres, of places along an axis or of distances, at which there is an answer."""
TABLE = 0.9
"""Height in metres of the table's top; the places of the bowl and the bottle are those of their bottoms."""

Numbers = NDArray[np.float32]

BOWL, CHEESE, PLATE, BOTTLE = (
    slice(thing(name).start, thing(name).start + 3)
    for name in ("akita_black_bowl_1", "cream_cheese_1", "plate_1", "wine_bottle_1")
)


def _beyond_hand(place: slice, axis: int) -> Callable[[State], Answers]:
    """Return a rule that answers whether a thing is further along an axis than the hand."""
    return lambda states: sign(states[:, place][:, axis], MARGIN)


def _distance(states: State, place: slice) -> Numbers:
    """Return the distances (N,) of a thing from the hand."""
    distance: Numbers = np.linalg.norm(states[:, place], axis=1)
    return distance


def _nearer(first: slice, second: slice) -> Callable[[State], Answers]:
    """Return a rule that answers which of two things is nearer to the hand."""
    return lambda states: sign(_distance(states, second) - _distance(states, first), MARGIN)


def _opening(states: State) -> Numbers:
    """Return the opening of the fingers (N,) in metres."""
    right, left = states[:, FINGERS].T
    opening: Numbers = right - left
    return opening


def _gripper_opening(states: State) -> Answers:
    return which(_opening(states) > 0.06, _opening(states) < 0.03)


def _place(container: slice) -> Callable[[State], Answers]:
    """Return a rule that answers whether a thing is in the air, or on the table."""

    def rule(states: State) -> Answers:
        height = states[:, HAND][:, 2] + states[:, container][:, 2] - TABLE
        return which(height > 0.03, height < 0.01)

    return rule


def _near(container: slice) -> Callable[[State], Answers]:
    """Return a rule that answers whether the hand is near a thing, which it can then reach into or hold."""
    return lambda states: which(_distance(states, container) < 0.14, _distance(states, container) > 0.18)


def _gripper_height(states: State) -> Answers:
    height = states[:, HAND][:, 2] - TABLE
    return which(height > 0.25, height < 0.18)


def _kind(
    name: str, answers: tuple[str, str], rule: Callable[[State], Answers], *wordings: str
) -> QuestionKind:
    return QuestionKind(name, wordings, answers, rule)


def _side(name: str, place: slice) -> QuestionKind:
    """Return the question whether a thing is left or right of the hand."""
    return _kind(
        f"{name}_side",
        ("left", "right"),
        _beyond_hand(place, 1),
        f"is the {name} left or right of the gripper",
        f"on which side of the gripper is the {name}",
        f"seen from the gripper is the {name} left or right",
    )


def _depth(name: str, place: slice) -> QuestionKind:
    """Return the question whether a thing is nearer to the robot or farther than the hand."""
    return _kind(
        f"{name}_depth",
        ("farther", "nearer"),
        _beyond_hand(place, 0),
        f"is the {name} nearer or farther than the gripper",
        f"is the {name} nearer to the robot or farther than the gripper",
        f"seen from the robot is the {name} nearer or farther",
    )


def _about(name: str, place: slice) -> tuple[QuestionKind, ...]:
    """Return the questions about a thing that the skills carry."""
    return (
        _side(name, place),
        _depth(name, place),
        _kind(
            f"near_{name}",
            ("yes", "no"),
            _near(place),
            f"is the gripper near the {name}",
            f"is the gripper close to the {name}",
            f"is the {name} near the gripper",
        ),
        _kind(
            f"{name}_place",
            ("air", "table"),
            _place(place),
            f"is the {name} in the air or on the table",
            f"where is the {name} in the air or on the table",
            f"does the {name} hang in air or lie on the table",
        ),
    )


QUESTIONS: tuple[QuestionKind, ...] = (
    *_about("bowl", BOWL),
    *_about("bottle", BOTTLE),
    # the skills never reach beyond the plate, nor to the left of the cheese: they give one answer alone
    _side("plate", PLATE),
    _depth("cheese", CHEESE),
    _kind(
        "nearest",
        ("bowl", "bottle"),
        _nearer(BOWL, BOTTLE),
        "which is nearer to the gripper the bowl or the bottle",
        "is the bowl or the bottle nearer to the gripper",
        "what is closest to the gripper the bowl or the bottle",
    ),
    _kind(
        "nearest_flat",
        ("plate", "cheese"),
        _nearer(PLATE, CHEESE),
        "which is nearer to the gripper the plate or the cheese",
        "is the plate or the cheese nearer to the gripper",
        "what is closest to the gripper the plate or the cheese",
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
        "gripper_height",
        ("high", "low"),
        _gripper_height,
        "is the gripper high or low",
        "is the gripper high or low over the table",
        "how high is the gripper high or low",
    ),
)
"""All kinds of questions about a state of the scene of libero_goal."""
