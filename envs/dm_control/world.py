"""The dm_control world as one Gymnasium environment: a body, its target, and a return to reach."""

from __future__ import annotations

from clbench.worlds.world import MujocoWorld

from .physics import DMControlVectorWorld
from .rules import RULES


class DMControlWorld(MujocoWorld):
    """A `DMControlVectorWorld` with one lane; that class documents states, actions and rewards."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector_world = DMControlVectorWorld
    first_task = next(iter(RULES))
