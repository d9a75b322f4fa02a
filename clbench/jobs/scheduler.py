"""The grid: many runs, and what they need, on all cores or on a cluster."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache

from rich.console import Console

from clbench.jobs.bars import Bars
from clbench.jobs.job import Job, Workers


def run_jobs(jobs: Sequence[Job], workers: Workers, bars: Bars) -> dict[str, str]:
    """Do all jobs, and return what went wrong, by the name of the job.

    A job that fails, or whose process dies, does not stop the others; what needs it is left out. However this
    function is left, by Ctrl-C too, nothing stays behind.

    Args:
        jobs: In any order: those that the longest work waits for begin first.
        workers: Who does them; closed in the end.
        bars: Where it is shown.
    """
    waiting, started = _by_urgency(jobs), dict[str, float]()
    ended: set[str] = set()
    failed: dict[str, str] = {}
    try:
        while waiting or started:
            waiting = _drop_hopeless(waiting, failed)
            for job in _ready(waiting, ended, workers.free()):
                waiting.remove(job)
                workers.start(job)
                started[job.name] = time.monotonic()
                bars.start(job.name, job.length)
            for job, kind, value in workers.events():
                if kind == "progress":
                    bars.advance(job.name, value)
                    continue
                if kind == "done":
                    ended.add(job.name)
                else:
                    failed[job.name] = value
                bars.finish(job.name, f"{value} ({time.monotonic() - started.pop(job.name):.0f} s)")
    finally:
        workers.close()
    return failed


def run_with_bars(jobs: Sequence[Job], workers: Workers, console: Console | None = None) -> dict[str, str]:
    """Do all jobs as `run_jobs` does, with a bar for each."""
    with Bars(sum(job.length for job in jobs), console) as bars:
        return run_jobs(jobs, workers, bars)


def _by_urgency(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs by falling time of the work that waits for them, their own included.

    The longest run begins first, so that no worker ends with it alone.
    """

    @cache
    def work(name: str) -> float:
        return max((work(job.name) for job in jobs if name in job.needs), default=0.0) + times[name]

    times = {job.name: job.length * job.pace for job in jobs}
    return sorted(jobs, key=lambda job: -work(job.name))


def _drop_hopeless(waiting: list[Job], failed: dict[str, str]) -> list[Job]:
    """Return the jobs that can still be done; the others fail with what they needed."""
    kept = []
    for job in waiting:
        missing = [name for name in job.needs if name in failed]
        if missing:
            failed[job.name] = f"left out, because {missing[0]} failed"
        else:
            kept.append(job)
    return kept


def _ready(waiting: Sequence[Job], ended: set[str], free: int) -> list[Job]:
    """Return the jobs to start: those whose needs have ended, in their order."""
    return [job for job in waiting if ended.issuperset(job.needs)][:free]
