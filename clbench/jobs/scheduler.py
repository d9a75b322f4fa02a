"""The scheduler: does many interdependent jobs, on all cores or on a cluster."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence

from rich.console import Console

from clbench.base import interrupts
from clbench.base.errors import ClbenchError
from clbench.base.lease import Lease
from clbench.jobs.bars import Bars
from clbench.jobs.job import Ending, Event, Job, Workers, chain_times

WAIT_SECONDS = 1.0
"""Seconds between two looks at jobs that other commands do."""


def run_jobs(jobs: Sequence[Job], workers: Workers, bars: Bars) -> dict[Job, str]:
    """Do all jobs, and return the reason for each failure by job.

    A job that fails, or whose process dies, does not stop the others; jobs that need it are left out. A job
    that another command is doing waits until that command has done it or has died. This function leaves no
    process behind, even after Ctrl-C.

    Args:
        jobs: Jobs in any order, with all jobs that they need. Jobs on the critical path start first.
        workers: Workers that do the jobs; they are closed at the end.
        bars: Bars that show the progress.
    """
    scheduler = _Scheduler(jobs, workers, bars)
    try:
        scheduler.do_all()
    finally:
        try:
            workers.close()
        finally:  # a second signal may interrupt it
            scheduler.leases.close()
    return scheduler.failed


class _Scheduler:
    """The jobs that are waiting, are running and have ended."""

    def __init__(self, jobs: Sequence[Job], workers: Workers, bars: Bars) -> None:
        self.leases = _Leases(jobs)
        self.failed: dict[Job, str] = {}
        self._workers, self._bars = workers, bars
        self._waiting = _by_urgency(jobs)
        self._started: dict[Job, float] = {}
        self._succeeded: set[Job] = set()

    def do_all(self) -> None:
        """Do the jobs until none is waiting or running."""
        while self._waiting or self._started:
            interrupts.check()
            self._leave_out()
            began = self._begin()
            if not self._started and not began and self._waiting:
                self.leases.wait(self._waiting, self._workers.free() > 0, self._bars)
            for event in self._workers.events() if self._started else ():
                self._hear(event)
            if self._started:
                self._bars.tick()

    def _leave_out(self) -> None:
        """Leave out the jobs that need a job that failed."""
        for job in [*self._waiting]:
            lost = next((needed for needed in job.needs if needed in self.failed), None)
            if lost is not None:
                self._skip(job, "failed", f"left out, because {lost} failed")

    def _begin(self) -> bool:
        """Start as many jobs as possible, and return whether any began or was found to have ended."""
        ready = [job for job in self._waiting if self._succeeded.issuperset(job.needs)]
        taken = self.leases.take(ready, self._workers.free())
        for job, fault in taken.items():
            ending: tuple[Ending, str] | None = ("failed", fault) if fault else _ending_elsewhere(job)
            if ending is not None:
                self._skip(job, *ending)
                continue
            self._waiting.remove(job)
            self._workers.start(job)
            self._started[job] = time.monotonic()
            self._bars.start(job, job.duration)
        return bool(taken)

    def _hear(self, event: Event) -> None:
        """Show the progress of a job, or settle how it ended."""
        job, kind, value = event
        if kind == "progress":
            self._bars.advance(job, value * job.pace)
            self.leases.report(job, self._bars.share(job))
        elif kind == "at":
            self._bars.place(job, value)
        else:
            self._settle(job, kind, value)
            text = f"{value} ({time.monotonic() - self._started.pop(job):.0f} s)"
            (self._bars.postpone if kind == "taken" else self._bars.finish)(job, text)

    def _skip(self, job: Job, kind: Ending, text: str) -> None:
        """Settle a waiting job that is not to be done here."""
        self._waiting.remove(job)
        self._settle(job, kind, text)
        self._bars.skip(job, job.duration, text)

    def _settle(self, job: Job, kind: Ending, text: str) -> None:
        """Note how a job ended; one that another process took over waits again."""
        self.leases.release(job)
        if kind == "done":
            self._succeeded.add(job)
        elif kind == "taken":
            self._waiting.append(job)
        else:
            self.failed[job] = text


def _ending_elsewhere(job: Job) -> tuple[Ending, str] | None:
    """Return how a job ended elsewhere, or why that is not known; None if the job is still to be done."""
    if job.product is None:
        return None
    try:
        if job.product.exists():
            return "done", "done by another command"
        return ("failed", "failed in another command") if job.product.has_failed() else None
    except ClbenchError as error:
        return "failed", str(error)


class _Leases:
    """The leases of jobs that one command at a time may do."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._all = {job: Lease(job.product.path) for job in jobs if job.product is not None}
        self._tried: dict[Job, float] = {}
        self._told = set[bool]()

    def take(self, ready: Iterable[Job], most: int) -> dict[Job, str | None]:
        """Take the leases of as many jobs as possible, in their order, and return these jobs.

        A lease that another command had within `WAIT_SECONDS` is not tried: a file server answers each try.
        Each job comes with the error of the file system that refused its lease, or None.
        """
        taken: dict[Job, str | None] = {}
        for job in ready:
            if len(taken) >= most:
                break
            now = time.monotonic()
            if job in self._all and now - self._tried.get(job, -math.inf) < WAIT_SECONDS:
                continue
            self._tried[job] = now
            try:
                if job not in self._all or self._all[job].take():
                    taken[job] = None
            except OSError as error:
                taken[job] = f"its lease cannot be written: {error}"
        return taken

    def wait(self, waiting: Sequence[Job], has_worker: bool, bars: Bars) -> None:
        """Wait a moment, because other commands do the rest or no worker is free; say so the first time."""
        if has_worker not in self._told:
            self._told.add(has_worker)
            left = "job" if len(waiting) == 1 else f"{len(waiting)} jobs"
            owners = {lease.owner for job in waiting if (lease := self._all.get(job)) is not None}
            names = ", ".join(sorted(str(owner) for owner in owners if owner is not None))
            bars.say(
                f"Another command is doing the last {left}; waiting for {names or 'that command'}."
                if has_worker
                else f"No worker is free for the last {left}; waiting for one."
            )
        time.sleep(WAIT_SECONDS)

    def report(self, job: Job, share: float) -> None:
        """Tell other commands which share of a job is done."""
        if job in self._all:
            self._all[job].report(share)

    def release(self, job: Job) -> None:
        """Release the lease of a job."""
        if job in self._all:
            self._all[job].release()

    def close(self) -> None:
        """Release all leases."""
        for lease in self._all.values():
            lease.release()


def run_with_bars(jobs: Sequence[Job], workers: Workers, console: Console | None = None) -> dict[Job, str]:
    """Do all jobs as `run_jobs` does, with a bar for each."""
    with Bars(sum(job.duration for job in jobs), console) as bars:
        return run_jobs(jobs, workers, bars)


def _by_urgency(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs by decreasing time of the longest chain that begins with them.

    The longest run starts first, so that no worker is left alone with it at the end.
    """
    times = chain_times(jobs)
    return sorted(jobs, key=lambda job: -times[job])
