"""Jobs, and the interface of whoever does them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from clbench.spec.limits import Limits


class JobError(Exception):
    """A job came to a bad end that its message tells in full."""


@dataclass(frozen=True)
class Job:
    """A piece of work for one process."""

    name: str
    """What people see."""
    function: str
    """Entry point; called with the arguments and `progress`. What it returns, a text, is shown."""
    arguments: dict[str, Any]
    """By name."""
    length: float
    """In optimiser steps, for the time left."""
    needs: tuple[str, ...] = ()
    """Names of the jobs that must have ended well before."""
    limits: Limits | None = None
    """What its process may take; anything if None."""
    device: str = "cpu"
    """Where it computes."""
    pace: float = 1.0
    """Time that a unit of its length takes, compared with other jobs."""


class Event(NamedTuple):
    """What a worker tells."""

    job: Job
    kind: Literal["progress", "done", "failed", "lost"]
    """All but the first are the end of the job; it is lost if its process ended and said nothing."""
    value: Any
    """How much was done since the last event, the text that the job returned, or what went wrong."""


class Workers(Protocol):
    """Who does jobs."""

    def free(self) -> int:
        """Return how many more jobs can be under way."""
        ...

    def start(self, job: Job) -> None:
        """Begin a job."""
        ...

    def events(self) -> Iterator[Event]:
        """Give what was told since the last call; wait for it, but no longer than a second."""
        ...

    def close(self) -> None:
        """End what is under way: nothing stays behind."""
        ...
