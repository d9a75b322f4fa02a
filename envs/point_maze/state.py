"""Layout of the state vector of the PointMaze world: 11 numbers, in metres and metres per second.

The first 4 are the observation of gymnasium-robotics' PointMaze. The state does not contain the goal: only
the instruction names it. Seen from above, x grows to the right and y upwards; (0, 0) is the middle of the
maze.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

State: TypeAlias = NDArray[np.float32]
"""One state (11,), or many (N, 11)."""

SIZE = 11
PLACE = slice(0, 2)
"""Position of the ball's centre."""
VELOCITY = slice(2, 4)
"""Velocity of the ball."""
ROOM_AHEAD = slice(4, 8)
"""Distances from the ball's centre to the wall on the right, on the left, above and below."""
COLOUR = slice(8, 11)
"""1 for the colour of the walls, else 0, in the order red, blue, green. Each maze has its own colour."""
