"""Runs of methods on scenarios for several seeds: find out which runs are missing, and do them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console

from clbench.base.cache import cache_folder, minari_folder
from clbench.base.errors import ClbenchError, InputError, WrongTypeError
from clbench.base.leftovers import sweep
from clbench.base.text import counted, print_plain, printable
from clbench.jobs.bars import lines_console
from clbench.jobs.folders import check_folders
from clbench.jobs.job import Job, Workers
from clbench.jobs.processes import Here, Processes
from clbench.jobs.recorded import has_record, is_of_other_code, set_aside
from clbench.jobs.scheduler import run_with_bars
from clbench.records.paths import RECORDS
from clbench.records.reader import read_record
from clbench.runs.spec import ResolvedRun, RunSpec, check_device
from clbench.spec.fields import whole_number
from clbench.spec.identifiers import check_known, installed_methods
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.protocol import DEFAULT_SEEDS, MOST_SEEDS
from clbench.spec.registry import importable

if TYPE_CHECKING:
    from clbench.jobs.plan import Plan
    from clbench.learning.method import Method
    from clbench.records.record import Record

# PyTorch is imported where it is needed, so that wrong names and values do not wait for it.


class RunsFailedError(ClbenchError, RuntimeError):
    """Runs failed, each for the reason that the message gives."""


class Missing(NamedTuple):
    """What is still missing from a grid."""

    runs: list[ResolvedRun]
    """Runs without a record."""
    stages: list[ResolvedRun]
    """Runs with a record whose policies should be kept but are not."""

    def plan(
        self,
        records: Path,
        checkpoints: Path | None,
        tensorboard: Path | None = None,
        check: Job | None = None,
    ) -> Plan:
        """Return the plan of the jobs; the runs wait for `check`, and have its limits."""
        from clbench.jobs.plan import Plan

        plan, limits = Plan(check), check.limits if check else None
        for one in self.runs:
            plan.add_run(one, records, limits, checkpoints=checkpoints, tensorboard=tensorboard)
        for one in self.stages:
            plan.add_stages(one, checkpoints, limits)
        return plan


def missing(runs: Sequence[ResolvedRun], records: Path, checkpoints: Path | None) -> Missing:
    """Return what is left to do until all runs have a record and, with `checkpoints`, kept policies."""
    from clbench.runs.stages import has_stages

    without, stages = [], []
    for run in runs:
        if not has_record(run, records):
            without.append(run)
        elif checkpoints and not has_stages(run, checkpoints):
            stages.append(run)
    return Missing(without, stages)


def run_missing(
    runs: Sequence[ResolvedRun],
    records: Path,
    workers: Callable[[], Workers],
    console: Console,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
    check: Job | None = None,
) -> dict[Job, str]:
    """Do the runs that have no record yet, and return the reason for each failure by job.

    Args:
        runs: The runs.
        records: Folder of the records.
        workers: Returns the workers, once there is something to do.
        console: Console that shows the progress.
        checkpoints: Folder below which the policies of all stages are kept; None keeps none.
        tensorboard: Folder below which the runs are logged; None logs nothing.
        check: Job that must succeed before anything else is done; its limits hold for the runs, too.

    Raises:
        InputError: A record was made with another definition of its scenario, or this machine cannot render
            what a scenario needs.
    """
    from clbench.jobs.work import do_run

    sweep(records, cache_folder(), minari_folder() / "clbench", *([checkpoints] if checkpoints else []))
    to_do = missing(runs, records, checkpoints)
    there = len(runs) - len(to_do.runs)
    if there:
        console.print(
            f"{there} of {counted(len(runs), 'run')} already {'has' if there == 1 else 'have'} a record."
        )
    if not any(to_do):
        return {}
    begin = time.monotonic()
    plan = to_do.plan(records, checkpoints, tensorboard, check)  # refuses a camera where nothing can render
    pool = workers()  # refuses a cluster that does not answer
    for one in to_do.runs:
        fault = set_aside(one, records)
        if fault is not None:
            _print(console, fault)
    failed = run_with_bars(plan.jobs, pool, console)
    if check in failed:
        return failed
    minutes = (time.monotonic() - begin) / 60
    run_jobs = [job for job in plan.jobs if job.function is do_run]
    for job, reason in _without_record(run_jobs, to_do.runs, failed, records).items():
        _print(console, f"{job}: {reason}")
        failed[job] = reason
    _print(console, f"{_done(to_do, failed)} in {minutes:.1f} minutes; records in {records}.")
    if checkpoints:
        bare = missing(to_do.runs, records, checkpoints).stages
        failed |= _without_policies(run_jobs, bare, records, checkpoints, console)
    return failed


def _done(to_do: Missing, failed: Iterable[Job]) -> str:
    """Return in words how many of the runs, and of the policies to make again, are done."""
    from clbench.jobs.work import do_run, make_policies

    lost = Counter(job.function for job in failed)
    done = f"{_part(lost[do_run], len(to_do.runs))}{counted(len(to_do.runs), 'run')}"
    if not to_do.stages:
        return done
    return f"{done} and the policies of {_part(lost[make_policies], len(to_do.stages))}{len(to_do.stages)}"


def _without_policies(
    jobs: Sequence[Job], bare: Sequence[ResolvedRun], records: Path, checkpoints: Path, console: Console
) -> dict[Job, str]:
    """Return the jobs whose runs another command did without keeping policies, each with this reason."""
    if not bare:
        return {}
    kept = f"but kept no policies in {checkpoints}. Repeat the command to make and keep these policies."
    _print(console, f"Another command did {counted(len(bare), 'run')} {kept}")
    theirs = {run.path(records.absolute()) for run in bare}
    return {job: f"another command did this run {kept}" for job in jobs if _path(job) in theirs}


def _path(job: Job) -> Path | None:
    return None if job.product is None else job.product.path


def _part(lost: int, count: int) -> str:
    """Return "3 of " if one of 4 is lost, and nothing if none is."""
    return f"{count - lost} of " if lost else ""


def _without_record(
    jobs: Sequence[Job], runs: Iterable[ResolvedRun], failed: Mapping[Job, str], records: Path
) -> dict[Job, str]:
    """Return the jobs that reported success but left no record that counts, each with the reason."""
    lost, by_path = {}, {run.path(records.absolute()): run for run in runs}
    for job in jobs:
        if job.product is None or job in failed or job.product.exists():
            continue
        path = records / job.product.path.relative_to(records.absolute())
        run = by_path[job.product.path]
        lost[job] = (
            f"{path} has other code or settings of {run.spec.method} than this command began with: its "
            "module was edited meanwhile. Repeat the command; in a notebook, restart the kernel first."
            if is_of_other_code(run, path)
            else f"it ended without a record of this run at {path}."
        )
    return lost


def _print(console: Console, line: str) -> None:
    """Print one line without markup, wrapping or characters that control the terminal."""
    print_plain(console, printable(line))


def run(
    scenario: str,
    method: str | type[Method],
    *,
    seeds: int = DEFAULT_SEEDS,
    first_seed: int = 0,
    settings: Mapping[str, Any] | None = None,
    policy: str = DEFAULT_POLICY,
    perturb: bool = False,
    records: Path | str = RECORDS,
    workers: int | None = None,
    device: str = "cpu",
) -> list[Record]:
    """Run a method on a scenario, once per seed, and return the records by seed.

    Missing inputs are made first, as `clbench run` does. A run that has a record in the folder is not done
    again, unless the code of a method of your own has changed: the old record is then set aside. Progress is
    shown on standard error; in notebooks, below the cell.

    Other processes cannot import a class from a notebook, or from the script itself: its runs are done in
    this process, one after the other. Put the class into a module to use all cores.

    Args:
        scenario: Gymnasium id of the scenario; "module:id" imports the module first.
        method: Class of the method, its installed name, or "module:Class".
        seeds: Number of seeds.
        first_seed: The first seed. No board shows seeds from 100 on, which are for tuning.
        settings: Hyper-parameters that differ from the method's own, or from those tuned for the scenario.
        policy: Name of the policy, such as "discrete_diffusion", "flow-base" or "module:Class".
        perturb: Whether the skills and each new target are also evaluated in perturbed worlds.
        records: Folder of the records.
        workers: Number of runs at once, and of the cores that they share; if None all cores, and with the
            device "cuda" one run per GPU.
        device: Device that runs the policies, for example "cpu" or "cuda".

    Raises:
        UnknownNameError: There is no such scenario, method or hyper-parameter.
        InputError: A value cannot be used; the message says which.
        RunsFailedError: A run failed.
    """
    spec = RunSpec(
        scenario, name_of(method), first_seed, settings or {}, device, perturb=perturb, policy=policy
    )
    return run_specs([spec], seeds, Path(records), workers)


def run_specs(firsts: Sequence[RunSpec], seeds: int, records: Path, workers: int | None) -> list[Record]:
    """Do the runs in `firsts`, each for `seeds` seeds from its own seed on, and return their records.

    All runs are on one device. If what the runs of a class of this script need cannot be made, nothing runs.

    Raises:
        UnknownNameError: There is no such scenario, method or hyper-parameter.
        InputError: A value cannot be used; the message says which. Or other processes cannot import the
            scenario or the policy.
        RunsFailedError: A run failed.
    """
    whole_number("seeds", seeds, 1)
    if seeds > MOST_SEEDS:
        raise InputError(f"seeds must be at most {MOST_SEEDS:,}, not {seeds}.")
    if workers is not None:
        whole_number("workers", workers, 1)
    check_known([one.scenario for one in firsts], [one.method for one in firsts])
    firsts = [replace(one, scenario=importable(one.scenario)) for one in firsts]
    if any(one.policy.startswith("__main__:") for one in firsts):
        raise InputError("A policy must be in a module: other processes cannot import a class of a notebook.")
    device, records = firsts[0].device, records.absolute()  # a method of this script may change the folder
    check_device(device)
    specs = [replace(one, seed=one.seed + number) for one in firsts for number in range(seeds)]
    runs = [spec.resolve() for spec in specs]
    console = lines_console()
    to_do = missing(runs, records, None).runs
    if to_do:
        check_folders({"records": records})
    # other processes cannot import the class, but can make what its runs need
    needed = Missing([run for run in to_do if _is_of_main(run)], []).plan(records, None).inputs
    _check_all_done(run_with_bars(needed, Processes(workers), console) if needed else {})
    here, others = [run for run in runs if _is_of_main(run)], [run for run in runs if not _is_of_main(run)]
    failed = run_missing(others, records, lambda: Processes(workers, device), console) if others else {}
    failed |= run_missing(here, records, lambda: Here(workers), console) if here else {}
    _check_all_done(failed)
    return [read_record(run.path(records)) for run in runs]


def _check_all_done(failed: Mapping[Job, str]) -> None:
    """Raise an error with the reason for each failure, if there is one."""
    if failed:
        raise RunsFailedError("\n".join(f"{job}: {reason}" for job, reason in failed.items()))


def _is_of_main(run: ResolvedRun) -> bool:
    """Return whether the method of a run is a class of this notebook or script."""
    return run.spec.method.startswith("__main__:")


def name_of(method: str | type[Method]) -> str:
    """Return the name of a method: the installed one, or "module:Class".

    Raises:
        WrongTypeError: The method is not a class, or it is a class inside a function or another class, where
            no name can reach it.
    """
    if isinstance(method, str):
        return method
    if not isinstance(method, type):
        raise WrongTypeError(f"A method must be a class or the name of a method, not {method!r}.")
    place = f"{method.__module__}:{method.__qualname__}"
    if not method.__qualname__.isidentifier():
        raise WrongTypeError(
            f"{method.__qualname__} cannot be imported by its name: define the class at the top of a module."
        )
    return next((name for name, entry in installed_methods().items() if entry.value == place), place)
