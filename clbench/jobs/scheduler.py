"""The scheduler: does many interdependent jobs, on all cores or on a cluster."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache

from rich.console import Console

from clbench.base import interrupts
from clbench.jobs.bars import Bars
from clbench.jobs.job import Job, Workers


def run_jobs(jobs: Sequence[Job], workers: Workers, bars: Bars) -> dict[Job, str]:
    """Do all jobs, and return the reason of each failure by job.

    A job that fails, or whose process dies, does not stop the others; jobs that need it are left out. This
    function leaves no process behind, even after Ctrl-C.

    Args:
        jobs: Jobs in any order, with all jobs that they need. Jobs on the critical path start first.
        workers: Workers that do the jobs; they are closed at the end.
        bars: Bars that show the progress.
    """
    waiting, started = _by_urgency(jobs), dict[Job, float]()
    succeeded: set[Job] = set()
    failed: dict[Job, str] = {}
    try:
        while waiting or started:
            interrupts.check()
            waiting = _drop_hopeless(waiting, failed)
            for job in _ready(waiting, succeeded, workers.free()):
                waiting.remove(job)
                workers.start(job)
                started[job] = time.monotonic()
                bars.start(job, job.length)
            for job, kind, value in workers.events():
                if kind == "progress":
                    bars.advance(job, value)
                    continue
                if kind == "done":
                    succeeded.add(job)
                else:
                    failed[job] = value
                bars.finish(job, f"{value} ({time.monotonic() - started.pop(job):.0f} s)")
    finally:
        workers.close()
    return failed


def run_with_bars(jobs: Sequence[Job], workers: Workers, console: Console | None = None) -> dict[Job, str]:
    """Do all jobs as `run_jobs` does, with a bar for each."""
    with Bars(sum(job.length for job in jobs), console) as bars:
        return run_jobs(jobs, workers, bars)


def _by_urgency(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs by decreasing time of the longest chain that begins with them.

    The longest run starts first, so that no worker is left alone with it at the end.
    """
    dependents: dict[Job, list[Job]] = {job: [] for job in jobs}
    for job in jobs:
        for needed in job.needs:
            dependents[needed].append(job)

    @cache
    def time_of_chain(job: Job) -> float:
        return max(map(time_of_chain, dependents[job]), default=0.0) + job.length * job.pace

    return sorted(jobs, key=lambda job: -time_of_chain(job))


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


def _ready(waiting: Sequence[Job], succeeded: set[Job], free: int) -> list[Job]:
    """Return the jobs to start: those whose needs have succeeded, in their order."""
    return [job for job in waiting if succeeded.issuperset(job.needs)][:free]
