"""Layout of the state of the LIBERO world: 83 numbers, lengths in metres.

x grows away from the robot, y to its left, z up. Quaternions begin with their scalar. Every scene has seven
objects and fixtures, in the order of their names. All tasks of libero_goal have the same, and so do those of
libero_spatial; each task of libero_object has others. Joints of fixtures are 0 where a scene has none.

Positions of things are from the hand, and once more at a finer scale. A policy kept .81 of LiberoGoal-v0's
skills with places in the room, .88 with positions from the hand, and .95 with the finer scale as well (90
to 150 validation episodes): it had missed the neck of the bottle by 1.3 cm or more.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

State: TypeAlias = NDArray[np.float32]
"""One state (83,), or many (N, 83)."""

THINGS, PARTS = 7, 4
"""Number of objects and fixtures, and largest number of joints of fixtures: three drawers and a knob."""

SIZE = 9 + 7 * THINGS + PARTS + 3 * THINGS
HAND = slice(0, 3)
"""Position of the point between the finger tips."""
HAND_QUATERNION = slice(3, 7)
FINGERS = slice(7, 9)
"""Positions of the fingers: (0.04, -0.04) open, (0, 0) closed."""
PLACES = slice(9, 9 + 7 * THINGS)
"""Position from the hand, and quaternion, of each object and fixture: seven numbers each."""
JOINTS = slice(9 + 7 * THINGS, 9 + 7 * THINGS + PARTS)
"""Positions of the joints of fixtures: drawers, then the knob of the stove."""
CLOSE_BY = slice(JOINTS.stop, SIZE)
"""Positions from the hand once more, cut at `REACH` along each axis: three numbers for each thing."""
REACH = 0.05
"""Metres. A policy scales each number by its spread, which is smaller for numbers that are cut."""


def thing(number: int) -> slice:
    """Return where thing `number`, from 0 on, has its position (3,) from the hand and its quaternion (4,)."""
    return slice(9 + 7 * number, 16 + 7 * number)
