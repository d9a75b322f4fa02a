"""Runs from records: which of them may be compared, and why the others may not."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from clbench.records.paths import label_of, record_name
from clbench.records.reader import RecordError, read_record
from clbench.records.record import Record
from clbench.scoring.layout import Layout
from clbench.scoring.scores import Scores
from clbench.spec.identifiers import built_in_methods
from clbench.spec.protocol import Split
from clbench.spec.scenario import target_order

from .tiers import tier_of

DIVISIONS = ("prior-data-free", "prior questions", "prior demonstrations", "online", "reference")
"""In the order of the table: what a method may look at again; agents that learned by trial and not from
demonstrations, with which no method is compared; guides that do not compete."""

METHODS = DIVISIONS[:3]
"""Divisions of methods: they start from the same policy and learn from the same demonstrations."""

ACCESS = ("never", "prepare", "throughout")
"""When a method may touch prior data."""

LONGEST_REASON = 300
"""Characters of a reason that are shown: an error's message may be a page."""


@dataclass(frozen=True)
class NotShown:
    """A file that makes no row."""

    path: str
    """Relative to the folder of records."""
    reason: str
    """Why, in words."""


@dataclass(frozen=True, eq=False)
class Run:
    """A record that may become part of a row."""

    path: str
    record: Record
    scores: Scores
    scenario: str
    method: str
    seed: int
    division: str
    tier: str
    """One of `TIERS`."""
    order: int
    """In which the targets were learned; 0 is the published one."""
    published: dict[str, Any]
    """`Record.scenario` with the targets in their published order."""


Sifted = tuple[list[Run], list[NotShown]]

Sift = Callable[[list[Run]], Sifted]
"""What tells runs that may be compared from those that may not."""


def read_runs(folder: Path, read: Callable[[Path, Path], Run], sifts: Iterable[Sift]) -> Sifted:
    """Return the runs of the records below `folder`, sifted, and the files that are none."""
    runs: list[Run] = []
    refused: list[NotShown] = []
    for path in sorted(_files(folder), key=lambda path: path.relative_to(folder).as_posix()):
        try:
            runs.append(read(folder, path))
        except RecordError as error:
            name = path.relative_to(folder).as_posix()
            refused.append(no_row(name, str(error).removeprefix(f"{path}: ")))
    for sift in sifts:
        runs, others = sift(runs)
        refused += others
    return runs, refused


def _files(folder: Path) -> Iterator[Path]:
    """Yield what has the name of a record, and symbolic links to folders: they are not followed."""
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(parent, name)
            if name.endswith(".json") or (name in folders and path.is_symlink()):
                yield path


def read_run(folder: Path, path: Path, split: Split = "test", changed: bool | None = False) -> Run:
    """Return the run of the record at `path`, below `folder`.

    It must lie where a run writes it: the names of files tell which rows they can change.

    Args:
        folder: Folder of the records.
        path: The file.
        split: Episodes that it must have been evaluated on: those of a tuning run are of "validation".
        changed: Whether it must be of changed settings; None if it may.

    Raises:
        RecordError: It cannot be read, failed, is not of what is compared, or claims what cannot be.
    """
    record = read_record(path)
    if record.error is not None:
        what = ": ".join(record.error[key] for key in ("where", "type", "message"))
        raise RecordError(f"the run failed ({what}).")
    run, name = record.run, path.relative_to(folder).as_posix()
    _check_kind(run, split, changed)
    label = label_of(run["method"], run["changes"])
    home = _home(run, label)
    if record.scenario["id"] != run["scenario"]:
        raise RecordError(f"scenario: its id is {record.scenario['id']!r}, but {run['scenario']!r} was run.")
    _check_settings(run)
    division = division_of(run["uses"])
    if name != home:
        raise RecordError(f"it is the record of {home}, and must lie there.")
    scores, order, published = Scores.from_record(record), run.get("order", 0), _published(record)
    return Run(
        name, record, scores, run["scenario"], label, run["seed"], division, tier_of(path), order, published
    )


def _published(record: Record) -> dict[str, Any]:
    """Return `Record.scenario` with the targets in their published order."""
    targets = record.scenario["target"]
    try:
        places = target_order(len(targets), record.run.get("order", 0))
    except ValueError as error:
        raise RecordError(f"run: {error}") from error
    return {**record.scenario, "target": [name for _, name in sorted(zip(places, targets, strict=True))]}


def _home(run: dict[str, Any], label: str) -> str:
    """Return the place of the record of `run`, seen from the folder of records."""
    if run["seed"] < 0:
        raise RecordError(f"run: {run['seed']} cannot be a seed.")
    try:
        return record_name(run["scenario"], label, run["seed"], run.get("order", 0)).as_posix()
    except ValueError as error:
        raise RecordError(f"run: {error}") from error


def _check_settings(run: dict[str, Any]) -> None:
    """Refuse settings that cannot be: a built-in method has its own, but for the changed ones."""
    method, settings, changes = run["method"], run["settings"], run["changes"]
    lost = [name for name in changes if name not in settings or settings[name] != changes[name]]
    if lost:
        raise RecordError(f"run: changes and settings differ in {', '.join(lost)}.")
    if method not in built_in_methods():
        return
    uses, defaults = _declared(method)
    if run["uses"] != uses:
        raise RecordError(
            f"run: uses are not those of {method}: {', '.join(differences(run['uses'], uses))}."
        )
    # one that is missing here came later, with a default that changes nothing
    wrong = [
        name
        for name, value in settings.items()
        if name not in defaults or (name not in changes and value != defaults[name])
    ]
    if wrong:
        raise RecordError(f"run: settings are not those of {method}: {', '.join(wrong)}.")


@cache
def _declared(method: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what a built-in method uses, and its hyper-parameters with their defaults."""
    cls = built_in_methods()[method].load()
    return dataclasses.asdict(cls.uses), dataclasses.asdict(cls())


def _check_kind(run: dict[str, Any], split: Split, changed: bool | None) -> None:
    """Refuse a run of another split, or with other settings than asked for."""
    if split == "test" and run.get("split") == "validation":
        raise RecordError("it is a tuning run: its episodes may be chosen on.")
    if split == "validation" and run.get("split") == "test":
        raise RecordError("it is no tuning run: its episodes are reported.")
    if changed is False and run["changes"]:
        raise RecordError(f"settings were changed: {', '.join(run['changes'])}.")
    if changed is True and not run["changes"]:
        raise RecordError("no setting was changed: its place is among the records of the board.")


def division_of(uses: dict[str, Any]) -> str:
    """Return what a method that declares `uses` competes with.

    Raises:
        RecordError: It is no declaration.
    """
    kinds = ("demonstrations", "questions")
    if "online" in uses:
        if uses != {**dict.fromkeys(kinds, "never"), "reference": False, "online": True}:
            raise RecordError("run: uses of an agent that learned online must be of nothing else.")
        return "online"
    if set(uses) != {*kinds, "reference"} or any(uses[kind] not in ACCESS for kind in kinds):
        raise RecordError(
            f"run: uses must say when demonstrations and questions are touched, {' or '.join(ACCESS)}, and "
            "whether the method is a reference."
        )
    if type(uses["reference"]) is not bool:
        raise RecordError("run: reference of uses must be true or false.")
    if uses["reference"]:
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


def same_scenario(runs: list[Run]) -> Sifted:
    def reason(run: Run, other: Run) -> str:
        fields = differences(run.published, other.published)
        if fields == ["budget"]:
            ours, theirs = run.published["budget"], other.published["budget"]
            fields = [f"budget ({', '.join(differences(ours, theirs))})"]
        return f"its scenario is not that of most records: {', '.join(fields)} differ."

    return _most(runs, lambda run: run.scenario, lambda run: _text(run.published), reason)


def same_simulator(runs: list[Run]) -> Sifted:
    def rollouts(run: Run) -> Any:
        return run.record.fingerprint.get("rollouts")

    def reason(run: Run, other: Run) -> str:
        worlds = ", ".join(differences(rollouts(run), rollouts(other)))
        return f"its simulator is not that of most records: the rollouts of {worlds or 'all worlds'} differ."

    return _most(runs, lambda run: run.scenario, lambda run: _text(rollouts(run)), reason)


def same_layout(runs: list[Run]) -> Sifted:
    def layout(run: Run) -> Layout:
        return dataclasses.replace(run.scores.layout, target=tuple(run.published["target"]))

    def reason(run: Run, other: Run) -> str:
        fields = differences(vars(layout(run)), vars(layout(other)))
        return f"it was not evaluated like most records: {', '.join(fields)} differ."

    return _most(runs, lambda run: run.scenario, layout, reason)


def same_settings(runs: list[Run]) -> Sifted:
    def parts(run: Run) -> list[dict[str, Any]]:
        told = run.record.run
        # one that is missing in an older record came later, with a default that changes nothing
        defaults = _declared(told["method"])[1] if told["method"] in built_in_methods() else {}
        return [{**defaults, **told["settings"]}, told["uses"], {"device": told["device"]}]

    def reason(run: Run, other: Run) -> str:
        both = zip(parts(run), parts(other), strict=True)
        fields = [name for one, another in both for name in differences(one, another)]
        return f"its settings are not those of most seeds: {', '.join(fields)} differ."

    return _most(runs, lambda run: (run.scenario, run.method), lambda run: _text(parts(run)), reason)


ALIKE: tuple[Sift, ...] = (same_scenario, same_simulator, same_layout, same_settings)
"""What runs must have in common to be compared."""


def _most(
    runs: list[Run],
    group: Callable[[Run], Hashable],
    trait: Callable[[Run], Hashable],
    reason: Callable[[Run, Run], str],
) -> Sifted:
    """Keep the runs that have the usual trait of their group.

    That is the one which most runs of built-in methods have, then most runs: no number of records of other
    methods moves those off the board. Of equally frequent ones it is the first met.
    """
    members: dict[Hashable, dict[Hashable, list[Run]]] = {}
    for run in runs:
        members.setdefault(group(run), {}).setdefault(trait(run), []).append(run)
    usual = {key: max(traits.values(), key=_weight)[0] for key, traits in members.items()}
    kept = [run for run in runs if trait(run) == trait(usual[group(run)])]
    others = [run for run in runs if trait(run) != trait(usual[group(run)])]
    return kept, [no_row(run.path, reason(run, usual[group(run)])) for run in others]


def _weight(runs: list[Run]) -> tuple[int, int]:
    built_in = [run for run in runs if run.record.run["method"] in built_in_methods()]
    return len(built_in), len(runs)


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


def is_number(value: Any) -> bool:
    """Return whether a stranger's value is a number of any use."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
