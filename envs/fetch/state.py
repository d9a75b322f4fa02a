"""Layout of the state vector of the Fetch world: 28 numbers, in metres and metres per step of 0.04 s.

The first 25 are the observation of gymnasium-robotics' FetchPickAndPlace-v4, the last 3 the target marker.
x grows away from the robot, y to its left, z up.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

State: TypeAlias = NDArray[np.float32]
"""One state (28,), or many (N, 28)."""

SIZE = 28
GRIPPER = slice(0, 3)
"""Position of the midpoint between the finger tips."""
BLOCK = slice(3, 6)
"""Position of the centre of the block."""
BLOCK_FROM_GRIPPER = slice(6, 9)
"""Position of the block relative to the gripper."""
FINGERS = slice(9, 11)
"""Opening of each finger: 0 closed, 0.05 open, about 0.025 with the block between them."""
BLOCK_ANGLES = slice(11, 14)
"""Euler angles of the block in radians."""
BLOCK_FROM_GRIPPER_VELOCITY = slice(14, 17)
"""Velocity of the block relative to the gripper."""
BLOCK_SPIN = slice(17, 20)
"""Angular velocity of the block in radians per step."""
GRIPPER_VELOCITY = slice(20, 23)
"""Velocity of the gripper."""
FINGERS_VELOCITY = slice(23, 25)
"""Velocity of each finger."""
TARGET = slice(25, 28)
"""Position of the target marker."""

REST_HEIGHT = 0.425
"""Height of the centre of a block at rest on the table."""
