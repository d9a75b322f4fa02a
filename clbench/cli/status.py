"""The command `clbench status`: how far the runs of a folder are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from clbench.base.errors import InputError
from clbench.base.lease import Lease, Owner, Report, lease_path
from clbench.base.text import clock_time, counted, listed, print_plain, printable, shortened
from clbench.cli.arguments import (
    AsJson,
    MethodName,
    PolicyName,
    ScenarioId,
    Seed,
    Seeds,
    add_cwd_to_path,
    checked_input,
    items_of,
    print_json,
)
from clbench.cli.runs import requested
from clbench.records.paths import RECORDS
from clbench.records.reader import RecordError, UnreadableRecordError, check_home, read_record
from clbench.spec.identifiers import check_known, folder_name, without_module
from clbench.spec.protocol import DEFAULT_SEEDS

if TYPE_CHECKING:
    from clbench.runs.spec import ResolvedRun

State = Literal["done", "running", "failed", "damaged", "unreadable", "to do"]

STATES: tuple[State, ...] = get_args(State)

OTHER_SETTINGS = "its record has different settings, budget, device or code: `clbench run` repeats the run"
"""Reason of a run that is to do although its place has a record."""


class RunState(NamedTuple):
    """The state of one run."""

    path: Path
    """Path of its record."""
    state: State
    """A run is damaged if its record is torn or contradicts itself; `clbench run` does it again. It is
    unreadable if `clbench run` refuses its record, which may be sound: it is of a newer clbench or of another
    definition of its scenario, or the file system refuses it."""
    owner: Owner | None = None
    """Process that does the run."""
    progress: Report | None = None
    """How far that process is, None if it has not told yet."""
    seconds: float | None = None
    """Seconds that a run with a record took."""
    reason: str | None = None
    """Why a run failed, or why its record cannot be read."""

    @property
    def seconds_left(self) -> float | None:
        """Seconds that a running run needs, None if they are unknown."""
        if self.progress is None or not 0 < self.progress.share <= 1:
            return None
        return self.progress.seconds * (1 / self.progress.share - 1)


def status(
    scenarios: ScenarioId | None = None,
    /,
    *methods: MethodName,
    every: Annotated[bool, Parameter(name="--all")] = False,
    seeds: Seeds | None = None,
    first_seed: Seed | None = None,
    order: Seed | None = None,
    policy: PolicyName | None = None,
    perturb: bool = False,
    records: Path = RECORDS,
    device: str | None = None,
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
    as_json: AsJson = False,
) -> None:
    """Show which runs are done, running, failed or still to do, and how much time is left.

    Without arguments the command shows every run in the folder of records; with SCENARIOS alone, every run of
    these scenarios. With the arguments of `clbench run` it shows those runs, including runs that no command
    has started. You can use it while other commands or machines work in the same folder.

    Args:
        scenarios: Gymnasium id of the scenario, or several ids separated by commas.
        methods: Names of installed methods, or module:Class.
        every: All installed methods.
        seeds: Number of seeds (default: 4).
        first_seed: The first seed (default: 0).
        order: Order of the targets, as for `clbench run`.
        policy: flow (default) or discrete_diffusion; a larger size, for example flow-base (5 million
            parameters) or flow-large (40 million); or a class of your own, as module:Class.
        perturb: Count only records with perturbed episodes.
        records: Folder of the records.
        device: Device that runs the policies (default: cpu): a record of another device does not count.
        changes: Hyper-parameters that differ from those tuned for the scenario or, without tuning, from the
            method's defaults, as --set.name value.
        as_json: Print a JSON list with an object for each run, and no table.
    """
    add_cwd_to_path()
    with checked_input():
        ids = [] if scenarios is None else items_of("SCENARIOS", scenarios)
        options = {"--seeds": seeds, "--first-seed": first_seed, "--order": order, "--policy": policy}
        options |= {"--all": every or None, "--perturb": perturb or None, "--device": device}
        given = [name for name, value in options.items() if value is not None]
        given += [f"--set.{name}" for name in changes or {}]
        if given and not ids:
            chosen = f"{listed(given)} {'needs' if len(given) == 1 else 'need'}"
            raise InputError(f"{chosen} a scenario: name the scenario first.")
        check_known(ids, methods)
        if methods or given:
            from clbench.runs.spec import RunSpec

            first = RunSpec("", "", first_seed or 0, changes or {}, order=order or 0, perturb=perturb)
            first = first if device is None else replace(first, device=device)
            first = first if policy is None else replace(first, policy=policy)
            runs = requested(ids, methods, every, seeds or DEFAULT_SEEDS, first, records)
            states = [run_state(run.path(records), run) for run in runs]
        else:
            states = [run_state(path) for path in found_runs(records, ids)]
            if not states:
                named = f" of {listed(ids)}" if ids else ""
                raise InputError(f"There are no runs{named} in {records}: `clbench run` makes them.")
    if as_json:
        print_json([_values(state, records) for state in states])
        return
    console = Console()
    console.print(_table(states))
    for state in states:
        line = _line(state, records)
        if line:
            print_plain(console, line)
    console.print(_summary(states), highlight=False)


def run_state(path: Path, run: ResolvedRun | None = None) -> RunState:
    """Return the state of the run whose record has the path.

    Args:
        path: Path of the record.
        run: The run that was asked for: a record of other settings is not its record. If None, any record is.
    """
    from clbench.jobs.recorded import is_of
    from clbench.scoring.scores import Scores

    lease = Lease(path)
    owner = lease.owner
    if owner is not None:
        return RunState(path, "running", owner, lease.progress)
    if not path.exists():
        return RunState(path, "to do")
    try:
        record = read_record(path)
        check_home(record.run, path)
        if record.error is None:
            Scores.from_record(record)
        if run is not None and not is_of(record, run, path):
            return RunState(path, "to do", reason=OTHER_SETTINGS)
    except (UnreadableRecordError, InputError) as error:
        return RunState(path, "unreadable", reason=str(error))
    except RecordError as error:
        return RunState(path, "damaged", reason=str(error))
    seconds = record.timing.get("seconds")
    if seconds is not None and not isinstance(seconds, int | float):
        return RunState(path, "damaged", reason=f"timing: seconds must be a number, not {seconds!r}")
    if record.error is not None:
        return RunState(path, "failed", seconds=seconds, reason=record.failure)
    return RunState(path, "done", seconds=seconds)


def found_runs(records: Path, scenarios: Iterable[str] = ()) -> list[Path]:
    """Return the paths of the records below a folder, and of those that are being made.

    Args:
        records: Folder of the records.
        scenarios: Ids of the scenarios whose runs are returned; if there are none, all runs are.
    """
    made = set(records.glob("*/*/seed-*.json"))
    running = {
        path.with_name(path.name.removeprefix(".").removesuffix(".lease"))
        for path in records.glob(f"*/*/{lease_path(Path('seed-*.json')).name}")
    }
    names = {folder_name(without_module(scenario)) for scenario in scenarios}
    # the runs of another policy are in a folder with its name after a +
    return sorted(path for path in made | running if not names or path.parts[-3].partition("+")[0] in names)


def seconds_left(states: Iterable[RunState]) -> float | None:
    """Return the seconds until all runs are done by the processes that are at work, None if unknown.

    A run that is to do takes the mean of the runs that are done.
    """
    states = list(states)
    running = [state for state in states if state.state == "running"]
    known = [state.seconds for state in states if state.state == "done" and state.seconds is not None]
    open_runs = sum(state.state in ("to do", "damaged") for state in states)
    left = [state.seconds_left for state in running]
    if not running or (open_runs and not known) or None in left:
        return None
    mean = sum(known) / len(known) if known else 0.0
    return (sum(value for value in left if value is not None) + open_runs * mean) / len(running)


def _table(states: Sequence[RunState]) -> Table:
    """Return the number of runs in each state, by scenario and method."""
    shown = [name for name in STATES if any(state.state == name for state in states)]
    table = Table()
    for name in ("scenario", "method"):
        table.add_column(name, overflow="fold")
    for name in shown:
        table.add_column(name, justify="right", no_wrap=True)
    for folder in dict.fromkeys(state.path.parent for state in states):
        counts = Counter(state.state for state in states if state.path.parent == folder)
        names = (escape(printable(folder.parent.name)), escape(printable(folder.name)))
        table.add_row(*names, *(str(counts[name] or "") for name in shown))
    return table


def _line(state: RunState, records: Path) -> str | None:
    """Return a line about a run that is running or that went wrong."""
    name = printable(state.path.relative_to(records).with_suffix("").as_posix())
    if state.owner is not None:
        if state.progress is None:
            return f"{name}: started by {state.owner}"
        left = state.seconds_left
        rest = "" if left is None else f", about {clock_time(left)} left"
        spent = clock_time(state.progress.seconds)
        return f"{name}: {state.progress.share:.0%} after {spent}{rest}, {state.owner}"
    if state.reason is not None:
        path = str(state.path)  # a folder may have a line break in its name
        text = state.reason.replace(path, printable(path)).partition("\n")[0]
        reason = shortened(text, f"{name}.json")
        return f"{name}: {state.state}, {printable(reason)}"
    return None


def _summary(states: Sequence[RunState]) -> str:
    counts = Counter(state.state for state in states)
    parts = [f"{counts[name]} {name}" for name in STATES if counts[name]]
    text = f"{counted(len(states), 'run')}: {', '.join(parts)}."
    left = seconds_left(states)
    if left is None:
        return text
    return f"{text} About {clock_time(left)} left with {counted(counts['running'], 'run')} at once."


def _values(state: RunState, records: Path) -> dict[str, Any]:
    """Return a run's state as JSON."""
    return {
        "run": state.path.relative_to(records).with_suffix("").as_posix(),
        "state": state.state,
        "process": None if state.owner is None else state.owner.process or None,
        "host": None if state.owner is None else state.owner.host or None,
        "share": None if state.progress is None else round(state.progress.share, 3),
        "seconds": state.seconds if state.progress is None else round(state.progress.seconds, 1),
        "seconds_left": None if state.seconds_left is None else round(state.seconds_left, 1),
        "reason": state.reason,
    }
