"""Layout of the state of the LIBERO world: 213 numbers, lengths in metres.

x grows away from the robot, y to its left, z up. Quaternions begin with their scalar. Each thing has its
place in the states of all scenes, in the order of `THINGS`. A scene has seven of the 20 things; the numbers
of the others are 0, and so are joints of fixtures that it lacks.

Positions of things are relative to the hand, and appear once more at a finer scale. A policy kept .81 of the
skills of libero_goal with places in the room, .88 with positions relative to the hand, and .95 with the finer
scale as well (90 to 150 validation episodes): before, it missed the neck of the bottle by 1.3 cm or more.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

State: TypeAlias = NDArray[np.float32]
"""One state (213,), or many (N, 213)."""

THINGS = (
    "akita_black_bowl_1",
    "akita_black_bowl_2",
    "alphabet_soup_1",
    "basket_1",
    "bbq_sauce_1",
    "butter_1",
    "chocolate_pudding_1",
    "cookies_1",
    "cream_cheese_1",
    "flat_stove_1",
    "glazed_rim_porcelain_ramekin_1",
    "ketchup_1",
    "milk_1",
    "orange_juice_1",
    "plate_1",
    "salad_dressing_1",
    "tomato_sauce_1",
    "wine_bottle_1",
    "wine_rack_1",
    "wooden_cabinet_1",
)
"""Objects and fixtures of all scenes, by LIBERO's names. The bowl to carry is the first one."""

PARTS = 4
"""Largest number of joints of fixtures: three drawers and a knob."""

SIZE = 9 + 10 * len(THINGS) + PARTS
HAND = slice(0, 3)
"""Position of the point between the finger tips."""
HAND_QUATERNION = slice(3, 7)
"""Orientation of the hand."""
FINGERS = slice(7, 9)
"""Positions of the fingers: (0.04, -0.04) open, (0, 0) closed."""
PLACES = slice(9, 9 + 7 * len(THINGS))
"""Position from the hand, and quaternion, of each object and fixture: seven numbers each."""
JOINTS = slice(PLACES.stop, PLACES.stop + PARTS)
"""Positions of the joints of fixtures: drawers, then the knob of the stove."""
CLOSE_BY = slice(JOINTS.stop, SIZE)
"""Positions from the hand once more, cut at 5 cm (`REACH`) along each axis: three numbers for each."""
REACH = 0.05
"""Limit in metres. A policy scales each number by its spread, which is smaller for numbers that are cut."""


def thing(name: str) -> slice:
    """Return where a thing has its position (3,) relative to the hand, and its quaternion (4,)."""
    first = PLACES.start + 7 * THINGS.index(name)
    return slice(first, first + 7)
