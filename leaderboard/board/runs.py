"""Runs from records: which may be compared, and why the others may not."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Container, Hashable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from clbench.base.text import printable
from clbench.records.fingerprints import LATER, machine_of, other_parts
from clbench.records.paths import label_of, table_name
from clbench.records.pinned import pinned
from clbench.records.reader import RecordError, check_home, home_of, read_record
from clbench.records.record import EXTERNAL_USES, ONLINE_USES, Record, RunInfo, ScenarioInfo
from clbench.runs.tuning import tuned_settings
from clbench.scoring.layout import Layout
from clbench.scoring.scores import Scores
from clbench.spec.identifiers import built_in_methods
from clbench.spec.protocol import FIRST_TUNING_SEED
from clbench.spec.scenario import balanced_order, target_order

from .summary import REFERENCE, NotShown
from .tiers import verification_of

ACCESS = ("never", "prepare", "throughout")
"""Values of `Record.run.uses`: when a method may use prior data."""

PRIOR = ("demonstrations", "questions")
"""Kinds of prior data in `Record.run.uses`; the first that a method may use names its division."""

LONGEST_REASON = 300
"""Characters of a reason that are shown; an error's message may be a page long."""


@dataclass(frozen=True, eq=False)
class Run:
    """A record that may become part of a row."""

    path: str
    """Path of its record, relative to the folder of records."""
    record: Record
    """The record."""
    scores: Scores
    """Scores of the record."""
    table: str
    """Table of the run: the scenario, with the policy if it is not the default one; see `table_name`."""
    label: str
    """The method with its changed hyper-parameters, see `label_of`."""
    seed: int
    """Seed of the run."""
    division: str
    """One of `DIVISIONS`."""
    tier: str
    """One of `TIERS`."""
    findings: tuple[tuple[str, str], ...]
    """What its verification found: `Verification.notes`."""
    order: int
    """Order in which the targets were learned; 0 is the published one."""
    published: ScenarioInfo
    """`Record.scenario` with the targets in their published order."""


Sifted = tuple[list[Run], list[NotShown]]
"""Runs that may be compared, and the files that may not."""

Sift = Callable[[list[Run]], Sifted]
"""Function that keeps the runs that may be compared with each other."""


def read_runs(
    folder: Path,
    read: Callable[[Path, Path], Run],
    sifts: Iterable[Sift],
    only: Container[str] | None = None,
) -> Sifted:
    """Return the runs of the records below `folder` that pass all sifts, and the files that are refused.

    Args:
        folder: Folder of the records.
        read: Reads one record below a folder.
        sifts: Functions that keep the runs that may be compared.
        only: Paths of the files to read, relative to the folder; None for all.
    """
    runs: list[Run] = []
    refused: list[NotShown] = []
    for path in sorted(_files(folder), key=lambda path: path.relative_to(folder).as_posix()):
        name = path.relative_to(folder).as_posix()
        if only is not None and name not in only:
            continue
        try:
            runs.append(read(folder, path))
        except RecordError as error:
            refused.append(no_row(name, str(error).removeprefix(f"{path}: ")))
    for sift in sifts:
        runs, others = sift(runs)
        refused += others
    return runs, refused


def _files(folder: Path) -> Iterator[Path]:
    """Yield files named like records, and symbolic links to folders, which are not followed."""
    for parent, folders, names in os.walk(folder):
        for name in (*folders, *names):
            path = Path(parent, name)
            if name.endswith(".json") or (name in folders and path.is_symlink()):
                yield path


def read_run(folder: Path, path: Path, changed: bool | None = False) -> Run:
    """Return the run of the record at `path`, below `folder`.

    The file must have the path that a run gives it, so that its name shows which row it can change.

    Args:
        folder: Folder of the records.
        path: Path of the file.
        changed: Whether its settings must be changed; None if they may or may not be.

    Raises:
        RecordError: It cannot be read, its run failed or is of another kind, or it contradicts itself.
    """
    record = read_record(path)
    if record.error is not None:
        raise RecordError(f"the run failed ({record.failure}).")
    run = record.run
    _check_kind(run, changed)
    name = home_of(run).as_posix()
    if record.scenario.id != run.scenario:
        raise RecordError(f"scenario: its id is {record.scenario.id!r}, but {run.scenario!r} was run.")
    _check_settings(run)
    division = division_of(run.uses)
    check_home(run, path, folder)
    scores, published, verification = Scores.from_record(record), _published(record), verification_of(path)
    return Run(
        name,
        record,
        scores,
        table_name(run.scenario, run.policy),
        label_of(run.method, run.changes),
        run.seed,
        division,
        verification.tier,
        verification.notes,
        run.order,
        published,
    )


def _published(record: Record) -> ScenarioInfo:
    """Return `Record.scenario` with the targets in their published order."""
    targets = record.scenario.target
    try:
        if record.scenario.balanced and not record.run.trained_elsewhere:  # those keep the published order
            places = balanced_order(len(targets), record.run.seed)
        else:
            places = target_order(len(targets), record.run.order)
    except ValueError as error:
        raise RecordError(f"run: {error}") from error
    target = [name for _, name in sorted(zip(places, targets, strict=True))]
    return dataclasses.replace(record.scenario, target=target)


def _check_settings(run: RunInfo) -> None:
    """Refuse impossible settings: a built-in method has its defaults, except for the changes."""
    method, settings, changes = run.method, run.settings, run.changes
    lost = [name for name in changes if name not in settings or settings[name] != changes[name]]
    if lost:
        raise RecordError(f"run: changes and settings differ in {', '.join(lost)}.")
    if method not in built_in_methods():
        return
    uses, defaults = _declared(table_name(run.scenario, run.policy), method, run.split != "validation")
    if run.uses != uses:
        raise RecordError(f"run: uses do not match {method}: {', '.join(differences(run.uses, uses))}.")
    # a setting that is missing here was added later, with a default that changes nothing
    wrong = [
        name
        for name, value in settings.items()
        if name not in defaults or (name not in changes and value != defaults[name])
    ]
    if wrong:
        raise RecordError(f"run: settings do not match {method}: {', '.join(wrong)}.")


@cache
def _declared(table: str, method: str, tuned: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the prior data that a built-in method uses, and its settings, tuned for the table or not."""
    cls = built_in_methods()[method].load()
    settings = tuned_settings(table, method) if tuned else {}
    return dataclasses.asdict(cls.uses), {**dataclasses.asdict(cls()), **settings}


def _check_kind(run: RunInfo, changed: bool | None) -> None:
    """Refuse a tuning run where test runs are wanted, and changed settings where none may be, or the reverse.

    If `changed` is None, any kind will do, but no test run has a tuning seed.
    """
    if run.split == "validation":
        if changed is not None:
            raise RecordError("it is a tuning run: settings may have been chosen on its episodes.")
    elif run.seed >= FIRST_TUNING_SEED:
        raise RecordError(
            f"seeds from {FIRST_TUNING_SEED} are for tuning: settings may be chosen on their episodes."
        )
    if changed is False and run.changes:
        raise RecordError(f"settings were changed: {', '.join(run.changes)}.")
    if changed is True and not run.changes:
        raise RecordError("no setting was changed: it belongs in the records of the board.")


def division_of(uses: dict[str, Any]) -> str:
    """Return the division of a method that declares `uses`.

    Raises:
        RecordError: `uses` is not a valid declaration.
    """
    if "external" in uses:
        if uses != EXTERNAL_USES:
            raise RecordError("run: uses of a policy that was fine-tuned elsewhere must hold nothing else.")
        return "external"
    if "online" in uses:
        if uses != ONLINE_USES:
            raise RecordError("run: uses of an agent that learned online must hold nothing else.")
        return "online"
    if set(uses) != {*PRIOR, "reference"} or any(uses[kind] not in ACCESS for kind in PRIOR):
        raise RecordError(
            f"run: uses must say when {' and '.join(PRIOR)} are used, {' or '.join(ACCESS)}, and "
            "whether the method is a reference."
        )
    if type(uses["reference"]) is not bool:
        raise RecordError("run: reference of uses must be true or false.")
    if uses["reference"]:
        return REFERENCE
    used = [kind for kind in PRIOR if uses[kind] != "never"]
    return f"prior {used[0]}" if used else "prior-data-free"


def no_row(path: str, reason: str) -> NotShown:
    """Return the entry of a file that makes no row, with printable texts of limited length."""
    reason = printable(reason)
    reason = reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]}…"
    return NotShown(printable(path), reason)


def sift_by(runs: Iterable[Run], fault: Callable[[Run], str]) -> Sifted:
    """Keep the runs without a fault.

    Args:
        runs: The runs.
        fault: Returns why a run may not be compared, in a sentence; empty if it may.
    """
    faults = {run: fault(run) for run in runs}
    kept = [run for run, found in faults.items() if not found]
    return kept, [no_row(run.path, found) for run, found in faults.items() if found]


def same_scenario(runs: list[Run]) -> Sifted:
    """Keep the runs whose scenario is the usual one; targets are compared in the published order."""

    def reason(run: Run, other: Run) -> str:
        fields = differences(vars(run.published), vars(other.published))
        if fields == ["budget"]:
            ours, theirs = run.published.budget, other.published.budget
            fields = [f"budget ({', '.join(differences(ours, theirs))})"]
        return f"its scenario does not match most records: {', '.join(fields)} differ."

    return _most(runs, lambda run: run.table, lambda run: _text(vars(run.published)), reason)


def same_simulator(runs: list[Run]) -> Sifted:
    """Keep the runs whose worlds move in the usual way, by the hashes of their rollouts."""

    def rollouts(run: Run) -> Any:
        return run.record.fingerprint.get("rollouts")

    def reason(run: Run, other: Run) -> str:
        worlds = ", ".join(differences(rollouts(run), rollouts(other)))
        return f"its simulator does not match most records: the rollouts of {worlds or 'all worlds'} differ."

    return _most(runs, lambda run: run.table, lambda run: _text(rollouts(run)), reason)


def same_definition(runs: list[Run]) -> Sifted:
    """Keep the runs whose scenario is defined as here, or, if it is not the project's, as in most records.

    Worlds move differently on ARM. If a table has no run of the pinned definition, its runs of ARM are
    compared with one another, and with the pin in the parts that depend on no processor. A record is kept if
    it is older than definitions, or than the parts of `LATER` in which it would differ.
    """
    ours = [run for run in runs if run.record.run.scenario in pinned()]
    fitting = {run.table for run in ours if not unlike_the_pin(run)}
    alone = {run for run in ours if _is_of_arm(run) and run.table not in fitting}
    here, changed = sift_by(ours, lambda run: unlike_the_pin(run, moves=run in alone))
    theirs = [run for run in runs if run.record.run.scenario not in pinned()]
    kept, refused = _same_parts([*theirs, *(run for run in here if run in alone)], later=False)
    kept, others = _same_parts(kept, later=True)
    return [*kept, *(run for run in here if run not in alone)], [*refused, *others, *changed]


def unlike_the_pin(run: Run, moves: bool = False) -> str:
    """Return in words where a run of a project's scenario differs from the pin; empty if it does not.

    If its worlds may move differently (`moves`), tasks and questions do not count: they come from episodes.
    """
    scenario = run.record.run.scenario
    parts = other_parts(_definition(run), pinned()[scenario]) if scenario in pinned() else []
    other = [name for name in parts if not (moves and name.startswith(("task ", "questions")))]
    if not other:
        return ""
    where = f" Worlds move differently on {machine_of(run.record.fingerprint)}." if _is_of_arm(run) else ""
    return f"it was made with another definition of {scenario}: {', '.join(other)} differ.{where}"


def _is_of_arm(run: Run) -> bool:
    return machine_of(run.record.fingerprint) in ("aarch64", "arm64")


def _same_parts(runs: list[Run], later: bool) -> Sifted:
    """Keep the runs whose parts of `LATER`, or whose other parts, are the usual ones or missing."""

    def parts(run: Run) -> Any:
        found = _definition(run)
        if not isinstance(found, dict):
            return None if later else found
        asked = {name: value for name, value in found.items() if name.startswith(LATER) == later}
        return asked if asked or not later else None

    def reason(run: Run, other: Run) -> str:
        names = ", ".join(differences(parts(run), parts(other)))
        return f"its definition of the scenario does not match most records: {names} differ."

    told = [run for run in runs if parts(run) is not None]
    kept, refused = _most(told, lambda run: run.table, lambda run: _text(parts(run)), reason)
    return [*kept, *(run for run in runs if parts(run) is None)], refused


def _definition(run: Run) -> Any:
    return run.record.fingerprint.get("definition")


def same_layout(runs: list[Run]) -> Sifted:
    """Keep the runs that were evaluated on the usual episodes, points and questions."""

    def layout(run: Run) -> Layout:
        return dataclasses.replace(run.scores.layout, target=tuple(run.published.target))

    def reason(run: Run, other: Run) -> str:
        fields = differences(vars(layout(run)), vars(layout(other)))
        return f"it was not evaluated like most records: {', '.join(fields)} differ."

    return _most(runs, lambda run: run.table, layout, reason)


def same_settings(runs: list[Run]) -> Sifted:
    """Keep the runs of each method whose settings, uses and device are the usual ones."""

    def parts(run: Run) -> list[dict[str, Any]]:
        info = run.record.run
        # a setting that an older record lacks was added later, with a default that changes nothing
        is_built_in = info.method in built_in_methods()
        defaults = _declared(run.table, info.method, tuned=False)[1] if is_built_in else {}
        return [{**defaults, **info.settings}, info.uses, {"device": info.device, **_learner(run)}]

    def reason(run: Run, other: Run) -> str:
        both = zip(parts(run), parts(other), strict=True)
        fields = [name for one, another in both for name in differences(one, another)]
        return f"its settings do not match most seeds: {', '.join(fields)} differ."

    return _most(runs, lambda run: (run.table, run.label), lambda run: _text(parts(run)), reason)


def _learner(run: Run) -> dict[str, Any]:
    """Return what the names of an agent, of a method and of a policy "module:Class" leave open.

    Two agents that share a name make no row together. Neither do seeds between which the code changed; for a
    method with a name of its own, its version tells.
    """
    made, info = run.record.fingerprint, run.record.run
    method = made.get("method")
    known = method if isinstance(method, dict) else {}
    learner: dict[str, Any] = {}
    if run.division == "online":
        learner["class of the agent"] = known.get("class")
    elif ":" in info.method:
        learner["code of the method"] = known.get("source")
    else:
        learner["version of the method"] = known.get("version")
    if ":" in info.policy:
        learner["code of the policy"] = made.get("policy")
    return learner


ALIKE: tuple[Sift, ...] = (same_scenario, same_definition, same_simulator, same_layout, same_settings)
"""What runs must share to be compared."""


def _most(
    runs: list[Run],
    group: Callable[[Run], Hashable],
    trait: Callable[[Run], Hashable],
    reason: Callable[[Run, Run], str],
) -> Sifted:
    """Keep the runs that have the usual trait of their group.

    The usual trait is the one that most runs of built-in methods have and, on a tie, most runs: no number of
    records of other methods can push theirs off the board. Of equally frequent traits the first one counts.
    """
    members: dict[Hashable, dict[Hashable, list[Run]]] = {}
    for run in runs:
        members.setdefault(group(run), {}).setdefault(trait(run), []).append(run)
    usual = {key: max(traits.values(), key=_weight) for key, traits in members.items()}

    def fault(run: Run) -> str:
        alike = usual[group(run)]
        return "" if run in alike else reason(run, alike[0])

    return sift_by(runs, fault)


def _weight(runs: list[Run]) -> tuple[int, int]:
    built_in = [run for run in runs if run.record.run.method in built_in_methods()]
    return len(built_in), len(runs)


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)


def differences(values: Any, others: Any) -> list[str]:
    """Return the names under which two dictionaries differ; empty if they are not dictionaries."""
    if not isinstance(values, dict) or not isinstance(others, dict):
        return []
    names = sorted(set(values) | set(others))
    return [
        name for name in names if name not in values or name not in others or values[name] != others[name]
    ]
