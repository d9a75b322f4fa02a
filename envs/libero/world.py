"""The LIBERO world as one Gymnasium environment: a Panda arm, a table and the things on it."""

from __future__ import annotations

from clbench.worlds.world import MujocoWorld

from .physics import LiberoVectorWorld
from .rules import PREDICATES


class LiberoWorld(MujocoWorld):
    """A `LiberoVectorWorld` with one lane; that class documents states, actions and rewards."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    vector_world = LiberoVectorWorld
    first_task = "open_the_middle_drawer_of_the_cabinet"
    predicates = PREDICATES
    """The predicates in the goals of all tasks: through them, rules are part of a scenario's definition."""
