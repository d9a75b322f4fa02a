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
from clbench.jobs.job import Job, Workers, chain_times

DONE, FAILED = "done by another command", "failed in another command"

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
    waiting, started = _by_urgency(jobs), dict[Job, float]()
    succeeded: set[Job] = set()
    failed: dict[Job, str] = {}
    leases = _Leases(jobs)
    try:
        while waiting or started:
            interrupts.check()
            waiting = _drop_hopeless(waiting, failed)
            taken = leases.take(_ready(waiting, succeeded), workers.free())
            for job, fault in taken.items():
                waiting.remove(job)
                ending = fault or _ending(job)
                if ending is not None:
                    leases.release(job)
                    if ending == DONE:
                        succeeded.add(job)
                    else:
                        failed[job] = ending
                    bars.skip(job, job.duration, ending)
                    continue
                workers.start(job)
                started[job] = time.monotonic()
                bars.start(job, job.duration)
            if not started and not taken and waiting:
                leases.wait(waiting, workers.free() > 0, bars)
            for job, kind, value in workers.events() if started else ():
                if kind == "progress":
                    bars.advance(job, value * job.pace)
                    leases.report(job, bars.share(job))
                    continue
                if kind == "at":
                    bars.place(job, value)
                    continue
                leases.release(job)
                if kind == "done":
                    succeeded.add(job)
                elif kind == "taken":
                    waiting.append(job)
                else:
                    failed[job] = value
                bars.finish(job, f"{value} ({time.monotonic() - started.pop(job):.0f} s)")
            if started:
                bars.tick()
    finally:
        try:
            workers.close()
        finally:  # a second signal may interrupt it
            leases.close()
    return failed


def _ending(job: Job) -> str | None:
    """Return how a job ended elsewhere, or why that is not known; None if the job is still to be done."""
    if job.product is None:
        return None
    try:
        if job.product.exists():
            return DONE
        return FAILED if job.product.has_failed() else None
    except ClbenchError as error:
        return str(error)


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
            if len(taken) >= most:  # on a shrinking cluster, fewer than none are free
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


def _drop_hopeless(waiting: list[Job], failed: dict[Job, str]) -> list[Job]:
    """Return the jobs that can still be done; the others fail because a job that they need failed."""
    kept = []
    for job in waiting:
        missing = [needed for needed in job.needs if needed in failed]
        if missing:
            failed[job] = f"left out, because {missing[0]} failed"
        else:
            kept.append(job)
    return kept


def _ready(waiting: Sequence[Job], succeeded: set[Job]) -> list[Job]:
    """Return the jobs whose needs have succeeded, in their order."""
    return [job for job in waiting if succeeded.issuperset(job.needs)]
