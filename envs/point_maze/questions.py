"""Questions about a state of the PointMaze world, answered from the state alone."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from clbench.data.questions import Answers, QuestionKind, sign, which

from .mazes import MAZES
from .state import COLOUR, PLACE, ROOM_AHEAD, VELOCITY, State

SIDE_MARGIN = 0.25
"""Distance in metres to the middle of the maze below which the ball is on neither side."""
EDGE_MARGIN = 0.1
"""Distance in metres to the edge of a cell below which the ball is in neither of the two cells."""
NEARER_MARGIN = 0.2
"""Smallest difference in metres at which one of two distances counts as the shorter."""
SPEED_MARGIN = 0.3
"""Speed along an axis in metres per second below which the ball moves neither way."""
OPEN, CLOSED = 1.05, 0.95
"""Distances in metres: a ball of radius 0.1 is at most 0.9 from a wall of its cell, or at least 1.1."""

Numbers = NDArray[np.float32]


def _speed(states: State) -> Numbers:
    speed: Numbers = np.linalg.norm(states[:, VELOCITY], axis=1)
    return speed


def _side(states: State) -> Answers:
    return sign(-states[:, PLACE][:, 0], SIDE_MARGIN)


def _height(states: State) -> Answers:
    return sign(states[:, PLACE][:, 1], SIDE_MARGIN)


def _middle(states: State) -> Answers:
    away = np.linalg.norm(states[:, PLACE], axis=1)
    return which(away < 0.9, away > 1.2)


def _edge(states: State) -> Answers:
    """Answer with the nearest side of the maze, if it is nearest by a margin: left, right, top or bottom."""
    x, y = states[:, PLACE].T
    towards = np.stack([-x, x, y, -y])
    second, first = np.sort(towards, axis=0)[-2:]
    clear = first - second > NEARER_MARGIN
    return np.where(clear, towards.argmax(axis=0), -1).astype(np.int64)


def _part(states: State) -> Answers:
    """Answer room or corridor: rooms have even rows and columns, and the ball's centre decides its cell."""
    offset = states[:, PLACE] - np.round(states[:, PLACE])
    clear = (abs(offset) < 0.5 - EDGE_MARGIN).all(axis=1)
    room = (np.round(states[:, PLACE]) % 2 == 0).all(axis=1)
    return which(clear & room, clear & ~room)


def _colour(states: State) -> Answers:
    colour: Answers = states[:, COLOUR].argmax(axis=1)
    return colour


def _moving(states: State) -> Answers:
    return which(_speed(states) > 0.5, _speed(states) < 0.2)


def _pace(states: State) -> Answers:
    return which(_speed(states) > 2.0, _speed(states) < 1.4)


def _heading_side(states: State) -> Answers:
    return sign(-states[:, VELOCITY][:, 0], SPEED_MARGIN)


def _heading_height(states: State) -> Answers:
    return sign(states[:, VELOCITY][:, 1], SPEED_MARGIN)


def _way(direction: int, states: State) -> Answers:
    """Answer whether the next cell in a direction, an index of `ROOM_AHEAD`, is free: open or closed."""
    metres = states[:, ROOM_AHEAD][:, direction]
    return which(metres > OPEN, metres < CLOSED)


def _nearer_side_wall(states: State) -> Answers:
    right, left, _, _ = states[:, ROOM_AHEAD].T
    return sign(right - left, NEARER_MARGIN)


def _nearer_height_wall(states: State) -> Answers:
    _, _, above, below = states[:, ROOM_AHEAD].T
    return sign(below - above, NEARER_MARGIN)


def _open_way(name: str, words: str, direction: int) -> QuestionKind:
    return QuestionKind(
        name,
        (
            f"is the way {words} open or closed",
            f"is the way {words} of the ball closed or open",
            f"does the ball find the way {words} open or closed",
        ),
        ("open", "closed"),
        functools.partial(_way, direction),
    )


QUESTIONS: tuple[QuestionKind, ...] = (
    QuestionKind(
        "side",
        (
            "is the ball left or right of the middle of the maze",
            "on which side of the middle is the ball left or right",
            "seen from the middle is the ball left or right",
        ),
        ("left", "right"),
        _side,
    ),
    QuestionKind(
        "height",
        (
            "is the ball in the upper or lower half of the maze",
            "which half of the maze has the ball upper or lower",
            "in which half is the ball the upper or the lower",
        ),
        ("upper", "lower"),
        _height,
    ),
    QuestionKind(
        "middle",
        (
            "is the ball near the middle of the maze",
            "is the ball close to the middle",
            "is the middle of the maze near the ball",
        ),
        ("yes", "no"),
        _middle,
    ),
    QuestionKind(
        "edge",
        (
            "which side of the maze is nearest to the ball",
            "to which side of the maze is the ball closest",
            "left right top or bottom where is the ball",
        ),
        ("left", "right", "top", "bottom"),
        _edge,
    ),
    QuestionKind(
        "part",
        (
            "is the ball in a room or in a corridor",
            "where is the ball in a corridor or in a room",
            "what is around the ball a room or a corridor",
        ),
        ("room", "corridor"),
        _part,
    ),
    QuestionKind(
        "colour",
        (
            "which colour has the maze",
            "what colour has the wall",
            "is the maze red blue or green",
        ),
        tuple(MAZES),
        _colour,
    ),
    QuestionKind(
        "moving",
        (
            "is the ball moving",
            "does the ball move",
            "is the ball in motion",
        ),
        ("yes", "no"),
        _moving,
    ),
    QuestionKind(
        "pace",
        (
            "is the ball fast or slow",
            "how is the ball now slow or fast",
            "is the motion of the ball fast or slow",
        ),
        ("fast", "slow"),
        _pace,
    ),
    QuestionKind(
        "heading_side",
        (
            "does the ball move to the left or to the right",
            "is the ball moving left or right",
            "to which side does the ball roll left or right",
        ),
        ("left", "right"),
        _heading_side,
    ),
    QuestionKind(
        "heading_height",
        (
            "does the ball move up or down",
            "is the ball moving up or down",
            "which way does the ball roll up or down",
        ),
        ("up", "down"),
        _heading_height,
    ),
    _open_way("way_right", "to the right", 0),
    _open_way("way_left", "to the left", 1),
    _open_way("way_up", "up", 2),
    _open_way("way_down", "down", 3),
    QuestionKind(
        "nearer_side_wall",
        (
            "which wall is nearer the left or the right one",
            "is the left or the right wall nearer to the ball",
            "left or right where is the wall nearer",
        ),
        ("left", "right"),
        _nearer_side_wall,
    ),
    QuestionKind(
        "nearer_height_wall",
        (
            "which wall is nearer the one above or the one below",
            "is the wall above or below nearer to the ball",
            "above or below where is the wall nearer",
        ),
        ("above", "below"),
        _nearer_height_wall,
    ),
)
"""All kinds of questions about a state of the PointMaze world."""
