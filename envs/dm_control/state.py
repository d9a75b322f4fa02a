"""Layout of the state vector of the dm_control world: 19 numbers, the same for every body.

The first 8 are the observation of the body's dm_control environment, in its order and units, followed by
zeros; the next 8 say which of these are numbers of the body (1) and which fill up (0); the last 3 say which
body it is, 1 at its place in `BODIES`. Actions are filled up with zeros to 2: what a body has no motor for is
ignored. Lengths are in metres, angles in radians, speeds per second.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from clbench.base.errors import InputError

State: TypeAlias = NDArray[np.float32]
"""One state (19,), or many (N, 19)."""
Observation: TypeAlias = NDArray[np.float64]
"""What dm_control observes of one body, (K,), or of many alike, (N, K)."""

BODIES = ("point_mass", "cartpole", "ball_in_cup")
"""Domains of dm_control, in the order of the indicator."""

ACTION_SIZE = 2
OBSERVATION_SIZE = 8
SIZE = 2 * OBSERVATION_SIZE + len(BODIES)
OBSERVATION = slice(0, OBSERVATION_SIZE)
MASK = slice(OBSERVATION_SIZE, 2 * OBSERVATION_SIZE)
BODY = slice(2 * OBSERVATION_SIZE, SIZE)


def padded(body: str, observation: Observation) -> State:
    """Return the state of a body that dm_control observes as `observation` (K,), or many (N, K).

    Raises:
        ValueError: The observation has more numbers than a state has places for.
    """
    size = observation.shape[-1]
    if size > OBSERVATION_SIZE:
        raise InputError(f"{body} is observed in {size} numbers; a state has places for {OBSERVATION_SIZE}.")
    state = np.zeros((*observation.shape[:-1], SIZE), np.float32)
    state[..., :size] = observation
    state[..., OBSERVATION_SIZE : OBSERVATION_SIZE + size] = 1.0
    state[..., 2 * OBSERVATION_SIZE + BODIES.index(body)] = 1.0
    return state
