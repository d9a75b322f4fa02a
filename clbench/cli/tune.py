"""The command `clbench tune`."""

from __future__ import annotations

import itertools
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from clbench.base.errors import InputError
from clbench.base.text import counted, print_plain
from clbench.cli.arguments import (
    MethodName,
    PolicyName,
    ScenarioId,
    Seed,
    Seeds,
    add_cwd_to_path,
    check_names,
    checked_input,
    checked_writing,
    chosen_methods,
    items_of,
    whole_number,
)
from clbench.cli.runs import do_runs
from clbench.jobs.folders import check_folders
from clbench.records.paths import TUNING, table_name
from clbench.spec.identifiers import built_in_methods, without_module
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.protocol import FIRST_TUNING_SEED
from clbench.spec.references import BASELINE

if TYPE_CHECKING:
    from clbench.learning.method import Method
    from clbench.runs.spec import ResolvedRun, RunSpec
    from clbench.runs.tuning import Settings, Tried, Tuned


def tune(
    scenario: ScenarioId,
    /,
    *methods: MethodName,
    every: Annotated[bool, Parameter(name="--all")] = False,
    seeds: Seeds = 2,
    first_seed: Seed = FIRST_TUNING_SEED,
    fixed: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
    values: dict[str, str] | None = None,
    targets: Annotated[int | None, whole_number(1)] = None,
    workers: Annotated[int | None, whole_number(1)] = None,
    device: str = "cpu",
    policy: PolicyName = DEFAULT_POLICY,
    records: Path = TUNING,
    write: Path | None = None,
) -> None:
    """Choose the settings of METHODS for SCENARIO on validation episodes, with equal effort for each method.

    Each method first runs with four learning rates. At the best of these, it runs with two values of its own
    strength; a method without a strength runs with two more learning rates instead. Runs learn all targets,
    with seeds that no board uses, and never see test episodes. Of the settings whose success right after the
    stages (`learned`) is at least 0.8, the one with the best final average wins. A setting with a failed
    run, for example because the loss diverged, is not chosen. Runs that have succeeded are skipped: repeat a
    stopped command to continue it. Runs that failed are done again.

    With --values, the methods run with every combination of these values instead, plain fine-tuning runs
    beside them, and nothing is chosen.

    Args:
        scenario: Gymnasium id of the scenario; module:id imports the module first.
        methods: Names of installed methods, or module:Class.
        every: Tune all installed methods except controls, which use the settings of their method.
        seeds: Number of tuning seeds.
        first_seed: The first tuning seed; the boards use seeds from 0.
        fixed: Hyper-parameters that keep one value in all settings, as --set.name value. Meant for values
            that the scenario determines, such as the length of a schedule.
        values: Hyper-parameters and the values to try, as --values.tau_start 0.3,1,3
        targets: Number of targets to learn, from the first, with --values (default: all). The
            records of such runs go to a separate folder, for example targets-1 below --records.
        workers: Number of runs at once, and of the cores that they share (default: all cores; with --device
            cuda, one run per GPU, and all cores).
        device: Device that runs the policies, for example cpu or cuda, which gives each run one of the GPUs.
        policy: flow or discrete_diffusion; a larger size, for example flow-base (5 million parameters) or
            flow-large (40 million); or a class of your own, as module:Class.
        records: Folder of the records.
        write: File for the chosen settings; it keeps the settings of other methods. For built-in methods,
            `clbench run` reads methods/tuned/. Cannot be used with --values.
    """
    check_names([scenario], methods)
    from clbench.learning.registry import load_method
    from clbench.runs.spec import RunSpec, check_device
    from clbench.runs.tuning import CONTROL_OF, check_tuned, rungs

    if targets is not None:  # a run of fewer targets must not replace the record of all
        records = records / f"targets-{targets}"
    numbers = range(first_seed, first_seed + seeds)
    add_cwd_to_path()
    with checked_input():
        first = RunSpec(
            scenario, "", first_seed, device=device, split="validation", targets=targets, policy=policy
        )
        table = table_name(without_module(scenario), policy)
        names = chosen_methods(methods, every)
        _check_together(fixed, values, targets, write, first_seed)
        if not values:  # their runs would choose settings that no run reads
            names = _without_controls(names, CONTROL_OF, every)
        check_device(device)
        check_folders({"--records": records, "--write": write and write.parent})
        classes = {name: load_method(name) for name in names}
        if write is not None:
            check_tuned(write, table, numbers, names)
        combinations = _combinations(values or {})
        ladder = {} if values else {name: rungs(cls, fixed) for name, cls in classes.items()}
    run = partial(_run, first=first, seeds=numbers, workers=workers, records=records)
    if values:
        found = run({BASELINE: [{}], **{name: _besides(name, combinations) for name in names}})
        Console().print(_table(table, {name: (None, one) for name, one in found.items()}, seeds))
        if any(one.final_average is None for tried in found.values() for one in tried):
            sys.exit(1)
        return
    chosen = _choose(classes, ladder, run)
    Console().print(_table(table, {name: (one.settings, one.tried) for name, one in chosen.items()}, seeds))
    for name, one in chosen.items():
        print_plain(Console(), _choice(name, one))
    if write is not None:
        _write(write, table, numbers, chosen)
    if len(chosen) < len(names):
        without = ", ".join(name for name in names if name not in chosen)
        print_plain(Console(stderr=True), f"Failed at every learning rate: {without}.", "bold red")
        sys.exit(1)


def _check_together(
    fixed: Mapping[str, str] | None,
    values: Mapping[str, str] | None,
    targets: int | None,
    write: Path | None,
    first_seed: int,
) -> None:
    """Refuse options of `tune` that contradict each other.

    Raises:
        InputError: Two of them do; the message names both.
    """
    if targets is not None and not values:
        raise InputError("--targets needs --values: without --values, settings are chosen on all targets.")
    if write is not None and values:
        raise InputError("--write cannot be used with --values, which chooses no settings.")
    if write is not None and first_seed < FIRST_TUNING_SEED:
        raise InputError(
            f"--write needs seeds that no board has: --first-seed must be at least {FIRST_TUNING_SEED}, "
            f"not {first_seed}."
        )
    if fixed and values:
        raise InputError("--set cannot be used with --values: give the value as --values.NAME.")


def _write(path: Path, table: str, seeds: Sequence[int], chosen: Mapping[str, Tuned]) -> None:
    """Write the chosen settings, and say how `clbench run` gets them unless it reads this file."""
    from clbench.runs.tuning import tuned_file, write_tuned

    with checked_input(), checked_writing(path):
        write_tuned(path, table, seeds, chosen)
    read = tuned_file(table)
    if path.resolve() == read.resolve():
        return
    how = f"copy {path} there"
    if read.exists():
        how = f"repeat this command with --write {read}, which keeps its other methods"
    told = f"`clbench run` reads {read}: {how}, on every machine that runs or shows these records."
    print_plain(Console(stderr=True), told)


def _choose(
    classes: Mapping[str, type[Method]],
    ladder: Mapping[str, Sequence[Settings]],
    run: Callable[[Mapping[str, Sequence[Settings]]], dict[str, list[Tried]]],
) -> dict[str, Tuned]:
    """Try the learning rates of each method, then its refinements at the best of them.

    Returns:
        The choice for each method, except those that failed at every learning rate.
    """
    from clbench.runs.tuning import Tuned, best_of, refinements

    begun = {
        name: tried
        for name, tried in run(ladder).items()
        if any(one.final_average is not None for one in tried)
    }
    refined = run(
        {name: refinements(classes[name], best_of(tried).settings) for name, tried in begun.items()}
    )
    every = {name: (*tried, *refined[name]) for name, tried in begun.items()}
    return {name: Tuned(best_of(tried).settings, tried) for name, tried in every.items()}


def _besides(name: str, combinations: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return the settings to try of a method; plain fine-tuning is also run unchanged, to compare with."""
    return [{}, *combinations] if name == BASELINE else combinations


def _without_controls(names: list[str], controls: Mapping[str, str], every: bool) -> list[str]:
    """Return the methods that have settings of their own; a control that was named is refused."""
    own = [name for name in names if name not in controls]
    if own != names and not every:
        name = next(name for name in names if name in controls)
        raise InputError(
            f"{name} is a control of {controls[name]} and uses its settings: tune {controls[name]} instead."
        )
    return own


def _combinations(values: Mapping[str, str]) -> list[dict[str, str]]:
    """Return every combination of the values that are separated by commas."""
    lists = [[(name, value) for value in items_of(f"--values.{name}", text)] for name, text in values.items()]
    return [dict(combination) for combination in itertools.product(*lists)]


def _run(
    wanted: Mapping[str, Sequence[Settings]],
    first: RunSpec,
    seeds: Sequence[int],
    workers: int | None,
    records: Path,
) -> dict[str, list[Tried]]:
    """Do the runs of all settings that have no record, and return the scores of each setting."""
    from clbench.jobs.processes import Processes
    from clbench.jobs.recorded import has_failed, has_record

    with checked_input():
        runs = {
            name: _resolved(replace(first, method=name), settings, seeds) for name, settings in wanted.items()
        }
    every = [one for groups in runs.values() for group in groups for one in group]
    succeeded = do_runs(every, records, lambda: Processes(workers, first.device))
    with checked_input():
        if not succeeded and not all(has_failed(one, records) or has_record(one, records) for one in every):
            sys.exit(1)  # the machine failed, not a method: the same command goes on
        return {name: [_tried(group, records) for group in groups] for name, groups in runs.items()}


def _resolved(first: RunSpec, settings: Sequence[Settings], seeds: Sequence[int]) -> list[list[ResolvedRun]]:
    """Return the runs of each setting; what a method holds as one, such as 1 and 1.0, is one setting."""
    groups = [[replace(first, seed=seed, changes=dict(one)).resolve() for seed in seeds] for one in settings]
    return list({group[0].label: group for group in groups}.values())


def _tried(runs: Sequence[ResolvedRun], records: Path) -> Tried:
    """Return the scores of one setting, averaged over its runs."""
    from clbench.records.reader import read_record
    from clbench.runs.tuning import Tried
    from clbench.scoring.metrics import measure
    from clbench.scoring.scores import Scores

    found = [read_record(run.path(records)) for run in runs]
    if any(record.status == "failed" for record in found):
        return Tried(dict(runs[0].changes), None, None)
    scores = [Scores.from_record(record) for record in found]

    def mean(metric: str) -> float:
        values = [measure(metric, one) for one in scores]
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            raise InputError(f"{metric} has no value on {runs[0].scenario.id}: it cannot rank settings.")
        return round(sum(known) / len(known), 4)

    return Tried(dict(runs[0].changes), mean("final_average"), mean("adaptation"))


def _table(name: str, found: Mapping[str, tuple[Settings | None, Sequence[Tried]]], seeds: int) -> Table:
    """Return all settings with their scores, the chosen ones in bold.

    Args:
        name: Name of the table that the runs belong to.
        found: For each method the settings that were chosen, None if none were, and all that were tried.
        seeds: Number of tuning seeds.
    """
    table = Table(title=f"{name}, {counted(seeds, 'tuning seed')}, validation episodes")
    for title in ("method", "settings"):
        table.add_column(title, overflow="fold")
    for title in ("learned", "final average"):
        table.add_column(title, justify="right")
    for method, (chosen, every) in found.items():
        table.add_section()
        for tried in every:
            style = "bold" if tried.settings == chosen else ""
            scores = (tried.learned, ".2f"), (tried.final_average, ".3f")
            values = ["failed" if score is None else format(score, form) for score, form in scores]
            table.add_row(method, _words(tried.settings), *values, style=style)
    return table


def _choice(method: str, tuned: Tuned) -> str:
    """Return in words which settings are chosen, as a file shows no bold, and whether they learn enough.

    The settings of built-in methods belong in the file that `clbench run` reads.
    """
    from clbench.runs.tuning import LEARNED

    text = f"{method}: {_words(tuned.settings)} is chosen."
    if tuned.settings and method not in built_in_methods():
        options = " ".join(
            f"--set.{name} {shlex.quote(str(value))}" for name, value in tuned.settings.items()
        )
        text += f" Make these values the defaults of the class, or run it with {options}."
    if any(one.learns_enough for one in tuned.tried):
        return text
    return (
        f"{text} No setting has learned {LEARNED}, so this is the first that learns most: give the budget "
        "of the scenario more adaptation_steps or another learning_rate, and tune again."
    )


def _words(settings: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={value}" for name, value in settings.items()) or "unchanged"
