"""The experts of the Meta-World world: Meta-World's own scripted policies, which act on the state alone.

The expert of push_back is our own: Meta-World's closes the fingers on its way down, and ends up on top of the
block in half of the episodes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from metaworld.policies import ENV_POLICY_MAP
from numpy.typing import NDArray

from clbench.base.entry_points import unknown

from .state import GOAL, HAND, OBJECT, OPENING, State

Action: TypeAlias = NDArray[np.float32]

ABOVE = np.array([0.0, 0.0, 0.12])
"""Offset in metres from a block to a place where the hand is clear of it."""


def expert(task: str) -> Callable[[State], Action]:
    """Return the expert of the task, which maps a state (39,) to an action (4,).

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
    """
    if task == "push_back":
        return _push_back
    name = f"{task.replace('_', '-')}-v3"
    if name not in ENV_POLICY_MAP:
        known = (entry.removesuffix("-v3").replace("-", "_") for entry in ENV_POLICY_MAP)
        raise unknown("expert of the Meta-World world", task, known)
    make: Any = ENV_POLICY_MAP[name]
    policy = make()

    def act(state: State) -> Action:
        with warnings.catch_warnings():
            # it exceeds the bounds of actions, and warns each time
            warnings.filterwarnings("ignore", "Constant")
            wished = policy.get_action(state.astype(np.float64))
        action: Action = np.clip(wished, -1.0, 1.0).astype(np.float32)
        return action

    return act


def _push_back(state: State) -> Action:
    """Return the action that comes down on the block, grasps it and drags it to the goal."""
    hand, block, goal = (state[part].astype(np.float64) for part in (HAND, OBJECT, GOAL))
    low = hand[2] - block[2] < 0.05
    way, fingers = goal - hand, 0.6
    if np.linalg.norm(hand[:2] - block[:2]) > (0.03 if low else 0.02):
        way, fingers = block + ABOVE - hand, -1.0
    elif not low:
        way, fingers = block - hand, -1.0
    elif state[OPENING] > 0.62:  # 0.5 around the block
        way = np.zeros(3)
    way[2] *= not low or fingers < 0.0  # drag a held block at the height of the grasp
    action: Action = np.clip(np.append(10.0 * way, fingers), -1.0, 1.0).astype(np.float32)
    return action
