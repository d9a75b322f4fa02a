"""Layout of the state of the Meta-World world: Meta-World's observation, 39 numbers, lengths in metres.

The robot is at the origin and faces along y: x grows to its right, y away from it, z up. The first 18 numbers
describe the current step, the next 18 the previous step, and the last 3 the goal. Number 3 is the opening of
the fingers.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

State: TypeAlias = NDArray[np.float32]
"""One state (39,), or many (N, 39)."""

SIZE = 39
HAND = slice(0, 3)
"""Position of the hand: of its palm, 4.5 cm above the tips of the fingers."""
OPENING = 3
"""Opening of the fingers: 1 open, about 0.2 when closed on nothing."""
OBJECT = slice(4, 7)
"""Position of the object of the task, such as a block or the handle of a drawer."""
HAND_BEFORE = slice(18, 21)
"""Position of the hand in the previous step."""
OBJECT_BEFORE = slice(22, 25)
"""Position of the object in the previous step."""
GOAL = slice(36, 39)
"""Goal position of the object, or of the hand in a reach."""
