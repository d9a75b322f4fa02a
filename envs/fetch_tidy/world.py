"""The tidy Fetch world as a Gymnasium environment, and with many lanes."""

from __future__ import annotations

from typing import ClassVar

from ..fetch.physics import FetchVectorWorld
from ..fetch.world import FetchWorld
from .rules import TIDY_RULES


class TidyFetchVectorWorld(FetchVectorWorld):
    """A `FetchVectorWorld` with the tasks of `TIDY_RULES`."""

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        super().__init__(lanes, threads, perturbed, TIDY_RULES)


class TidyFetchWorld(FetchWorld):
    """A `TidyFetchVectorWorld` with one lane."""

    vector_world: ClassVar[type[FetchVectorWorld]] = TidyFetchVectorWorld
    first_task = next(iter(TIDY_RULES))
