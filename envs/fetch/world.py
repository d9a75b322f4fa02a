"""The Fetch world as one Gymnasium environment: a robot arm, a table, a block and a target marker."""

from __future__ import annotations

from typing import ClassVar

from clbench.worlds.world import MujocoWorld

from .physics import FetchVectorWorld
from .rules import RULES


class FetchWorld(MujocoWorld):
    """A `FetchVectorWorld` with one lane; that class documents states, actions and rewards."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    vector_world: ClassVar[type[FetchVectorWorld]] = FetchVectorWorld
    first_task = next(iter(RULES))
