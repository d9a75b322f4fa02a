"""The writer of records."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from pathlib import Path
from typing import Any

from clbench.base.errors import InputError
from clbench.base.leftovers import replacing
from clbench.base.strict_json import LONGEST_TEXT, check_json
from clbench.records.content import content_hash
from clbench.records.paths import failed_name, free_name
from clbench.records.reader import RecordError, UnreadableRecordError, read_record
from clbench.records.record import SCHEMA, Record

LOG = logging.getLogger("clbench")

MOST_DIAGNOSTICS = 2 * 2**20
"""Most bytes of the diagnostics of a run, as JSON. The committed records have 1,506 at most."""

CUT = "\n[... clbench left out {count:,} characters ...]\n"
"""Replaces the middle of an error's text that is too long."""


def write_record(record: Record, path: Path) -> None:
    """Write `record` to `path` in one step: a reader sees the whole file or no file.

    Every written record can be read: texts of the error are cut to `LONGEST_TEXT` characters, and anything
    else that `read_record` would refuse is refused before `path` is touched. A symbolic link at `path` is
    replaced, and its target is left alone.

    Raises:
        InputError: The record could not be read again: a field does not fit the schema, is not JSON, or is
            too large.
    """
    check_diagnostics(record.diagnostics)
    text = record_text(record)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as partial:
        try:
            with open(partial, "x", encoding="utf-8", newline="\n") as file:
                file.write(text)
        except OSError as error:
            error.filename = str(path)  # a full disk names no file
            raise
        _check_readable(partial)


def write_result(record: Record, path: Path) -> None:
    """Write the record of a run, but lose no record of a run that succeeded, or may have succeeded.

    If this run failed, such a record stays in its place, and the new one lies next to it, with the ending
    ".failed", until a run succeeds. If it has other settings, another budget or another device, its file is
    kept next to the new one, with the ending ".old". An equal run replaces it.

    Raises:
        InputError: As for `write_record`.
    """
    try:
        before = read_record(path)
        is_kept, is_other = before.status == "success", not _holds(record, before)
    except UnreadableRecordError:
        is_kept = is_other = True
    except RecordError:
        is_kept = is_other = False
    if is_kept and record.status == "failed":
        aside = failed_name(path)
        write_record(record, aside)
        LOG.warning(
            "%s stays: its run succeeded, or may have succeeded. The new run failed: its record is %s.",
            *(path, aside.name),
        )
        return
    if is_kept and is_other:
        aside = free_name(path, "old")
        with replacing(aside) as partial:  # copied, not renamed: a reader finds a record there at any time
            shutil.copyfile(path, partial)
        LOG.warning(
            "%s had other settings, another budget or another device: it is kept as %s.", path, aside.name
        )
    write_record(record, path)
    failed_name(path).unlink(missing_ok=True)


def _holds(record: Record, before: Record) -> bool:
    """Return whether a record is of the same run as another, or of that run with perturbed episodes too."""
    perturb = before.run.perturb or record.run.perturb
    was = (dataclasses.replace(before.run, perturb=perturb), before.scenario)
    return was == (record.run, record.scenario)


def record_text(record: Record) -> str:
    """Return the text of the file of `record`, which need not be a valid record.

    Raises:
        InputError: The record holds values that JSON cannot hold.
    """
    try:
        values = {"schema": SCHEMA, **{name: _fields(part) for name, part in _fields(record).items()}}
        if isinstance(record.error, dict):
            values["error"] = {name: _cut(text) for name, text in record.error.items()}
        lines = [f"{json.dumps(name)}: {_dump(value)}" for name, value in values.items()]
        # hashed as a reader finds it: tuples are lists there, and names of entries are texts
        content = content_hash(json.loads("{" + ",".join(lines) + "}"))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"the record holds a value that JSON cannot hold: {error}") from error
    return "{\n" + ",\n".join([*lines, f'"content": "{content}"']) + "\n}\n"


def check_diagnostics(diagnostics: dict[str, Any]) -> None:
    """Refuse diagnostics that a record cannot hold.

    Args:
        diagnostics: `Record.diagnostics`: what a method reported, by stage.

    Raises:
        InputError: They are not JSON within the limits, or larger than `MOST_DIAGNOSTICS`.
    """
    try:
        text = json.dumps(diagnostics, allow_nan=False)
        check_json(json.loads(text), "diagnostics")
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"diagnostics cannot be written as JSON: {error}") from error
    if len(text) > MOST_DIAGNOSTICS:
        raise InputError(f"diagnostics have {len(text):,} bytes, more than {MOST_DIAGNOSTICS:,}.")


def _check_readable(path: Path) -> None:
    """Refuse a file that `read_record` would refuse."""
    try:
        read_record(path)
    except RecordError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise InputError(f"the record could not be read again: {reason}") from error


def _fields(value: Any) -> Any:
    """Return the fields of a dataclass by name, other values as they are; `asdict` copies each entry."""
    if not dataclasses.is_dataclass(value):
        return value
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def _cut(text: Any) -> Any:
    """Return a text of an error, without its middle if it is too long: tracebacks matter at both ends."""
    if not isinstance(text, str) or len(text) <= LONGEST_TEXT:
        return text
    half = LONGEST_TEXT // 2 - 100
    return text[:half] + CUT.format(count=len(text) - 2 * half) + text[-half:]


def _dump(value: Any) -> str:
    """Return JSON with one line for each entry of a dictionary, so that columns and settings read well."""
    if isinstance(value, dict) and value:
        rows = (f"  {json.dumps(key)}: {json.dumps(entry, allow_nan=False)}" for key, entry in value.items())
        return "{\n" + ",\n".join(rows) + "\n}"
    return json.dumps(value, allow_nan=False)
