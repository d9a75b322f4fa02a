"""The experts of the Meta-World world: Meta-World's own scripted policies, which act on the state alone."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from metaworld.policies import ENV_POLICY_MAP
from numpy.typing import NDArray

from clbench.task import unknown

from .state import State

Action: TypeAlias = NDArray[np.float32]


def expert(task: str) -> Callable[[State], Action]:
    """Return the expert of the task: it maps a state (39,) to an action (4,).

    Raises:
        LookupError: No task has this name; the nearest one is named.
    """
    name = f"{task.replace('_', '-')}-v3"
    if name not in ENV_POLICY_MAP:
        known = (entry.removesuffix("-v3").replace("-", "_") for entry in ENV_POLICY_MAP)
        raise unknown("expert of the Meta-World world", task, known)
    policy = ENV_POLICY_MAP[name]()

    def act(state: State) -> Action:
        with warnings.catch_warnings():
            # it asks for more than an action can do, and says so each time
            warnings.filterwarnings("ignore", "Constant")
            wished = policy.get_action(state.astype(np.float64))
        return np.clip(wished, -1.0, 1.0).astype(np.float32)  # type: ignore[no-any-return]

    return act
