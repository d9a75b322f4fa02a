"""Which runs already have a record, and need no job."""

from __future__ import annotations

import dataclasses
import os
import platform
from pathlib import Path
from typing import Any

from clbench.base.errors import InputError
from clbench.records.fingerprints import machine_of, other_parts
from clbench.records.paths import free_name
from clbench.records.reader import RecordError, UnreadableRecordError, read_record
from clbench.records.record import Record
from clbench.runs.spec import ResolvedRun
from clbench.scoring.scores import Scores
from clbench.spec.scenario import Scenario


def has_record(run: ResolvedRun, records: Path) -> bool:
    """Return whether exactly this run has completed, or the same run with perturbed episodes.

    A record does not count if its run failed, if it cannot be read or contradicts itself, if its budget,
    device or settings differ, or if the version of the method, the code of a method or policy "module:Class",
    or the weights that such a policy brings, have changed since.

    Raises:
        InputError: The record was made with another definition of the scenario.
        UnreadableRecordError: A record that may count cannot be read now, or by this clbench.
    """
    path = run.path(records)
    try:
        record = read_record(path)
        Scores.from_record(record)
    except UnreadableRecordError:
        raise
    except RecordError:
        return False
    return record.status == "success" and is_of(record, run, path)


def is_of(record: Record, run: ResolvedRun, path: Path) -> bool:
    """Return whether the record at `path` is of exactly this run, a success or a failure.

    Raises:
        InputError: The run succeeded with another definition of the scenario.
    """
    if not has_settings_of(record, run) or changed_code(record, run):
        return False
    if record.status == "success":
        _check_definition(record, run.published, path)
    return True


def has_settings_of(record: Record, run: ResolvedRun) -> bool:
    """Return whether a record has a run's settings, budget and device; the record may also be perturbed."""
    settings = _all_settings(record, run)
    perturb = record.run.perturb and run.spec.perturb
    found = dataclasses.replace(record.run, settings=settings, perturb=perturb)
    return (found, record.scenario) == (run.info, run.scenario_info)


def _all_settings(record: Record, run: ResolvedRun) -> dict[str, Any]:
    """Return the settings of a record and of its method.

    As on the board, a setting that an older record lacks was added later, with a default that changes
    nothing.
    """
    return {**run.defaults, **record.run.settings}


def has_failed(run: ResolvedRun, records: Path) -> bool:
    """Return whether exactly this run has a record, and failed."""
    path = run.path(records)
    try:
        record = read_record(path)
    except RecordError:
        return False
    return record.status == "failed" and is_of(record, run, path)


def is_of_other_code(run: ResolvedRun, path: Path) -> bool:
    """Return whether the record at `path`, which a run just wrote, has other code or defaults than `run`."""
    try:
        record = read_record(path)
    except RecordError:
        return False
    if record.status != "success" or ":" not in run.spec.method:
        return False
    return bool(changed_code(record, run)) or _all_settings(record, run) != run.info.settings


def set_aside(run: ResolvedRun, records: Path) -> str | None:
    """Rename the record of a run if it is damaged, or from older code or weights, to repeat the run.

    Returns:
        A sentence that says what was wrong and where the record is now; None if there is no such record.

    Raises:
        InputError: The record cannot be renamed.
        UnreadableRecordError: A record that may be sound cannot be read now, or by this clbench.
    """
    path = run.path(records)
    if not os.path.lexists(path):
        return None
    try:
        record = read_record(path)
        if record.status == "success":
            Scores.from_record(record)
    except UnreadableRecordError:
        raise
    except RecordError as error:
        fault, ending = str(error).removeprefix(f"{path}: ").rstrip("."), "damaged"
    else:
        changed = changed_code(record, run)
        if record.status != "success" or not changed:
            return None
        fault, ending = f"{' and '.join(changed)} since this run", "old"
    aside = free_name(path, ending)
    try:
        path.replace(aside)
    except FileNotFoundError:  # another command was faster
        pass
    except OSError as error:
        raise InputError(f"{path}: {fault}, and it cannot be renamed: {error.strerror}.") from error
    return f"{path}: {fault}. The record is renamed to {aside.name}, and the run is repeated."


def changed_code(record: Record, run: ResolvedRun) -> list[str]:
    """Return in words what has changed since a record: code of its method, or code or weights of its policy.

    A method with a name of its own changes when its version does. A "module:Class" is work in progress: it
    changes with its source.
    """
    from clbench.learning.registry import describe_method
    from clbench.runs.fingerprint import describe_policy

    changed, method, policy = [], run.spec.method, run.spec.policy
    recorded = record.fingerprint.get("method")
    part = "source" if ":" in method else "version"
    known = recorded.get(part) if isinstance(recorded, dict) else None
    if known != describe_method(run.method)[part]:
        changed.append(f"the code of {method} has changed")
    if ":" in policy:
        clauses = {
            "policy": f"the code of {policy} has changed",
            "weights": f"the weights of {policy} have changed",
        }
        now = describe_policy(run.scenario, run.spec.seed)
        known = {"weights": now.get("weights"), **record.fingerprint}  # older records have no weights
        changed += [clauses[name] for name in now if known.get(name) != now[name]]
    return changed


def _check_definition(record: Record, published: Scenario, path: Path) -> None:
    """Refuse a record that was made with another definition of its scenario."""
    from clbench.evaluation.definition import definition

    other = other_parts(record.fingerprint.get("definition"), definition(published))
    if other:
        machine = machine_of(record.fingerprint)
        advice = "Give the changed scenario a new version, or choose"
        here = platform.machine()
        if machine not in (None, here):
            advice = f"Worlds may move differently on {machine}, where it was made, than on {here}: choose"
        raise InputError(
            f"{path} was made with another definition of {published.id}: {', '.join(other)} differ. {advice} "
            "another folder with --records."
        )
