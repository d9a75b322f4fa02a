"""Worlds of tasks, opened on demand."""

import dataclasses
from typing import ClassVar

import pytest

from clbench.spec.task import Task
from clbench.testing import TOY, ToyWorld
from clbench.worlds.world import World, opened_worlds

TASK = dataclasses.replace(TOY.target[0], world=f"{__name__}:Watched")


class Watched(ToyWorld):
    """Counts how often it is made and closed."""

    made: ClassVar[list[World]] = []
    closed: ClassVar[list[World]] = []

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.made.append(self)

    def close(self) -> None:
        self.closed.append(self)


def _fail_in(task: Task) -> None:
    with opened_worlds(render_mode="rgb_array") as world:
        assert not Watched.made
        assert world(task) is world(task)
        assert world(task).render_mode == "rgb_array"
        assert not Watched.closed
        raise ZeroDivisionError


def test_a_world_is_made_once_and_closed_even_after_an_error() -> None:
    with pytest.raises(ZeroDivisionError):
        _fail_in(TASK)
    assert len(Watched.made) == 1
    assert Watched.closed == Watched.made
