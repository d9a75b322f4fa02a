"""Layout of the state vector of the dm_control world: 19 numbers, the same for every body.

The first 8 are the observation of the body's dm_control environment, in its order and units, padded with
zeros. The next 8 mark observed numbers with 1 and padding with 0. The last 3 are a one-hot code of the body,
in the order of `BODIES`. Lengths are in metres, angles in radians, speeds per second.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from clbench.base.errors import InputError

State: TypeAlias = NDArray[np.float32]
"""One state (19,), or many (N, 19)."""
Observation: TypeAlias = NDArray[np.float64]
"""dm_control's observation of one body, (K,), or of many of the same kind, (N, K)."""

BODIES = ("point_mass", "cartpole", "ball_in_cup")
"""Domains of dm_control, in the order of the one-hot code."""

ACTION_SIZE = 2
OBSERVATION_SIZE = 8
SIZE = 2 * OBSERVATION_SIZE + len(BODIES)
BODY = slice(2 * OBSERVATION_SIZE, SIZE)
"""One-hot code of the body, in the order of `BODIES`."""


def padded(body: str, observation: Observation) -> State:
    """Return the state of a body from dm_control's observation (K,), or the states from many (N, K).

    Raises:
        InputError: The observation has more numbers than the state has places.
    """
    size = observation.shape[-1]
    if size > OBSERVATION_SIZE:
        raise InputError(f"{body} is observed in {size} numbers; a state has places for {OBSERVATION_SIZE}.")
    state = np.zeros((*observation.shape[:-1], SIZE), np.float32)
    state[..., :size] = observation
    state[..., OBSERVATION_SIZE : OBSERVATION_SIZE + size] = 1.0
    state[..., 2 * OBSERVATION_SIZE + BODIES.index(body)] = 1.0
    return state
