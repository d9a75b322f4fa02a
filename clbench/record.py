"""The record: the one file that a run leaves, written once and never edited.

Every evaluation episode, every answer count and how far the policy had moved are in it; nothing that can be
computed from them is.
"""

from __future__ import annotations

import dataclasses
import json
import os
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from clbench.names import check_label, check_plain, check_scenario_id, folder_name
from clbench.strict_json import StrictJSONError, quoted, read_json
from clbench.task import unknown

SCHEMA = 2
"""Version of the file format. A reader refuses what it does not know."""

RECORDS = Path("leaderboard/records")
"""Where the records of the board lie, seen from the working directory."""

TUNING = Path("leaderboard/tuning")
"""Where the records of tuning runs lie, seen from the working directory."""

EPISODE_COLUMNS = ("stage", "step", "task", "split", "episode", "success", "return", "length")
"""`stage` 0 is the pretrained policy, `stage` k the policy while or after it learned target k; `step` counts
the optimiser steps inside the stage; `episode` numbers the initial state inside its task and split.

After each stage come all report episodes of all tasks. At the points before, the retained skills and the
stage's target have the first `curve_episodes` of these; at every point the target has all selection episodes.
In a tuning run, whose `Record.run` has the split "selection", selection episodes take the place of all these.
Where `Record.run` says `perturb`, the retained skills have perturbed episodes too, from stage 0 at the end of
each: those of the report, number by number, in worlds that are disturbed.
"""

ANSWER_COLUMNS = ("stage", "step", "kind", "asked", "correct")
"""One row for each stage, evaluation point and kind of question; an agent that learned online is asked 0."""

POLICY_COLUMNS = ("stage", "step", "update_sparsity", "activation_drift")
"""One row for each stage and evaluation point: how far the policy is from the pretrained one.

`update_sparsity` is the share of its parameters whose relative change is below 1e-3; `activation_drift` the
squared 2-Wasserstein distance between its hidden states on the questions and those of the pretrained policy,
mean over layers. Each may be None.
"""

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


class RecordError(ValueError):
    """A file is not a record that can be read."""


@dataclass
class Record:
    """What one run did and what came of it. Field order is part of the file format."""

    status: Literal["success", "failed"]
    """Whether the run went through."""
    run: dict[str, Any]
    """What was run: `scenario`, `method`, `seed`, `device`, `split` ("report", or "selection" for a tuning
    run), `settings` (all hyper-parameters), `changes` (those that differ from the method's defaults), `uses`
    (the prior data it may touch; and `online`, true, for an agent that learned by trial in the worlds). Where
    the targets were not learned in the published order, also `order`, the number of theirs: see
    `clbench.task.target_order`. Where the skills met perturbed episodes, also `perturb`, true."""
    scenario: dict[str, Any]
    """The scenario in full: `retained`, `target` and `held_out` task names in order, `evaluation_steps`
    (steps of a stage after which it is evaluated, the last one its end), and its `budget`."""
    episodes: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in EPISODE_COLUMNS})
    """Evaluation episodes as columns of equal length, see `EPISODE_COLUMNS`."""
    answers: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in ANSWER_COLUMNS})
    """Answers as columns of equal length, see `ANSWER_COLUMNS`: to report questions, in a tuning run to
    training questions."""
    policy: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in POLICY_COLUMNS})
    """What has become of the policy as columns of equal length, see `POLICY_COLUMNS`."""
    costs: dict[str, Any] = field(default_factory=dict)
    """`parameters`, `parameters_added`, `optimiser_steps`, those of them that are `preparation_steps`,
    `bytes_kept`, and `environment_steps` of an agent that learned online: whole numbers."""
    diagnostics: dict[str, Any] = field(default_factory=dict)
    """What the method tells about itself."""
    fingerprint: dict[str, Any] = field(default_factory=dict)
    """Commit of `clbench`, package versions, hardware, `rollouts` (a hash for each world), `method` (who made
    it, its version and the hash of its source), hash of the pretrained policy."""
    timing: dict[str, Any] = field(default_factory=dict)
    """Dates and seconds: all that may differ between two equal runs."""
    error: dict[str, str] | None = None
    """For a failed run: `where` (the seam and stage), `type`, `message`, `traceback`."""


def append_row(columns: dict[str, list[Any]], row: Iterable[Any]) -> None:
    """Append a row to columns of a record."""
    for column, value in zip(columns.values(), row, strict=True):
        column.append(value)


def label_of(method: str, changes: Mapping[str, Any]) -> str:
    """Return the method with what was changed of it, as "experience_replay+replay=0.02"."""
    return "+".join([method, *(f"{name}={value}" for name, value in sorted(changes.items()))])


def record_name(scenario: str, label: str, seed: int, order: int = 0) -> Path:
    """Return where the record of a run lies, seen from the folder of records; no other run has this place.

    Args:
        scenario: Gymnasium id.
        label: The method and what was changed of it, see `label_of`.
        seed: Of the run.
        order: In which the targets were learned; 0 is the published one.

    Raises:
        ValueError: A name is refused.
    """
    check_scenario_id(scenario)
    check_label(label)
    name = f"seed-{seed}-order-{order}.json" if order else f"seed-{seed}.json"
    return Path(folder_name(scenario), folder_name(label), name)


def record_path(records: Path, scenario: str, label: str, seed: int, order: int = 0) -> Path:
    """Return where the record of a run lies below the folder `records`, see `record_name`.

    Raises:
        ValueError: A name is refused, or a symbolic link leads out of the folder.
    """
    path = records / record_name(scenario, label, seed, order)
    if not path.parent.resolve().is_relative_to(records.resolve()):
        raise ValueError(f"{path.parent}: a symbolic link leads out of {records}.")
    return path


def write_record(record: Record, path: Path) -> None:
    """Write `record` to `path` in one step: a reader sees the whole file or none.

    A symbolic link that is there is replaced, and what it leads to is left alone.
    """
    values = {"schema": SCHEMA, **dataclasses.asdict(record)}
    text = "{\n" + ",\n".join(f"{json.dumps(key)}: {_dump(value)}" for key, value in values.items()) + "\n}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with open(partial, "x", encoding="utf-8") as file:
            file.write(text)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _dump(value: Any) -> str:
    """Return JSON with one line for each entry of a dictionary, so that columns and settings read well."""
    if isinstance(value, dict) and value:
        rows = (f"  {json.dumps(key)}: {json.dumps(entry, allow_nan=False)}" for key, entry in value.items())
        return "{\n" + ",\n".join(rows) + "\n}"
    return json.dumps(value, allow_nan=False)


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
