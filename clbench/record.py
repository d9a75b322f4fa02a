"""The record: the one file that a run leaves, written once and never edited.

Every evaluation episode, every answer count and how far the policy had moved are in it; nothing that can be
computed from them is.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

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
"""

ANSWER_COLUMNS = ("stage", "step", "kind", "asked", "correct")
"""One row for each stage, evaluation point and kind of question."""

POLICY_COLUMNS = ("stage", "step", "update_sparsity", "activation_drift")
"""One row for each stage and evaluation point: how far the policy is from the pretrained one.

`update_sparsity` is the share of its parameters whose relative change is below 1e-3; `activation_drift` the
squared 2-Wasserstein distance between its hidden states on the questions and those of the pretrained policy,
mean over layers. Each may be None.
"""


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
    (the prior data it may touch)."""
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
    """`parameters`, `parameters_added`, `optimiser_steps`, `bytes_kept`."""
    diagnostics: dict[str, Any] = field(default_factory=dict)
    """What the method tells about itself."""
    fingerprint: dict[str, Any] = field(default_factory=dict)
    """Commit of `clbench`, package versions, hardware, `rollouts` (a hash for each world), hash of the
    pretrained policy."""
    timing: dict[str, Any] = field(default_factory=dict)
    """Dates and seconds: all that may differ between two equal runs."""
    error: dict[str, str] | None = None
    """For a failed run: `where` (the seam and stage), `type`, `message`, `traceback`."""


def label_of(method: str, changes: Mapping[str, Any]) -> str:
    """Return the method with what was changed of it, as "experience_replay+replay=0.02"."""
    return "+".join([method, *(f"{name}={value}" for name, value in sorted(changes.items()))])


def record_path(records: Path, scenario: str, method: str, seed: int) -> Path:
    """Return where the record of a run lies below the folder `records`."""
    folder = [
        part.replace("/", "--").replace(":", "--") for part in (scenario.removeprefix("clbench/"), method)
    ]
    return records.joinpath(*folder, f"seed-{seed}.json")


def write_record(record: Record, path: Path) -> None:
    """Write `record` to `path` in one step: a reader sees the whole file or none."""
    values = {"schema": SCHEMA, **dataclasses.asdict(record)}
    text = "{\n" + ",\n".join(f"{json.dumps(key)}: {_dump(value)}" for key, value in values.items()) + "\n}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _dump(value: Any) -> str:
    """Return JSON with one line for each entry of a dictionary, so that columns and settings read well."""
    if isinstance(value, dict) and value:
        rows = (f"  {json.dumps(key)}: {json.dumps(entry, allow_nan=False)}" for key, entry in value.items())
        return "{\n" + ",\n".join(rows) + "\n}"
    return json.dumps(value, allow_nan=False)


def read_record(path: Path) -> Record:
    """Read the record at `path`.

    Raises:
        RecordError: The file is torn, foreign, of another schema, or its columns do not fit together.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_number)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}).") from error
    except (ValueError, RecursionError) as error:
        raise RecordError(f"{path}: cannot be read as JSON ({error}).") from error
    schema = values.pop("schema", None) if isinstance(values, dict) else None
    if type(schema) is int and 0 < schema < SCHEMA:
        raise RecordError(
            f"{path}: is of the older schema {schema}, not {SCHEMA}: its run must be done again."
        )
    if schema != SCHEMA:
        raise RecordError(f"{path}: is no record of schema {SCHEMA}.")
    names = {entry.name for entry in dataclasses.fields(Record)}
    if set(values) != names:
        raise RecordError(f"{path}: fields differ from schema {SCHEMA}: {sorted(set(values) ^ names)}.")
    record = Record(**values)
    if record.status not in ("success", "failed"):
        raise RecordError(f"{path}: status must be success or failed, not {record.status!r}.")
    for name in ("run", "scenario", "costs", "diagnostics", "fingerprint", "timing", "error"):
        if not isinstance(values[name], dict) and not (name == "error" and values[name] is None):
            raise RecordError(f"{path}: {name} must be an object with named entries.")
    _check_columns(path, "episodes", record.episodes, EPISODE_COLUMNS)
    _check_columns(path, "answers", record.answers, ANSWER_COLUMNS)
    _check_columns(path, "policy", record.policy, POLICY_COLUMNS)
    return record


def _no_number(name: str) -> Any:
    """Refuse NaN and infinities, which Python reads although JSON has none."""
    raise ValueError(f"{name} is no number")


def _check_columns(path: Path, name: str, table: Any, columns: Iterable[str]) -> None:
    if not isinstance(table, dict) or tuple(table) != tuple(columns):
        raise RecordError(f"{path}: {name} must have the columns {', '.join(columns)}.")
    lengths = {len(column) if isinstance(column, list) else -1 for column in table.values()}
    if len(lengths) != 1 or -1 in lengths:
        raise RecordError(f"{path}: the columns of {name} have different lengths.")
