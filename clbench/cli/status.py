"""The command `clbench status`: how far the runs of a folder are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from clbench.base.errors import InputError
from clbench.base.text import clock_time, counted, listed, print_plain, printable, shortened
from clbench.cli.arguments import (
    AsJson,
    MethodName,
    PolicyName,
    PolicySize,
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
from clbench.records.status import RunState, State, found_runs, run_state, seconds_left
from clbench.spec.identifiers import check_known
from clbench.spec.policies import DEFAULT_POLICY, SMALL, policy_name
from clbench.spec.protocol import DEFAULT_SEEDS

if TYPE_CHECKING:
    from clbench.records.record import Record
    from clbench.runs.spec import ResolvedRun

NOT_GIVEN: Mapping[str, object] = {
    "--all": False,
    "--seeds": DEFAULT_SEEDS,
    "--first-seed": 0,
    "--order": 0,
    "--policy": DEFAULT_POLICY,
    "--policy-size": SMALL,
}
"""Values of the options that choose among the runs of a scenario, where nobody gave them."""

STATES: tuple[State, ...] = ("done", "running", "failed", "damaged", "unreadable", "to do")


def status(
    scenarios: ScenarioId | None = None,
    /,
    *methods: MethodName,
    every: Annotated[bool, Parameter(name="--all", negative="")] = False,
    seeds: Seeds = DEFAULT_SEEDS,
    first_seed: Seed = 0,
    order: Seed = 0,
    policy: PolicyName = DEFAULT_POLICY,
    policy_size: PolicySize = SMALL,
    records: Path = RECORDS,
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
    as_json: AsJson = False,
) -> None:
    """Show which runs are done, running, failed and to do, and the time left.

    Without arguments the command shows every run in the folder of records. With the arguments of
    `clbench run` it shows those runs, including runs that no command has started. You can use it while other
    commands or machines work in the same folder.

    Args:
        scenarios: Gymnasium id of the scenario, or several ids separated by commas.
        methods: Names of installed methods, or module:Class.
        every: All installed methods.
        seeds: Number of seeds.
        first_seed: The first seed.
        order: Order of the targets, as for `clbench run`.
        policy: flow, discrete_diffusion, or a class of your own as module:Class.
        policy_size: small, base or large.
        records: Folder of the records.
        changes: Hyper-parameters that differ from those tuned for the scenario or, without tuning, from the
            method's defaults, as --set.name value.
        as_json: Print a JSON list with an object for each run, and no table.
    """
    from clbench.scoring.scores import Scores

    add_cwd_to_path()
    with checked_input():
        if scenarios is None:
            values = (every, seeds, first_seed, order, policy, policy_size)
            options = zip(NOT_GIVEN, values, strict=True)
            given = [name for name, value in options if value != NOT_GIVEN[name]]
            given += [f"--set.{name}" for name in changes or {}]
            if given:
                chosen = f"{listed(given)} {'chooses' if len(given) == 1 else 'choose'}"
                raise InputError(f"{chosen} among the runs of a scenario: name the scenario first.")
            paths = found_runs(records)
            if not paths:
                raise InputError(f"There are no runs in {records}: `clbench run` makes them.")
            states = [run_state(path, Scores.from_record) for path in paths]
        else:
            check_known(items_of("SCENARIOS", scenarios), methods)
            from clbench.runs.spec import RunSpec

            name = policy_name(policy, policy_size)
            spec = RunSpec("", "", first_seed, changes or {}, order=order, policy=name)
            runs = requested(scenarios, methods, every, seeds, spec, records)
            states = [_state_of(run, records) for run in runs]
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


def _state_of(run: ResolvedRun, records: Path) -> RunState:
    """Return the state of a run that was asked for: a record of other settings is not its record."""
    from clbench.jobs.recorded import changed_code, has_settings_of
    from clbench.scoring.scores import Scores

    def is_wanted(record: Record) -> bool:
        here = replace(record.run, device=run.info.device)  # the device is not asked for
        return has_settings_of(replace(record, run=here), run) and not changed_code(record, run)

    return run_state(run.path(records), Scores.from_record, is_wanted)


def _table(states: Sequence[RunState]) -> Table:
    """Return the number of runs in each state, by scenario and method."""
    shown = [name for name in STATES if any(state.state == name for state in states)]
    table = Table()
    table.add_column("scenario", no_wrap=True)
    table.add_column("method", overflow="fold")
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
            return f"{name}: begun by {state.owner}"
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
    return text if left is None else f"{text} About {clock_time(left)} left with {counts['running']} at once."


def _values(state: RunState, records: Path) -> dict[str, Any]:
    """Return a run's state as JSON."""
    return {
        "run": state.path.relative_to(records).with_suffix("").as_posix(),
        "state": state.state,
        "process": None if state.owner is None else state.owner.process,
        "host": None if state.owner is None else state.owner.host,
        "share": None if state.progress is None else round(state.progress.share, 3),
        "seconds": state.seconds if state.progress is None else round(state.progress.seconds, 1),
        "seconds_left": None if state.seconds_left is None else round(state.seconds_left, 1),
        "reason": state.reason,
    }
