"""A submission: a method is checked, run within limits, and put on the board."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from clbench.cli.arguments import checked_input
from clbench.jobs.job import Job, JobError
from clbench.jobs.plan import benchmark_jobs
from clbench.jobs.processes import Processes
from clbench.jobs.scheduler import run_with_bars
from clbench.learning.registry import load_method
from clbench.records.paths import label_of, record_path
from clbench.runs.spec import RunSpec, has_record
from clbench.scoring.metrics import METRICS
from clbench.spec.registry import load_scenario
from clbench.testing import ContractError, check_method

from ..board.rows import Row, Table, rank_mates
from ..views.table import FITTING, interval, title_of

CHECK_STEPS = 100.0
"""What the check takes, in optimiser steps; for the time left that a progress bar shows."""


def run_submission(specs: Sequence[RunSpec], records: Path, workers: int | None) -> bool:
    """Check the method of `specs`, do those runs of it that have no record, and return whether all went well.

    Each run has a process of its own, which is ended if it goes beyond the scenario's limits.
    """
    console = Console(stderr=True)
    with checked_input():
        missing = [spec for spec in specs if not has_record(spec, records)]
    if not missing:
        console.print("All runs have a record already.")
        return True
    limits = load_scenario(missing[0].scenario).limits
    check = Job(
        "check",
        "clbench.leaderboard.submission.submit:check_job",
        {"method": missing[0].method},
        CHECK_STEPS,
        (),
        limits,
    )
    runs = benchmark_jobs(missing, records, limits)
    jobs = [check, *(dataclasses.replace(job, needs=(*job.needs, check.name)) for job in runs)]
    begin = time.monotonic()
    failed = run_with_bars(jobs, Processes(workers), console)
    seconds = time.monotonic() - begin
    console.print(
        f"{len(missing)} runs in {seconds / 60:.1f} minutes; records in {records}.", highlight=False
    )
    return not failed


def check_job(method: str, progress: Callable[[float], None]) -> str:
    """Check that a method keeps the contract."""
    try:
        check_method(load_method(method))
    except ContractError as error:
        raise JobError(str(error)) from error
    progress(CHECK_STEPS)
    return "the method keeps the contract"


def placement(table: Table, scenario: str, method: str, records: Path) -> list[str]:
    """Return lines that say where a method stands on the board, or why it does not stand there."""
    rows = [row for row in table.rows if row.scenario == scenario]
    mine = [row for row in rows if row.method == method]
    folder = record_path(Path(), scenario, label_of(method, {}), 0).parent.as_posix()
    refused = [entry for entry in table.not_shown if entry.path.startswith(f"{folder}/")]
    lines = [line for row in mine for line in _row_lines(row, rows)]
    if not mine:
        lines.append(f"{method} has no row on the board of {scenario}.")
        if not refused:
            lines.append(f"There is no record of it in {records / folder}.")
    lines += [f"Not shown: {entry.path}: {entry.reason}" for entry in refused]
    return lines


def _row_lines(row: Row, rows: Sequence[Row]) -> list[str]:
    lines = [f"{row.method} on {row.scenario}, {len(row.seeds)} seeds, {row.tier}"]
    if row.rank is None:
        lines.append("It does not compete." if row.division == "reference" else "It has no final average.")
    else:
        count, tied = rank_mates(row, rows)
        shared = f", which it shares with {', '.join(tied)}: they cannot be told apart" if tied else ""
        lines.append(f"Rank {row.rank} of {count} in the division {row.division}{shared}.")
    lines += [f"  {title_of(metric.name)}: {interval(row.estimates[metric.name])}" for metric in FITTING]
    needed = {name for metric in FITTING for name in METRICS[metric.name].references}
    absent = sorted(needed - {other.method for other in rows})
    if absent:
        command = f"clbench run {row.scenario} {' '.join(absent)}"
        lines.append(f"Metrics that compare with {', '.join(absent)} need records of it: {command}")
    return lines
