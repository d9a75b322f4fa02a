"""The command `clbench tune`."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from rich.table import Table

from clbench.cli.arguments import add_cwd_to_path, checked_input, whole_number
from clbench.cli.runs import run_missing
from clbench.records.paths import TUNING

if TYPE_CHECKING:
    from clbench.runs.spec import ResolvedRun

METRICS = ("adaptation", "retention", "retention_at_matched_adaptation", "question_retention")
"""Metrics in the table."""


def tune(
    scenario: str,
    method: str,
    /,
    *,
    values: dict[str, str],
    seed: Annotated[int, whole_number(0)] = 100,
    targets: Annotated[int | None, whole_number(1)] = None,
    workers: Annotated[int | None, whole_number(1)] = None,
    records: Path = TUNING,
) -> None:
    """Compare settings of METHOD on SCENARIO without test episodes.

    The command runs every combination of the values, and plain fine-tuning for comparison, on validation
    episodes and with a seed that no board reports. It skips runs that have a record, so the same command
    shows the table again.

    Args:
        scenario: Gymnasium id of the scenario.
        method: Name of an installed method, or module:Class.
        values: Hyper-parameters and the values to try, as --values.tau_start 0.3,1,3
        seed: Seed of pretraining and of every draw; the boards report seeds from 0.
        targets: Number of targets to learn, from the first; all if not given. Fewer targets take less time.
        workers: Number of runs at once, each a process with one thread; all cores if not given.
        records: Folder of the records.
    """
    from clbench.jobs.processes import Processes
    from clbench.runs.spec import RunSpec
    from clbench.spec.references import BASELINE

    add_cwd_to_path()
    with checked_input():
        lists = [[(name, value) for value in text.split(",")] for name, text in values.items()]
        settings = [
            (BASELINE, {}),
            *((method, dict(combination)) for combination in itertools.product(*lists)),
        ]
        runs = [
            RunSpec(scenario, name, seed, changes, split="validation", targets=targets).resolve()
            for name, changes in settings
        ]
    successful = run_missing(runs, records, lambda: Processes(workers))
    Console().print(_table(runs, records))
    if not successful:
        sys.exit(1)


def _table(runs: Sequence[ResolvedRun], records: Path) -> Table:
    """Return the metrics of the runs that have a record; the first run is the baseline."""
    from clbench.records.reader import read_record
    from clbench.runs.spec import has_record
    from clbench.scoring.metrics import measure
    from clbench.scoring.scores import Scores
    from clbench.spec.references import BASELINE

    baseline = runs[0]
    table = Table(title=f"{baseline.spec.scenario}, seed {baseline.spec.seed}, validation episodes")
    table.add_column("settings", no_wrap=True)
    for name in METRICS:
        table.add_column(name.replace("_", " "), justify="right")
    scores = {
        run.label: Scores.from_record(read_record(run.path(records)))
        for run in runs
        if has_record(run, records)
    }
    reference = scores.get(baseline.label)
    for label, one in scores.items():
        row = [measure(name, one, {BASELINE: reference} if reference else {}) for name in METRICS]
        table.add_row(label, *("-" if value is None else f"{value:.2f}" for value in row))
    return table
