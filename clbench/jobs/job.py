"""Jobs, and the interface of the workers that do them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

from clbench.base.errors import ClbenchError
from clbench.spec.limits import Limits


class JobError(ClbenchError):
    """A job failed for a reason that the message explains in full."""


@dataclass(frozen=True, eq=False)
class Product:
    """What a job makes. One command at a time makes it; others wait, and do other jobs meanwhile."""

    path: Path
    """Place of the file or folder."""
    exists: Callable[[], bool]
    """Returns whether a command has made it."""
    has_failed: Callable[[], bool] = lambda: False
    """Returns whether another command tried to make it since this one began, and failed."""


@dataclass(frozen=True, eq=False)
class Job:
    """A piece of work for one process. Two jobs are the same only if they are the same object."""

    title: str
    """Name of the job on bars and in logs."""
    function: Callable[..., str]
    """Function of a module, called with the arguments and `progress`. It returns a text to show."""
    arguments: dict[str, Any]
    """Arguments by name; they travel to another process."""
    length: float
    """Length in optimiser steps: the amounts that `progress` gets add up to it."""
    needs: tuple[Job, ...] = ()
    """Jobs that must succeed first."""
    limits: Limits | None = None
    """Limits of the process; None sets none."""
    device: str = "cpu"
    """Device on which the job computes."""
    pace: float = 1.0
    """Expected time of a unit of length, relative to an optimiser step."""
    product: Product | None = None
    """What the job makes. If None, several commands may do the job at once."""

    def __str__(self) -> str:
        return self.title

    @property
    def duration(self) -> float:
        """Expected time of the job, relative to an optimiser step."""
        return self.length * self.pace

    def bare(self) -> Job:
        """Return the job with only what a worker needs.

        The command holds the lease, and looks for the product. The functions that look for it know the whole
        run: they would travel with it, and make the worker import the method before the job begins.
        """
        return replace(self, needs=(), product=None)


def chain_times(
    jobs: Iterable[Job], time_of: Callable[[Job], float] = attrgetter("duration")
) -> dict[Job, float]:
    """Return the expected time of the longest chain that begins with each job.

    Args:
        jobs: Jobs, with all jobs that they need.
        time_of: Returns the expected time of a job, by default relative to an optimiser step.
    """
    jobs = list(jobs)
    dependents: dict[Job, list[Job]] = {job: [] for job in jobs}
    for job in jobs:
        for needed in job.needs:
            dependents[needed].append(job)

    @cache
    def time_of_chain(job: Job) -> float:
        return max(map(time_of_chain, dependents[job]), default=0.0) + time_of(job)

    return {job: time_of_chain(job) for job in jobs}


Outcome = Literal["done", "failed", "taken"]
"""How a job ended, as it reported; a job is taken if another process took over its work."""

Ending = Outcome | Literal["lost"]
"""How a job ended; it is lost if its process ended without a result."""


class Event(NamedTuple):
    """A message from a worker."""

    job: Job
    """Job that it is about."""
    kind: Literal["progress", "at"] | Ending
    """What the message says: the progress of the job, its place, or how it ended."""
    value: Any
    """Length done since the last event, the place that the job has reached, the text that it returned, or the
    reason of the failure."""

    @property
    def ends_job(self) -> bool:
        """Whether the job has ended."""
        return self.kind not in ("progress", "at")


class Workers(Protocol):
    """Workers that do jobs."""

    def free(self) -> int:
        """Return the number of jobs that can start now."""
        ...

    def start(self, job: Job) -> None:
        """Start a job."""
        ...

    def events(self) -> Iterator[Event]:
        """Yield the events since the last call; wait at most a second for one."""
        ...

    def close(self) -> None:
        """End all running jobs, and leave no process behind."""
        ...
