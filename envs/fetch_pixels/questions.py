"""Questions about a picture of the Fetch world, answered from the state, which no policy sees."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clbench.data.questions import QuestionKind

from ..fetch.questions import QUESTIONS
from ..fetch.state import BLOCK, TARGET, State
from .camera import COLOURS, THINGS

MARGIN = 0.04
"""Smallest difference in metres at which one thing counts as further left, or nearer, than the other."""

Answers = NDArray[np.int64]
Measures = NDArray[np.float32]

SEEN = (
    "block_side",
    "block_depth",
    "block_place",
    "target_side",
    "target_side_of_gripper",
    "nearest",
    "farthest",
)
"""Kinds of the Fetch world whose answers need a still picture, not just the robot's own measurements."""


def _colour(measure: Callable[[State, NDArray[np.float32]], Measures]) -> Callable[[State], Answers]:
    """Return a rule that answers with the colour of the thing with the smaller measure.

    Args:
        measure: Maps states (N, 56) and places of things (N, 2, 2), in metres, to numbers (N, 2).
    """

    def answer(states: State) -> Answers:
        things = states[:, THINGS].reshape(-1, 2, 3)
        measures = measure(states, things[:, :, :2])
        first = measures.argmin(axis=1)
        colours = things[np.arange(len(things)), first, 2].astype(np.int64)
        clear = np.abs(measures[:, 0] - measures[:, 1]) > MARGIN
        return np.where(clear, colours, -1)

    return answer


def _distance_to(thing: slice) -> Callable[[State, NDArray[np.float32]], Measures]:
    """Return a measure: the distance in the plane from each place to a thing."""

    def distance(states: State, places: NDArray[np.float32]) -> Measures:
        distances: Measures = np.linalg.norm(places - states[:, None, thing][:, :, :2], axis=2)
        return distances

    return distance


def _kind(name: str, answer: Callable[[State], Answers], *wordings: str) -> QuestionKind:
    return QuestionKind(name, wordings, tuple(COLOURS), answer)


PIXEL_QUESTIONS: tuple[QuestionKind, ...] = (
    *(kind for kind in QUESTIONS if kind.name in SEEN),
    _kind(
        "colour_left",
        _colour(lambda _, places: -places[:, :, 1]),
        "what colour is the thing on the left",
        "which colour has the left thing",
        "seen from the robot what colour is the left thing",
    ),
    _kind(
        "colour_right",
        _colour(lambda _, places: places[:, :, 1]),
        "what colour is the thing on the right",
        "which colour has the right thing",
        "seen from the robot what colour is the right thing",
    ),
    _kind(
        "colour_near_block",
        _colour(_distance_to(BLOCK)),
        "what colour is the thing nearest to the block",
        "which colour has the thing closest to the block",
        "the thing nearest to the block has what colour",
    ),
    _kind(
        "colour_near_target",
        _colour(_distance_to(TARGET)),
        "what colour is the thing nearest to the target",
        "which colour has the thing closest to the target",
        "the thing nearest to the target has what colour",
    ),
)
"""All kinds of questions about a picture."""
