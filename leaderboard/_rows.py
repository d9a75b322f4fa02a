"""Rows from records: which records can stand in one table, and what their row says."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clbench.metrics import METRICS
from clbench.record import Record, RecordError, read_record, record_path
from clbench.scores import Scores
from clbench.statistics import Estimate, Runs, estimate, row_generator

DIVISIONS = ("prior-data-free", "prior questions", "prior demonstrations", "reference")
"""In the order of the table: what a method may look at again; guides that do not compete are last."""

COSTS = {
    "steps": "optimiser_steps",
    "bytes_kept": "bytes_kept",
    "parameters": "parameters",
    "parameters_added": "parameters_added",
}
"""Column of the table, and where a record's costs have it."""

LONGEST_REASON = 300
"""Characters of a reason that are shown: an error's message may be a page."""

_SCENARIO = re.compile(r"[A-Za-z0-9][\w./:-]{0,99}", re.ASCII)
_METHOD = re.compile(r"([A-Za-z0-9][\w.-]{0,99}/)?[A-Za-z_][\w.-]{0,99}(:[A-Za-z_][\w.]{0,99})?", re.ASCII)
"""A built-in name, "package/name" or "module:Class"."""


@dataclass(frozen=True)
class Row:
    """One method on one scenario."""

    scenario: str
    """Gymnasium id."""
    method: str
    """Name or "module:Class"."""
    division: str
    """One of `DIVISIONS`."""
    seeds: tuple[int, ...]
    """Seeds of its runs."""
    estimates: Mapping[str, Estimate]
    """Value and interval of every metric."""
    costs: Mapping[str, float | None]
    """Mean over seeds by column of the table."""


@dataclass(frozen=True)
class NotShown:
    """A file that makes no row."""

    path: str
    """Relative to the folder of records."""
    reason: str
    """Why, in words."""


@dataclass(frozen=True)
class Table:
    """All that the leaderboard shows."""

    scenarios: Mapping[str, Mapping[str, Any]]
    """What the rows of each scenario have in common: `Record.scenario`."""
    rows: tuple[Row, ...]
    """By scenario, division and falling final average."""
    not_shown: tuple[NotShown, ...]
    """By path."""


@dataclass(frozen=True, eq=False)
class Run:
    """A record that may become part of a row."""

    path: str
    at_home: bool
    record: Record
    scores: Scores
    scenario: str
    method: str
    seed: int
    division: str


def read_table(records: Path) -> Table:
    """Return the table of the records anywhere below the folder `records`.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    if not records.is_dir():
        raise FileNotFoundError(f"There is no folder of records at {records}.")
    runs: list[Run] = []
    not_shown: list[NotShown] = []
    for path in sorted(records.rglob("*.json"), key=lambda path: path.relative_to(records).as_posix()):
        try:
            runs.append(read_run(records, path))
        except RecordError as error:
            name = path.relative_to(records).as_posix()
            not_shown.append(no_row(name, str(error).removeprefix(f"{path}: ")))
    for sift in (once, same_scenario, same_simulator, same_layout, same_settings):
        runs, refused = sift(runs)
        not_shown += refused
    rows = _rows(runs)
    return Table(
        scenarios={run.scenario: run.record.scenario for run in runs},
        rows=tuple(sorted(rows, key=_rank)),
        not_shown=tuple(sorted(not_shown, key=lambda entry: entry.path)),
    )


def _rank(row: Row) -> tuple[Hashable, ...]:
    value = row.estimates["final_average"].value
    return row.scenario, DIVISIONS.index(row.division), -math.inf if value is None else -value, row.method


def read_run(records: Path, path: Path) -> Run:
    """Return the run of the record at `path`.

    Raises:
        RecordError: It cannot be read, failed, or is not what the table compares.
    """
    record = read_record(path)
    run, error = record.run, record.error or {}
    if record.status == "failed":
        what = ": ".join(str(error[key]) for key in ("where", "type", "message") if key in error)
        raise RecordError(f"the run failed ({what or 'without a word'}).")
    for name in ("scenario", "method", "seed", "settings", "changes", "uses"):
        if name not in run or (name in ("settings", "changes", "uses") and not isinstance(run[name], dict)):
            raise RecordError(f"run: {name} is missing or malformed.")
    scenario, method, seed = run["scenario"], run["method"], run["seed"]
    if not isinstance(scenario, str) or not _SCENARIO.fullmatch(scenario):
        raise RecordError(f"run: {scenario!r} cannot be the id of a scenario.")
    if not isinstance(method, str) or not _METHOD.fullmatch(method):
        raise RecordError(f"run: {method!r} cannot be the name of a method, nor module:Class.")
    if type(seed) is not int or seed < 0:
        raise RecordError(f"run: {seed!r} cannot be a seed.")
    if record.scenario.get("id") != scenario:
        raise RecordError(f"scenario: its id is {record.scenario.get('id')!r}, but {scenario!r} was run.")
    if run.get("split") == "selection":
        raise RecordError("it is a tuning run: its episodes may be chosen on.")
    if run["changes"]:
        raise RecordError(f"settings were changed: {', '.join(run['changes'])}.")
    at_home = path == record_path(records, scenario, method, seed)
    name = path.relative_to(records).as_posix()
    division = division_of(run["uses"])
    return Run(name, at_home, record, Scores.from_record(record), scenario, method, seed, division)


def division_of(uses: dict[str, Any]) -> str:
    """Return what a method that declares `uses` competes with."""
    kinds = ("demonstrations", "questions")
    if any(not isinstance(uses.get(kind), str) for kind in kinds):
        raise RecordError("run: uses must say which prior demonstrations and questions the method may touch.")
    if uses.get("reference"):
        return "reference"
    used = [kind for kind in kinds if uses[kind] != "never"]
    return f"prior {used[0]}" if used else "prior-data-free"


def no_row(path: str, reason: str) -> NotShown:
    reason = printable(reason)
    reason = reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]}…"
    return NotShown(printable(path), reason)


def printable(text: str) -> str:
    """Return `text`, which a stranger may have written, without control characters and line breaks."""
    visible = (one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in text)
    return "".join(visible)


Sifted = tuple[list[Run], list[NotShown]]


def once(runs: list[Run]) -> Sifted:
    """Keep one record of each run: that at its own path, otherwise the first."""
    first: dict[Hashable, Run] = {}
    for run in sorted(runs, key=lambda run: not run.at_home):
        first.setdefault((run.scenario, run.method, run.seed), run)
    kept = [run for run in runs if run in first.values()]
    others = [(run, first[run.scenario, run.method, run.seed]) for run in runs if run not in kept]
    return kept, [no_row(run.path, f"the same run as {one.path}.") for run, one in others]


def same_scenario(runs: list[Run]) -> Sifted:
    def reason(run: Run, other: Run) -> str:
        fields = differences(run.record.scenario, other.record.scenario)
        if fields == ["budget"]:
            ours, theirs = run.record.scenario["budget"], other.record.scenario["budget"]
            fields = [f"budget ({', '.join(differences(ours, theirs))})"]
        return f"its scenario is not that of most records: {', '.join(fields)} differ."

    return _most(runs, lambda run: run.scenario, lambda run: _text(run.record.scenario), reason)


def same_simulator(runs: list[Run]) -> Sifted:
    def rollouts(run: Run) -> Any:
        return run.record.fingerprint.get("rollouts")

    def reason(run: Run, other: Run) -> str:
        worlds = ", ".join(differences(rollouts(run), rollouts(other)))
        return f"its simulator is not that of most records: the rollouts of {worlds or 'all worlds'} differ."

    return _most(runs, lambda run: run.scenario, lambda run: _text(rollouts(run)), reason)


def same_layout(runs: list[Run]) -> Sifted:
    def reason(run: Run, other: Run) -> str:
        fields = differences(vars(run.scores.layout), vars(other.scores.layout))
        return f"it was not evaluated like most records: {', '.join(fields)} differ."

    return _most(runs, lambda run: run.scenario, lambda run: run.scores.layout, reason)


def same_settings(runs: list[Run]) -> Sifted:
    def reason(run: Run, other: Run) -> str:
        fields = [
            name
            for part in ("settings", "uses")
            for name in differences(run.record.run[part], other.record.run[part])
        ]
        return f"its settings are not those of most seeds: {', '.join(fields)} differ."

    return _most(
        runs,
        lambda run: (run.scenario, run.method),
        lambda run: _text([run.record.run["settings"], run.record.run["uses"]]),
        reason,
    )


def _most(
    runs: list[Run],
    group: Callable[[Run], Hashable],
    trait: Callable[[Run], Hashable],
    reason: Callable[[Run, Run], str],
) -> Sifted:
    """Keep the runs that have their group's most frequent trait; of equally frequent ones the first met."""
    counts: dict[Hashable, Counter[Hashable]] = {}
    example: dict[Hashable, Run] = {}
    for run in runs:
        counts.setdefault(group(run), Counter())[trait(run)] += 1
        example.setdefault((group(run), trait(run)), run)
    usual = {key: example[key, counter.most_common(1)[0][0]] for key, counter in counts.items()}
    kept = [run for run in runs if trait(run) == trait(usual[group(run)])]
    others = [run for run in runs if trait(run) != trait(usual[group(run)])]
    return kept, [no_row(run.path, reason(run, usual[group(run)])) for run in others]


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def differences(values: Any, others: Any) -> list[str]:
    """Return the names under which two dictionaries differ; none if they are no dictionaries."""
    if not isinstance(values, dict) or not isinstance(others, dict):
        return []
    names = sorted(set(values) | set(others))
    return [
        name for name in names if name not in values or name not in others or values[name] != others[name]
    ]


def _rows(runs: Iterable[Run]) -> list[Row]:
    by_scenario: dict[str, dict[str, list[Run]]] = {}
    for run in runs:
        by_scenario.setdefault(run.scenario, {}).setdefault(run.method, []).append(run)
    never_itself = {
        name for metric in METRICS.values() if not metric.compares_itself for name in metric.references
    }
    rows = []
    for scenario, methods in by_scenario.items():
        scores: dict[str, Runs] = {
            method: {run.seed: run.scores for run in members} for method, members in methods.items()
        }
        for method, members in methods.items():
            # A reference is compared with itself only where that means something.
            references = {
                name: theirs for name, theirs in scores.items() if name != method or name not in never_itself
            }
            rows.append(
                Row(
                    scenario,
                    method,
                    members[0].division,
                    seeds=tuple(sorted(scores[method])),
                    estimates=estimate(
                        METRICS, scores[method], row_generator(scenario, method), references=references
                    ),
                    costs={column: _mean_cost(members, name) for column, name in COSTS.items()},
                )
            )
    return rows


def _mean_cost(runs: list[Run], name: str) -> float | None:
    """Return the mean of a cost, None if a run does not say it as a number."""
    values = [run.record.costs.get(name) for run in runs]
    numbers = [value for value in values if isinstance(value, int | float) and abs(value) < 1e18]
    return math.fsum(numbers) / len(numbers) if len(numbers) == len(values) else None


def column_names() -> list[str]:
    """Return the columns of the CSV file and of the data frame."""
    ends = ("", "_low", "_high")
    metrics = (name + end for name in METRICS for end in ends)
    return ["scenario", "method", "division", "seeds", *metrics, *COSTS]


def values_of(row: Row) -> list[str | float | None]:
    """Return the values of `row` in the order of `column_names`."""
    estimates = (row.estimates[name] for name in METRICS)
    numbers = [number for one in estimates for number in (one.value, one.low, one.high)]
    return [row.scenario, row.method, row.division, len(row.seeds), *numbers, *row.costs.values()]
