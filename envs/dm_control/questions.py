"""Questions about a state of the dm_control world, answered from the state alone.

A question about one body has no answer (-1) in the states of the others.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clbench.data.questions import Answers, QuestionKind, Truths, which

from .state import BODIES, BODY, State

SIDE_MARGIN = 0.02
"""Smallest distance in metres along an axis at which one thing counts as left of, or above, the other."""

Values = NDArray[np.float32]


def _about(body: str, states: State, first: Truths, second: Truths) -> Answers:
    """Return 0 where `first` holds, else 1 where `second` holds, else -1; always -1 for other bodies."""
    asked = states[:, BODY][:, BODIES.index(body)] > 0.5
    return which(asked & first, asked & second)


def _sign(
    body: str, value: Callable[[State], Values], margin: float = SIDE_MARGIN
) -> Callable[[State], Answers]:
    """Return a rule that answers 0 where a value (N,) is below -`margin`, 1 where it is above `margin`."""

    def answer(states: State) -> Answers:
        values = value(states)
        return _about(body, states, values < -margin, values > margin)

    return answer


def _number(place: int) -> Callable[[State], Values]:
    """Return a function that takes number `place` of the observation."""

    def take(states: State) -> Values:
        values: Values = states[:, place]
        return values

    return take


def _body(states: State) -> Answers:
    which: Answers = states[:, BODY].argmax(axis=1).astype(np.int64)
    return which


def _pole_up(states: State) -> Answers:
    return _about("cartpole", states, states[:, 1] > 0.3, states[:, 1] < -0.3)


def _ball_height(states: State) -> Values:
    """Return the height (N,) of the ball above the middle of the cup, which hangs 0.35 m above it at rest."""
    height: Values = states[:, 3] - states[:, 1] - np.float32(0.35)
    return height


def _ball_side(states: State) -> Values:
    side: Values = states[:, 2] - states[:, 0]
    return side


def _ball_caught(states: State) -> Answers:
    inside = np.maximum(abs(_ball_side(states)), abs(_ball_height(states)))
    return _about("ball_in_cup", states, inside < 0.025, inside > 0.05)


QUESTIONS: tuple[QuestionKind, ...] = (
    QuestionKind(
        "body",
        ("which body is it", "what is there to move", "what stands or hangs here"),
        ("point", "cart", "cup"),
        _body,
    ),
    QuestionKind(
        "point_side",
        (
            "is the point left or right of the centre",
            "on which side of the centre is the point",
            "seen from the centre is the point left or right",
        ),
        ("left", "right"),
        _sign("point_mass", _number(0)),
    ),
    QuestionKind(
        "point_height",
        (
            "is the point below or above the centre",
            "seen from the centre is the point below or above",
            "where is the point below the centre or above it",
        ),
        ("below", "above"),
        _sign("point_mass", _number(1)),
    ),
    QuestionKind(
        "pole_up",
        ("is the pole up or down", "does the pole stand up or hang down", "which way is the pole up or down"),
        ("up", "down"),
        _pole_up,
    ),
    QuestionKind(
        "pole_side",
        (
            "does the pole lean left or right",
            "to which side does the pole lean",
            "which way does the pole lean left or right",
        ),
        ("left", "right"),
        _sign("cartpole", _number(2), 0.01),
    ),
    QuestionKind(
        "cart_side",
        (
            "is the cart left or right of the centre",
            "on which side of the centre is the cart",
            "seen from the centre is the cart left or right",
        ),
        ("left", "right"),
        _sign("cartpole", _number(0)),
    ),
    QuestionKind(
        "ball_caught",
        ("is the ball in the cup", "is the ball inside the cup", "does the cup hold the ball"),
        ("yes", "no"),
        _ball_caught,
    ),
    QuestionKind(
        "ball_side",
        (
            "is the ball left or right of the cup",
            "on which side of the cup is the ball",
            "seen from the cup is the ball left or right",
        ),
        ("left", "right"),
        _sign("ball_in_cup", _ball_side),
    ),
    QuestionKind(
        "ball_height",
        (
            "is the ball below or above the cup",
            "seen from the cup is the ball below or above",
            "where is the ball below the cup or above it",
        ),
        ("below", "above"),
        _sign("ball_in_cup", _ball_height, 0.05),
    ),
)
"""The kinds of questions of the dm_control scenario."""
