"""The reader of records, which checks everything that a stranger may have written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from clbench.base.errors import ClbenchError, InputError
from clbench.base.strict_json import StrictJSONError, read_json, refusal
from clbench.base.text import quoted
from clbench.records.content import content_hash
from clbench.records.fields import load_fields
from clbench.records.history import OLDEST, to_present
from clbench.records.paths import label_of, record_name
from clbench.records.record import (
    EPISODE_COLUMNS,
    SCHEMA,
    AnswerRow,
    CheckRow,
    Costs,
    PolicyRow,
    Record,
    RunInfo,
)
from clbench.spec.identifiers import check_plain
from clbench.spec.scenario import MOST_ORDERS

MOST_ROWS = 200_000
"""Most rows of a table. A record of FetchPixels-v0 has 1,780 episodes."""

FIRST_HASHED = 3
"""First schema whose records have a hash of their content."""

FIRST_DEFINED = 4
"""First schema whose records have the definition of their scenario."""

ERROR_FIELDS = ("where", "type", "message", "traceback")
"""Names of the texts in `Record.error`."""


class RecordError(ClbenchError, ValueError):
    """A file is not a record that can be read."""


class UnreadableRecordError(RecordError):
    """A record that may be sound cannot be read here: it is of a newer schema, or the file system refuses."""


def read_record(path: Path | str) -> Record:
    """Read the record at `path`, which a stranger may have written.

    A record of an older schema is converted. The reader checks the form of a record. `Scores.from_record`
    checks whether its values agree with each other.

    Raises:
        RecordError: The file is not a regular file of JSON within the limits, is of an unknown schema, lacks
            a field, has an unknown one or one of another type, has columns that do not fit together, or does
            not match the hash of its content.
    """
    try:
        return _record(read_json(Path(path)))
    except (StrictJSONError, InputError, RecordError) as error:
        may_be_sound = isinstance(error, UnreadableRecordError) or refusal(error) is not None
        kind = UnreadableRecordError if may_be_sound else RecordError
        raise kind(f"{path}: {error}") from error


def home_of(run: RunInfo) -> Path:
    """Return the path that the record of a run has below its folder of records.

    Raises:
        RecordError: A name or the seed is impossible.
    """
    if run.seed < 0:
        raise RecordError(f"run: {run.seed} cannot be a seed.")
    try:
        return record_name(run.scenario, label_of(run.method, run.changes), run.seed, run.order, run.policy)
    except ClbenchError as error:
        raise RecordError(f"run: {error}") from error


def check_home(run: RunInfo, path: Path, records: Path | None = None) -> Path:
    """Return `home_of` a run, if its record is in that place.

    Args:
        run: The run.
        path: Path of its record.
        records: Folder of the records; if None, `path` only has to end with the place.

    Raises:
        RecordError: The record is at another place, or a name or the seed is impossible.
    """
    home = home_of(run)
    if home.parts != (path.relative_to(records).parts if records else path.parts[-len(home.parts) :]):
        raise RecordError(f"it belongs at {home.as_posix()} in the folder of records.")
    return home


def _record(values: Any) -> Record:
    """Return the record in `values`, which `json` read from its file."""
    schema = values.get("schema") if isinstance(values, dict) else None
    if type(schema) is not int or schema < OLDEST:
        found = (
            "no object" if not isinstance(values, dict) else "none" if schema is None else quoted(str(schema))
        )
        raise RecordError(
            f"is not a record of clbench: expected an object whose `schema` is a whole number from "
            f"{OLDEST} to {SCHEMA}, found {found}."
        )
    if schema > SCHEMA:
        raise UnreadableRecordError(f"has schema {schema}, which is newer than {SCHEMA}: update clbench.")
    fields = {name: value for name, value in values.items() if name not in ("schema", "content")}
    if schema < SCHEMA:
        fields = to_present(fields, schema)
    record = load_fields(Record, fields, f"a record of schema {schema}")
    assert isinstance(record, Record)
    _check_costs(record.costs)
    _check_error(record)
    if schema >= FIRST_DEFINED and record.status == "success":
        _check_definition(record, schema)
    record.episodes = _table("episodes", record.episodes, EPISODE_COLUMNS)
    record.answers = _table("answers", record.answers, AnswerRow._fields)
    record.policy = _table("policy", record.policy, PolicyRow._fields)
    record.checks = _table("checks", record.checks, CheckRow._fields)
    scenario = record.scenario
    _check_names("task", (*scenario.retained, *scenario.target, *scenario.held_out))
    _check_names("kind of question", set(record.answers["kind"]))
    _check_order(record)
    _check_budget(scenario.budget)
    if schema >= FIRST_HASHED:
        _check_content(values, schema)
    elif "content" in values:
        raise RecordError(f"a record of schema {schema} has no content: only later ones are hashed.")
    return record


def _check_content(values: dict[str, Any], schema: int) -> None:
    if "content" not in values:
        raise RecordError(f"a record of schema {schema}: content is missing.")
    if values["content"] != content_hash(values):
        raise RecordError("its content does not match its hash: the file was changed or damaged.")


def _check_definition(record: Record, schema: int) -> None:
    if not isinstance(record.fingerprint.get("definition"), dict):
        raise RecordError(
            f"a record of schema {schema}: fingerprint.definition must be an object, the parts of its "
            "scenario."
        )


def _check_costs(costs: Costs) -> None:
    for name, value in vars(costs).items():
        # a method may remove parameters, but no other cost can be negative
        if value is not None and value < 0 and name != "parameters_added":
            raise RecordError(f"costs: {name} must not be below 0.")


def _check_error(record: Record) -> None:
    """Refuse an error of a run that succeeded, and a failure without its texts."""
    if record.status == "success":
        if record.error is not None:
            raise RecordError("error must be null: the run succeeded.")
        return
    if record.error is None:
        raise RecordError("error must be an object with named entries: the run failed.")
    if set(record.error) != set(ERROR_FIELDS):
        raise RecordError(f"error must have the entries {', '.join(ERROR_FIELDS)}.")
    for name, text in record.error.items():
        if not isinstance(text, str):
            raise RecordError(f"error: {name} must be a string.")


def _check_budget(budget: dict[str, Any]) -> None:
    """Refuse impossible counts: what a budget demands is listed, and compared with what was done."""
    questions, curve, episodes = (
        budget.get(name, 0) for name in ("test_questions", "curve_episodes", "test_episodes")
    )
    if type(questions) is not int or questions < 0:
        found = json.dumps(questions)[:60]
        raise RecordError(f"scenario: test_questions of its budget must be a whole number, not {found}.")
    if type(curve) is type(episodes) is int and curve > episodes:
        raise RecordError(
            f"scenario: curve_episodes of its budget must be at most its test_episodes, {episodes:,}, not "
            f"{curve:,}."
        )


def _check_order(record: Record) -> None:
    """Refuse an order that no run can have: tables hold it in 64 bits, and pages compare the orders."""
    if not 0 <= record.run.order <= MOST_ORDERS:
        raise RecordError(f"run: order must be from 0 to {MOST_ORDERS}.")
    if record.run.order and record.scenario.balanced:
        raise RecordError("run: order must be 0: each seed of its scenario has an order of its own.")


def _table(name: str, table: dict[str, Any], columns: Sequence[str]) -> dict[str, list[Any]]:
    """Return a table with its columns in order, after checking them."""
    if table.keys() != set(columns):
        raise RecordError(f"{name} must have the columns {', '.join(columns)}.")
    for column, values in table.items():
        if not isinstance(values, list):
            raise RecordError(f"{name}: {column} must be a list.")
        if {list, dict} & set(map(type, values)):
            raise RecordError(f"{name}: {column} must not hold lists or objects.")
    lengths = set(map(len, table.values()))
    if len(lengths) != 1:
        raise RecordError(f"the columns of {name} have different lengths.")
    if max(lengths) > MOST_ROWS:
        raise RecordError(f"{name} has {max(lengths):,} rows, more than {MOST_ROWS:,}.")
    return {column: table[column] for column in columns}


def _check_names(kind: str, names: Iterable[Any]) -> None:
    for name in names:
        if not isinstance(name, str):
            raise RecordError(f"the name of a {kind} must be a string, not {name!r}.")
        check_plain(kind, name)
