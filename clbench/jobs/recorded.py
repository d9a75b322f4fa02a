"""Which runs have a record already, and need no job."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from pathlib import Path

from clbench.base.errors import InputError
from clbench.records.pinned import other_parts
from clbench.records.reader import RecordError, read_record
from clbench.records.record import Record
from clbench.runs.spec import ResolvedRun
from clbench.scoring.scores import Scores
from clbench.spec.scenario import Scenario


def has_record(run: ResolvedRun, records: Path) -> bool:
    """Return whether exactly this run has completed, or the same run with perturbed episodes.

    A record does not count if its run failed, if it cannot be read or contradicts itself, or if its budget,
    device or settings differ.

    Raises:
        InputError: The record was made with another definition of the scenario.
    """
    path = run.path(records)
    try:
        record = read_record(path)
        Scores.from_record(record)
    except RecordError:
        return False
    found = record.run if run.spec.perturb else dataclasses.replace(record.run, perturb=False)
    if record.status != "success" or (found, record.scenario) != (run.info, run.scenario_info):
        return False
    _check_definition(record, run.published, path)
    return True


def set_damaged_aside(run: ResolvedRun, records: Path) -> str | None:
    """Rename the record of a run if it is damaged, so that the run can be done again.

    Returns:
        A sentence that says what was damaged and where it is now; None if there is no damaged record.
    """
    path = run.path(records)
    if not os.path.lexists(path):
        return None
    try:
        record = read_record(path)
        if record.status == "success":
            Scores.from_record(record)
    except RecordError as error:
        aside = path.with_name(f"{path.name}.damaged")
        with contextlib.suppress(FileNotFoundError):  # another command was faster
            path.replace(aside)
        fault = str(error).removeprefix(f"{path}: ").rstrip(".")
        return f"{path}: {fault}. It is set aside as {aside.name}, and the run is done again."
    return None


def _check_definition(record: Record, published: Scenario, path: Path) -> None:
    """Refuse a record of another definition of its scenario."""
    from clbench.evaluation.definition import definition

    recorded = record.fingerprint.get("definition")
    other = [] if recorded is None else other_parts(recorded, definition(published))
    if other:
        raise InputError(
            f"{path} was made with another {published.id}: {', '.join(other)} differ. Give the changed "
            "scenario a new version, or choose another folder with --records."
        )
