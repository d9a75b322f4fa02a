"""Places for the labels of the plane, where a dozen marks may lie on one spot.

All lengths are pixels from the upper left corner of the plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

HEIGHT = 14.0
"""From one label to the next."""

LETTER = 6.2
"""Width of a letter at a size of 11, on average."""

LONGEST = 160
"""Width of a label: what is longer is cut, and stands in the tooltip."""

BESIDE = ((9, 0), (8, -9), (8, 10), (-8, -9), (-8, 10), (-9, 0))
"""Where a label may lie, seen from its mark: those in the corners keep clear of the intervals."""

OBSTACLE = 5.0
"""Half the width of a mark."""

CROWD = 14.0
"""Marks nearer than this have their labels in the list: beside them nobody could tell whose is whose."""


@dataclass(frozen=True)
class Mark:
    """A mark with its intervals."""

    name: str
    x: float
    y: float
    left: float
    right: float
    top: float
    bottom: float


@dataclass(frozen=True)
class Label:
    """The place of a label: the middle of its left or right side."""

    name: str
    x: float
    y: float
    align: str
    """left or right: which side `x` is."""
    mark: Mark | None = None
    """What a line leads to, if it is not beside it."""


Box = tuple[float, float, float, float]
"""Left, right, top and bottom."""


def place(marks: Sequence[Mark], rows: Sequence[float], width: float, height: float) -> list[Label]:
    """Return the labels: beside the mark where nothing is in the way, else in a list on the right.

    As many as fit are in the list, the uppermost first; the others have no label.

    Args:
        marks: What to label.
        rows: Heights of the lines from side to side that no label should lie on.
        width: Of the plane.
        height: Of the plane.
    """
    taken = [box for mark in marks for box in _boxes(mark)] + [(0.0, width, row, row) for row in rows]
    labels: list[Label] = []
    crowded: list[Mark] = []
    for mark in sorted(marks, key=lambda mark: (mark.y, -mark.x, mark.name)):
        alone = not any(_is_near(mark, other) for other in marks if other is not mark)
        found = _beside(mark, taken, width, height) if alone else None
        if found:
            labels.append(found)
            taken.append(_box(found))
        else:
            crowded.append(mark)
    listed = crowded[: int(height // HEIGHT) + 1]
    places = _spread([mark.y for mark in listed], height)
    return labels + [
        Label(mark.name, width + 13, y, "left", mark) for mark, y in zip(listed, places, strict=True)
    ]


def _boxes(mark: Mark) -> list[Box]:
    """Return what a mark and its intervals cover."""
    return [
        (mark.x - OBSTACLE, mark.x + OBSTACLE, mark.y - OBSTACLE, mark.y + OBSTACLE),
        (mark.left, mark.right, mark.y, mark.y),
        (mark.x, mark.x, mark.top, mark.bottom),
    ]


def _box(label: Label) -> Box:
    length = min(len(label.name) * LETTER, LONGEST)
    left = label.x if label.align == "left" else label.x - length
    return left, left + length, label.y - HEIGHT / 2 + 1, label.y + HEIGHT / 2 - 1


def _is_near(mark: Mark, other: Mark) -> bool:
    return math.hypot(mark.x - other.x, mark.y - other.y) < CROWD


def _beside(mark: Mark, taken: Sequence[Box], width: float, height: float) -> Label | None:
    """Return the first place beside the mark that is inside the plane and free, None if there is none."""
    for dx, dy in BESIDE:
        label = Label(mark.name, mark.x + dx, mark.y + dy, "left" if dx > 0 else "right")
        box = _box(label)
        inside = box[0] >= 0 and box[1] <= width and box[2] >= -HEIGHT and box[3] <= height
        if inside and not any(_overlap(box, other) for other in taken):
            return label
    return None


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[1] and other[0] < one[1] and one[2] < other[3] and other[2] < one[3]


def _spread(wished: Sequence[float], height: float) -> list[float]:
    """Return places near those wished, which rise, `HEIGHT` apart or more, from the top to the bottom."""
    places: list[float] = []
    for wish in wished:
        places.append(max(wish, places[-1] + HEIGHT if places else 0.0))
    limit = height
    for number in reversed(range(len(places))):
        places[number] = min(places[number], limit)
        limit = places[number] - HEIGHT
    return places
