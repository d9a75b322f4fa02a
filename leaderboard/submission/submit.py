"""A submission: the method is checked, run within limits, and placed on the board."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from clbench.base.progress import ProgressCallback
from clbench.base.text import counted, print_plain
from clbench.jobs.grid import run_missing
from clbench.jobs.job import Job, JobError
from clbench.jobs.processes import Processes
from clbench.learning.registry import load_method
from clbench.records.paths import table_name
from clbench.runs.spec import ResolvedRun
from clbench.scoring.metrics import METRICS
from clbench.testing import ContractError, check_method

from ..board.commands import run_command
from ..board.rows import Board, Row
from ..views.format import fitting, fitting_names, format_interval, standing_text

CHECK_STEPS = 100.0
"""Duration of the check in optimiser steps, for the time left that the progress bar shows."""


def run_submission(
    runs: Sequence[ResolvedRun], records: Path, workers: int | None, checkpoints: Path | None
) -> bool | None:
    """Check the method of `runs`, and do the runs that have no record.

    Each run has its own process, which is stopped if it exceeds the scenario's limits.

    Args:
        runs: Runs of one method.
        records: Folder of the records.
        workers: Number of runs at once; None for all cores, or all GPUs.
        checkpoints: Folder below which the policies of all stages are kept; None keeps none.

    Returns:
        Whether all runs succeeded; None if none was started, because the method breaks the contract.
    """
    console, name = Console(stderr=True), runs[0].spec.method
    check = Job("check", check_job, {"method": name}, CHECK_STEPS, limits=runs[0].scenario.limits)
    pool = partial(Processes, workers, runs[0].spec.device)
    failed = run_missing(runs, records, pool, console, checkpoints, check=check)
    if check in failed:
        print_plain(console, f"No run was started: {name} breaks the contract.")
        return None
    return not failed


def check_job(method: str, progress: ProgressCallback) -> str:
    """Check that a method keeps the contract."""
    try:
        check_method(load_method(method))
    except ContractError as error:
        raise JobError(str(error)) from error
    progress(CHECK_STEPS)
    return "the method keeps the contract"


def placement(board: Board, run: ResolvedRun, records: Path) -> list[str]:
    """Return lines with the place of the method of `run` on the board, or why it has no row."""
    scenario, method = table_name(run.scenario.id, run.spec.policy), run.spec.method
    rows = [row for row in board.rows if row.scenario == scenario]
    mine = [row for row in rows if row.method == method]
    folder = run.path(Path()).parent.as_posix()
    refused = [entry for entry in board.not_shown if entry.path.startswith(f"{folder}/")]
    lines = [line for row in mine for line in _row_lines(row, rows, run.spec.scenario, records)]
    if not mine:
        lines.append(f"{method} has no row on the board of {scenario}.")
        if not refused:
            lines.append(f"There is no record of it in {records / folder}.")
    lines += [f"Not shown: {entry}" for entry in refused]
    return lines


def _row_lines(row: Row, rows: Sequence[Row], scenario: str, records: Path) -> list[str]:
    lines = [f"{row.method} on {row.scenario}, {counted(len(row.seeds), 'seed')}, {row.tier}"]
    lines.append(f"Division {row.division}: {standing_text(row, rows)}.")
    columns = fitting(rows)
    lines += [
        f"  {one.title}: {format_interval(row.estimates[one.metric.name], one.form)}" for one in columns
    ]
    needed = {name for metric in fitting_names(rows) for name in METRICS[metric].references}
    absent = sorted(needed - {other.method for other in rows})
    if absent:
        command = run_command(scenario, *absent, records=records)
        lines.append(f"Metrics that compare with {', '.join(absent)} need its records: {command}")
    return lines
