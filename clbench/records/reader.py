"""The reader of records, which checks all that a stranger may have written."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from clbench.base.entry_points import unknown
from clbench.base.errors import ClbenchError
from clbench.base.strict_json import StrictJSONError, quoted, read_json
from clbench.records.record import ANSWER_COLUMNS, EPISODE_COLUMNS, POLICY_COLUMNS, SCHEMA, Record
from clbench.spec.identifiers import check_plain

MOST_ROWS = 200_000
"""Rows of a table. A record of Fetch-v0 has 1,780 episodes."""

_Fields = Mapping[str, type | None]
"""Types of the values that must be there by name; None for any."""

_RUN: _Fields = {
    "scenario": str,
    "method": str,
    "seed": int,
    "device": str,
    "split": str,
    "settings": dict,
    "changes": dict,
    "uses": dict,
}
_MAY_RUN: _Fields = {"order": int, "perturb": bool}
"""Of `Record.run` too, where it is not what it usually is."""
_SCENARIO: _Fields = {
    "id": str,
    "retained": list,
    "target": list,
    "held_out": list,
    "evaluation_steps": list,
    "budget": dict,
}
_COSTS = (
    "optimiser_steps",
    "parameters",
    "preparation_steps",
    "parameters_added",
    "bytes_kept",
    "environment_steps",
)
"""A run that failed need not have all, nor that of an agent that learned online."""
_ERROR: _Fields = dict.fromkeys(("where", "type", "message", "traceback"), str)

_WORDS = {
    str: "a text",
    int: "a whole number",
    bool: "true or false",
    list: "a list",
    dict: "an object with named entries",
}


class RecordError(ClbenchError, ValueError):
    """A file is not a record that can be read."""


def read_record(path: Path) -> Record:
    """Read the record at `path`, which a stranger may have written.

    What its values mean is not looked at: that they can be together is checked by `Scores.from_record`.

    Raises:
        RecordError: It is not a regular file of JSON within the limits, is of another schema, has a field too
            many or too few, or its columns do not fit together.
    """
    try:
        return _record(read_json(path))
    except (StrictJSONError, RecordError) as error:
        raise RecordError(f"{path}: {error}") from error


def _record(values: Any) -> Record:
    schema = values.pop("schema", None) if isinstance(values, dict) else None
    if type(schema) is int and 0 < schema < SCHEMA:
        raise RecordError(f"is of the older schema {schema}, not {SCHEMA}: its run must be done again.")
    if type(schema) is not int or schema != SCHEMA:
        raise RecordError(f"is no record of schema {SCHEMA}.")
    names = [entry.name for entry in dataclasses.fields(Record)]
    _check_fields(f"a record of schema {SCHEMA}", values, dict.fromkeys(names))
    record = Record(**values)
    if record.status not in ("success", "failed"):
        raise RecordError(f"status must be success or failed, not {quoted(str(record.status))}.")
    _check_fields("run", record.run, _RUN, _MAY_RUN)
    if record.run.get("order", 1) < 1:
        raise RecordError("run: order must be above 0; it is left out where the targets have theirs.")
    if not record.run.get("perturb", True):
        raise RecordError("run: perturb must be true; it is left out where nothing was perturbed.")
    _check_fields("scenario", record.scenario, _SCENARIO)
    for name in ("costs", "diagnostics", "fingerprint", "timing"):
        _check_type(name, values[name], dict)
    _check_costs(record.costs)
    if record.status == "failed":
        _check_fields("error", record.error, _ERROR)
    elif record.error is not None:
        raise RecordError("error must be null: the run went through.")
    _check_columns("episodes", record.episodes, EPISODE_COLUMNS)
    _check_columns("answers", record.answers, ANSWER_COLUMNS)
    _check_columns("policy", record.policy, POLICY_COLUMNS)
    groups = (record.scenario[group] for group in ("retained", "target", "held_out"))
    _check_names("task", (name for group in groups for name in group))
    _check_names("kind of question", set(record.answers["kind"]))
    return record


def _check_fields(where: str, values: Any, fields: _Fields, optional: _Fields | None = None) -> None:
    """Refuse what is not an object with exactly these entries, but for the optional ones."""
    _check_type(where, values, dict)
    missing = [name for name in fields if name not in values]
    if missing:
        raise RecordError(f"{where}: {', '.join(missing)} is missing.")
    known = {**fields, **(optional or {})}
    for name in values:
        if name not in known:
            raise RecordError(str(unknown(f"field of {where}", name, known)))
    for name, kind in known.items():
        if kind is not None and name in values:
            _check_type(f"{where}: {name}", values[name], kind)


def _check_costs(costs: Mapping[str, Any]) -> None:
    for name, value in costs.items():
        if name not in _COSTS:
            raise RecordError(str(unknown("field of costs", name, _COSTS)))
        _check_type(f"costs: {name}", value, int)
        # a method may leave parameters out, but nothing else is less than nothing
        if value < 0 and name != "parameters_added":
            raise RecordError(f"costs: {name} must not be below 0.")


def _check_type(where: str, value: Any, kind: type) -> None:
    # not isinstance: True would pass for a whole number
    if type(value) is not kind:
        raise RecordError(f"{where} must be {_WORDS[kind]}, not {json.dumps(value)[:60]}.")


def _check_columns(name: str, table: Any, columns: Iterable[str]) -> None:
    if not isinstance(table, dict) or tuple(table) != tuple(columns):
        raise RecordError(f"{name} must have the columns {', '.join(columns)}.")
    lengths = {len(column) if isinstance(column, list) else -1 for column in table.values()}
    if len(lengths) != 1 or -1 in lengths:
        raise RecordError(f"the columns of {name} have different lengths.")
    if max(lengths) > MOST_ROWS:
        raise RecordError(f"{name} has {max(lengths):,} rows, more than {MOST_ROWS:,}.")
    for column, values in table.items():
        if {list, dict} & set(map(type, values)):
            raise RecordError(f"{name}: {column} must not hold lists or objects.")


def _check_names(kind: str, names: Iterable[Any]) -> None:
    for name in names:
        _check_type(f"the name of a {kind}", name, str)
        try:
            check_plain(kind, name)
        except ValueError as error:
            raise RecordError(str(error)) from error
