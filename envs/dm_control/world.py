"""The dm_control world as one Gymnasium environment: a body, its target, and a return to reach."""

from __future__ import annotations

from typing import Any

from clbench.worlds.world import MujocoWorld, States

from .physics import DMControlVectorWorld
from .rules import RULES


class DMControlWorld(MujocoWorld):
    """A `DMControlVectorWorld` with one lane; that class documents states, actions and rewards.

    `metadata["render_fps"]` is the control rate of the present body.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector_world = DMControlVectorWorld
    first_task = next(iter(RULES))
    success_at_horizon = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[States, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default the first; return the state (19,)."""
        begun = super().reset(seed=seed, options=options)
        self.metadata = {**self.metadata, "render_fps": self._world.steps_per_second(0)}
        return begun
