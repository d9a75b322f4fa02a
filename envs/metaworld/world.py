"""The Meta-World world as one Gymnasium environment: a robot arm, a table and the objects on it."""

from __future__ import annotations

from clbench.worlds.world import MujocoWorld

from .physics import MetaWorldVectorWorld


class MetaWorldWorld(MujocoWorld):
    """A `MetaWorldVectorWorld` with one lane; that class documents states, actions and rewards."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 80}  # noqa: RUF012
    vector_world = MetaWorldVectorWorld
    first_task = "drawer_open"
