"""The commands `clbench run` and `clbench score`, which leave records."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from clbench.base.dependencies import require
from clbench.base.errors import InputError
from clbench.base.text import counted, print_plain, printable_lines
from clbench.cli.arguments import (
    MethodName,
    PolicyName,
    ScenarioId,
    Seed,
    Seeds,
    add_cwd_to_path,
    check_names,
    checked_input,
    chosen_methods,
    chosen_pictures,
    items_of,
    whole_number,
)
from clbench.jobs.folders import check_folders
from clbench.records.paths import RECORDS, record_path
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.protocol import DEFAULT_SEEDS, FIRST_TUNING_SEED

if TYPE_CHECKING:
    from clbench.jobs.job import Workers
    from clbench.records.record import Record
    from clbench.runs.spec import ResolvedRun, RunSpec

# Modules with PyTorch or SciPy are imported where they are needed: `--help` does not wait for them.


def run(
    scenarios: ScenarioId,
    /,
    *methods: MethodName,
    every: Annotated[bool, Parameter(name="--all")] = False,
    seeds: Seeds = DEFAULT_SEEDS,
    first_seed: Seed = 0,
    order: Seed = 0,
    policy: PolicyName = DEFAULT_POLICY,
    perturb: bool = False,
    workers: Annotated[int | None, whole_number(1)] = None,
    shard: str = "1/1",
    ray: str | None = None,
    records: Path = RECORDS,
    device: str = "cpu",
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
    dry_run: bool = False,
    quiet: Annotated[bool, Parameter(name=("--quiet", "-q"))] = False,
) -> None:
    """Run METHODS on SCENARIOS, once per seed, and write a record of each run.

    The command first makes missing inputs: demonstrations, then a pretrained policy for each seed. It skips
    runs that have succeeded: repeat a stopped command to continue it. Runs that failed are done again.

    Args:
        scenarios: Gymnasium id of the scenario, for example clbench/Fetch-v1, or several ids separated by
            commas; module:id imports the module first.
        methods: Names of installed methods, or module:Class; at least one, or --all.
        every: Run all installed methods.
        seeds: Number of seeds.
        first_seed: The first seed. No board shows seeds from 100 on, which are for tuning.
        order: Order of the targets, for scenarios with one published order: 0 is that order, other numbers
            are permutations. The leaderboard uses them to report how much scores depend on the order.
            Scenarios with a separate order for each seed, such as Fetch-v1, accept only 0.
        policy: flow or discrete_diffusion; a larger size, for example flow-base (5 million parameters) or
            flow-large (40 million); or a class of your own, as module:Class. Each policy has separate rows.
        perturb: Also evaluate the skills and each new target in perturbed worlds: other start poses, heavier
            or lighter objects and, in pictures, another camera and light. Such a record replaces a record
            without perturbed episodes, as it holds the same episodes and more.
        workers: Number of runs at once, and of the cores that they share (default: all cores; with --device
            cuda, one run per GPU, and all cores).
        shard: Do only part i of n of the runs, for example 2/8: for array jobs with one folder of records.
        ray: Do the runs on a Ray cluster: its address, auto for a cluster on this machine, or local to start
            one.
        records: Folder of the records.
        device: Device that runs the policies, for example cpu or cuda, which gives each run one of the GPUs.
        changes: Hyper-parameters to change, as --set.name value. All others keep the values tuned for the
            scenario or, without tuning, the method's defaults. Such a run gets a separate record, which the
            leaderboard does not show.
        checkpoints: Save the policies of all stages below this folder. If a run already has a record, its
            policies are trained again.
        tensorboard: Log the runs for TensorBoard below this folder while they run.
        dry_run: Only show what the command would do, with the expected time and disk space.
        quiet: Print nothing but failures.
    """
    with checked_input():
        ids = items_of("SCENARIOS", scenarios)
    check_names(ids, methods)
    from clbench.jobs.processes import at_once
    from clbench.jobs.recorded import has_record
    from clbench.runs.spec import RunSpec, check_device
    from clbench.runs.tensorboard import require_tensorboard
    from clbench.scoring.expected_precision import expected_precision

    add_cwd_to_path()
    with checked_input():
        if ray is None:  # a cluster's workers may have a GPU that this machine lacks
            check_device(device)
        if tensorboard:
            require_tensorboard()
        spec = RunSpec("", "", first_seed, changes or {}, device, order=order, perturb=perturb, policy=policy)
        runs = requested(ids, methods, every, seeds, spec, records)
        chosen = _part(shard, runs)
        check_folders({"--records": records, "--checkpoints": checkpoints, "--tensorboard": tensorboard})
    console = Console(stderr=True, quiet=quiet)
    if not chosen:
        console.print(f"Part {shard} has no runs: there are only {len(runs)}.", highlight=False)
        return
    for scenario in {run.spec.scenario: run.scenario for run in runs}.values():
        console.print(expected_precision(scenario, seeds), highlight=False)
    if dry_run:
        # nothing asks a cluster for its cores before there is work for it
        _print_forecast(chosen, records, workers or (1 if ray else at_once(device)), checkpoints)
        return
    pool = partial(_workers, workers, ray, device)
    went_well = do_runs(chosen, records, pool, checkpoints, tensorboard, quiet)
    # the board shows no run with changed settings or a seed for tuning, and none that failed
    shown = [] if changes else [run for run in chosen if run.spec.seed < FIRST_TUNING_SEED]
    with checked_input():
        if shown and (went_well or any(has_record(run, records) for run in shown)):
            print_plain(console, _next(records))
    if not went_well:
        sys.exit(1)


def score(
    scenario: ScenarioId,
    /,
    *,
    policy: str,
    stage: Annotated[int, whole_number(0)],
    method: str,
    seed: Seed = 0,
    executed: Annotated[int | None, whole_number(1)] = None,
    data: str | None = None,
    steps: Annotated[int | None, whole_number(0)] = None,
    pictures: str | None = None,
    picture_size: Annotated[int | None, whole_number(1)] = None,
    timeout: Annotated[int, whole_number(1)] = 300,
    restart: bool = False,
    records: Path = RECORDS,
) -> None:
    """Score a served policy on SCENARIO, after each stage of its fine-tuning in another program.

    Score each stage once and in order: 0 before the first target, k after fine-tuning on target k. The
    command skips finished stages. The last stage writes the record. If the server is not up yet, the command
    waits up to 10 minutes.

    Args:
        scenario: Gymnasium id of the scenario.
        policy: Address of the server, ws://host:port. docs/guide/external.md shows how to serve a policy.
        stage: Stage after which the policy is evaluated.
        method: Name of the row on the leaderboard, for example me/lora.
        seed: Seed of the run. It chooses the initial states, the same for all methods. From 100 on, the
            command plays validation episodes, on which you may choose settings.
        executed: Actions of each chunk that are executed before the policy acts again (default: all). The
            number is the same in all stages.
        data: What the policy was trained on in this stage, in words. The record keeps it.
        steps: Optimiser steps of the stage. The record keeps them.
        pictures: Cameras of the simulator whose pictures the policy gets, separated by commas, for example
            agentview,robot0_eye_in_hand. They are the same in all stages.
        picture_size: Height and width of these pictures in pixels (default: 224).
        timeout: Time limit of a reply in seconds; the first reply may include compilation.
        restart: Score a finished stage again. This drops the stage and all later ones, but never a finished
            record.
        records: Folder of the records.
    """
    check_names([scenario], [])
    with checked_input():
        require("websockets", "serve", "Scoring a served policy")
        require("msgpack", "serve", "Scoring a served policy")
    from clbench.jobs.bars import Bars
    from clbench.runs.agents import UNFINISHED
    from clbench.serving.client import ServedPolicy
    from clbench.serving.score import described, is_scored
    from clbench.serving.score import score as evaluate

    add_cwd_to_path()
    console, piece = Console(stderr=True), f"stage {stage}"
    options: dict[str, Any] = {
        "stage": stage,
        "method": method,
        "seed": seed,
        "executed": executed,
        "data": data,
        "steps": steps,
        **chosen_pictures(pictures, picture_size),
        "restart": restart,
        "records": records,
    }
    with checked_input():
        check_folders({"--records": records})
        if is_scored(scenario, **options):
            print_plain(console, f"Stage {stage} of {method}, seed {seed}, is done.")
            return
        with closing(ServedPolicy(policy, timeout)) as served, Bars(1.0, console) as bars:
            bars.start(piece, 1.0)
            record = evaluate(scenario, served, **options, progress=lambda share: bars.advance(piece, share))
            server = record.diagnostics[str(stage)].get("server")
            bars.finish(piece, _rates(record) + (f" (server: {described(server)})" if server else ""))
    targets, path = record.scenario.target, record_path(records, record.run.scenario, method, seed)
    if stage < len(targets):
        then = (
            f"Stages so far: {path}{UNFINISHED}\n"
            f"Next: fine-tune on {targets[stage]}, serve the policy, and score it with --stage {stage + 1}."
        )
    elif record.run.split == "test":
        then = f"Record: {path}\n{_next(records)}"
    else:
        then = f"Record: {path}\nThis is a tuning run on validation episodes, so no board shows it."
    print_plain(console, then)


def _rates(record: Record) -> str:
    """Return the success rates of all tasks after the last stage so far."""
    found = record.matrix()
    pairs = zip(found.columns.get_level_values(-1), found.iloc[-1], strict=True)
    return ", ".join(f"{task} {rate:.2f}" for task, rate in pairs)


def requested(
    scenarios: Sequence[str], methods: Sequence[str], every: bool, seeds: int, first: RunSpec, records: Path
) -> list[ResolvedRun]:
    """Return the runs of methods on scenarios, neighbours of one seed together.

    Args:
        scenarios: Ids of the scenarios.
        methods: Names of methods.
        every: Whether all installed methods are meant.
        seeds: Number of seeds.
        first: A run with the first seed, and with all else that the runs have in common.
        records: Folder of the records.

    Raises:
        InputError: No method is named.
    """
    names = chosen_methods(methods, every)
    runs = [
        replace(first, scenario=scenario, method=name, seed=seed).resolve()
        for scenario in scenarios
        for seed in range(first.seed, first.seed + seeds)
        for name in names
    ]
    # one scenario may be named twice, once with its module
    return list({run.path(records): run for run in runs}.values())


def _next(records: Path) -> str:
    """Return the line that names the next command."""
    option = "" if records == RECORDS else f" --records {shlex.quote(str(records))}"
    return f"Next: clbench leaderboard{option}"


def _part(shard: str, runs: Sequence[ResolvedRun]) -> Sequence[ResolvedRun]:
    """Return part i of n of the runs: neighbours, so that few parts need the same pretrained policy.

    Raises:
        InputError: The text is not i/n, with i from 1 to n.
    """
    number, _, count = shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InputError(f"--shard must be i/n with i from 1 to n, for example 2/8, not {shard!r}.")
    begin, end = (len(runs) * part // int(count) for part in (int(number) - 1, int(number)))
    return runs[begin:end]


def _workers(count: int | None, ray: str | None, device: str) -> Workers:
    """Return the workers that do the runs: processes of this machine, or a Ray cluster at an address."""
    if ray is None:
        from clbench.jobs.processes import Processes

        return Processes(count, device)
    from clbench.jobs.ray import RayWorkers

    return RayWorkers(ray, count)


def _print_forecast(
    runs: Sequence[ResolvedRun], records: Path, workers: int, checkpoints: Path | None
) -> None:
    """Print what the runs without a record would take."""
    from clbench.jobs.forecast import forecast
    from clbench.jobs.grid import missing

    with checked_input():
        to_do = missing(runs, records, checkpoints)
        plan = to_do.plan(records, checkpoints)
    lines = [f"{len(runs) - len(to_do.runs)} of {counted(len(runs), 'run')} done already."]
    lines += forecast(plan, [*to_do.runs, *to_do.stages], workers, checkpoints) if plan.jobs else []
    print_plain(Console(), "\n".join(lines))


def do_runs(
    runs: Sequence[ResolvedRun],
    records: Path,
    workers: Callable[[], Workers],
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
    quiet: bool = False,
) -> bool:
    """Do the runs that have no record yet, print failures, and return whether all runs succeeded."""
    from clbench.jobs import grid

    console = Console(stderr=True, quiet=quiet)
    with checked_input():
        failed = grid.run_missing(runs, records, workers, console, checkpoints, tensorboard)
    if failed and quiet:
        for job, reason in failed.items():
            print_plain(Console(stderr=True), printable_lines(f"{job}: {reason}"))
    if failed:
        names = ", ".join(map(str, failed))
        print_plain(console, f"{len(failed)} failed: {names}.", "bold red")
    return not failed
