"""Positions of the labels of the plane, where a dozen marks may share one spot.

All lengths are in pixels, from the upper left corner of the plane.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

HEIGHT = 14.0
"""Distance from one label to the next."""

LETTER = 6.8
"""Mean width of a letter at font size 12."""

LONGEST = 160
"""Maximum width of a label: longer text is cut, and the tooltip has all of it."""

BESIDE = ((9, 0), (8, -9), (8, 10), (-8, -9), (-8, 10), (-9, 0))
"""Possible offsets of a label from its mark: the corners avoid the intervals."""

OBSTACLE = 5.0
"""Half the width of a mark."""

CROWD = 14.0
"""Marks closer than this have their labels in the list: next to the marks, labels would be ambiguous."""


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
    """The position of a label: the middle of its left or right side."""

    name: str
    x: float
    y: float
    align: str
    """Side at `x`: left or right."""
    mark: Mark | None = None
    """Mark that a line connects to the label, if the label is not next to it."""


Box = tuple[float, float, float, float]
"""Left, right, top and bottom."""


def place(marks: Sequence[Mark], rows: Sequence[float], width: float, height: float) -> list[Label]:
    """Return the labels: next to the mark where there is room, otherwise in a list on the right.

    The list holds as many labels as fit, the uppermost first; the other marks have no label.

    Args:
        marks: Marks to label.
        rows: Heights of horizontal lines that labels must avoid.
        width: Width of the plane.
        height: Height of the plane.
    """
    covered = [_boxes(mark) for mark in marks]
    kept_free = [boxes[0] for boxes in covered]
    taken = [box for boxes in covered for box in boxes] + [(0.0, width, row, row) for row in rows]
    labels: list[Label] = []
    crowded: list[Mark] = []
    for mark in sorted(marks, key=lambda mark: (mark.y, -mark.x, mark.name)):
        alone = not any(_is_near(mark, other) for other in marks if other is not mark)
        # A label over a thin line is legible: better than a list far from the mark.
        found = _beside(mark, taken, width, height) or _beside(mark, kept_free, width, height)
        if alone and found:
            labels.append(found)
            taken.append(_box(found))
            kept_free.append(_box(found))
        else:
            crowded.append(mark)
    listed = crowded[: int(height // HEIGHT) + 1]
    places = _spread([mark.y for mark in listed], height)
    return labels + [
        Label(mark.name, width + 13, y, "left", mark) for mark, y in zip(listed, places, strict=True)
    ]


def _boxes(mark: Mark) -> list[Box]:
    """Return the boxes that a mark and its intervals cover."""
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
    """Return the first free position next to the mark inside the plane, None if there is none."""
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
    """Return positions near the desired ones, in rising order, at least `HEIGHT` apart."""
    places: list[float] = []
    for wish in wished:
        places.append(max(wish, places[-1] + HEIGHT if places else 0.0))
    limit = height
    for number in reversed(range(len(places))):
        places[number] = min(places[number], limit)
        limit = places[number] - HEIGHT
    return places
