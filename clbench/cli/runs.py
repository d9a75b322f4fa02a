"""The commands `clbench run` and `clbench tune`."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from clbench.base.errors import InputError
from clbench.cli.arguments import add_cwd_to_path, at_least, checked_input
from clbench.jobs.job import Workers
from clbench.jobs.processes import Processes
from clbench.records.paths import RECORDS, TUNING
from clbench.records.reader import read_record
from clbench.runs.spec import RunSpec, check_device, has_record, read_changes
from clbench.scoring.intervals import expected_precision
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.spec.registry import load_scenario

# What imports PyTorch is imported where it is needed: `--help` does not wait for it.


def run(
    scenarios: str,
    /,
    *methods: str,
    every: Annotated[bool, Parameter(name="--all", negative="")] = False,
    seeds: int = 3,
    first_seed: int = 0,
    order: int = 0,
    perturb: Annotated[bool, Parameter(negative="")] = False,
    workers: int | None = None,
    shard: str = "1/1",
    ray: str | None = None,
    records: Path = RECORDS,
    device: str = "cpu",
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> None:
    """Run METHODS on SCENARIOS, once per seed, and write a record of each run.

    What is missing is made first: demonstrations, then a pretrained policy for each seed. A run that has a
    record is skipped, so a stopped command goes on where it was.

    Args:
        scenarios: Gymnasium id of the scenario, as clbench/Fetch-v0, or more with commas between; module:id
            imports the module first.
        methods: Names of installed methods, or module:Class.
        every: Run all installed methods.
        seeds: How many seeds.
        first_seed: The first of them.
        order: In which order the targets are learned. 0 is the published one, of which the leaderboard's rows
            are; others are permutations, from which it tells how much depends on the order.
        perturb: Evaluate the retained skills in disturbed worlds too, from other start poses, with heavier or
            lighter things and, in pictures, another camera and light. Such a record takes the place of one
            without, whose episodes are all in it.
        workers: Runs at once, each a process with one thread; all cores if not given.
        shard: Do only part i of n of the runs, as 2/8: for array jobs, whose tasks share a folder of records.
        ray: Do the runs on a Ray cluster: its address, auto for one that runs here, or local to start one.
        records: Folder of the records.
        device: Where policies are computed, as cpu or cuda.
        changes: Hyper-parameters that differ from the methods' own, as --set.name value. Such a run has a
            record of its own, which the leaderboard does not show.
        checkpoints: Keep the policies of all stages below this folder. Those of runs that have a record are
            made again.
        tensorboard: Log the runs for TensorBoard below this folder, while they are under way.
    """
    from clbench.learning.registry import method_names
    from clbench.runs.tensorboard import require_tensorboard

    add_cwd_to_path()
    with checked_input():
        at_least(1, "--seeds", seeds)
        at_least(0, "--first-seed", first_seed)
        at_least(1, "--workers", workers)
        names = dict.fromkeys([*methods, *(method_names() if every else ())])
        if not names:
            raise InputError("Name at least one method, or --all; `clbench list` shows them.")
        check_device(device)
        if tensorboard:
            require_tensorboard()
        values = {method: read_changes(method, changes or {}) for method in names}
        every_run = [
            RunSpec(scenario, method, seed, values[method], device, order=order, perturb=perturb)
            for scenario in dict.fromkeys(scenarios.split(","))
            for seed in range(first_seed, first_seed + seeds)
            for method in names
        ]
        loaded = [spec.load() for spec in {spec.scenario: spec for spec in every_run}.values()]
        specs = _part(shard, every_run)
    console = Console(stderr=True)
    for scenario in loaded:
        console.print(expected_precision(scenario, seeds), highlight=False)
    if not _run_missing(specs, records, lambda: _workers(workers, ray), checkpoints, tensorboard):
        sys.exit(1)


def _part(shard: str, specs: list[RunSpec]) -> list[RunSpec]:
    """Return part i of n of the runs: neighbours, so that few parts need the same pretrained policy.

    Raises:
        ValueError: The text is not i/n, with i from 1 to n.
    """
    number, _, count = shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise InputError(f"--shard must be i/n with i from 1 to n, as 2/8, not {shard!r}.")
    begin, end = (len(specs) * part // int(count) for part in (int(number) - 1, int(number)))
    return specs[begin:end]


def _workers(count: int | None, ray: str | None) -> Workers:
    """Return who does the runs: processes of this machine, or a Ray cluster at an address."""
    if ray is None:
        return Processes(count)
    from clbench.jobs.ray import RayWorkers

    with checked_input():
        return RayWorkers(ray, count)


def _run_missing(
    specs: list[RunSpec],
    records: Path,
    workers: Callable[[], Workers],
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> bool:
    """Do the runs that have no record yet, keep what policies are to be kept; return whether none failed."""
    from clbench.jobs.plan import benchmark_jobs, stages_jobs
    from clbench.jobs.scheduler import run_with_bars
    from clbench.runs.checkpoints import has_stages

    console = Console(stderr=True)
    with checked_input():
        missing = [spec for spec in specs if not has_record(spec, records)]
    if len(missing) < len(specs):
        console.print(f"{len(specs) - len(missing)} of {len(specs)} runs have a record already.")
    recorded = [spec for spec in specs if spec not in missing]
    bare = [spec for spec in recorded if checkpoints and not has_stages(spec, checkpoints)]
    if not missing and not bare:
        return True
    begin = time.monotonic()
    with checked_input():  # where nothing draws, a scenario with a camera is refused
        runs = benchmark_jobs(missing, records, checkpoints=checkpoints, tensorboard=tensorboard)
    # what both need is made once
    jobs = list({job.name: job for job in (*runs, *stages_jobs(bare, checkpoints))}.values())
    failed = run_with_bars(jobs, workers(), console)
    seconds = time.monotonic() - begin
    done = f"{len(missing)} runs" + (f" and the policies of {len(bare)}" if bare else "")
    console.print(f"{done} in {seconds / 60:.1f} minutes; records in {records}.", highlight=False)
    if failed:
        console.print(
            f"{len(failed)} failed: {', '.join(failed)}.", style="bold red", highlight=False, markup=False
        )
    return not failed


def tune(
    scenario: str,
    method: str,
    /,
    *,
    values: dict[str, str],
    seed: int = 100,
    targets: int | None = None,
    workers: int | None = None,
    records: Path = TUNING,
) -> None:
    """Compare settings of METHOD on SCENARIO, without a look at anything that is reported.

    Every combination of the values is run with a seed that no board reports and on validation episodes, beside
    plain fine-tuning. Show the table again with the same command; runs that have a record are skipped.

    Args:
        scenario: Gymnasium id of the scenario.
        method: Name of an installed method, or module:Class.
        values: Hyper-parameters and the values to try, as --values.tau_start 0.3,1,3
        seed: Of pretraining and of every draw; the boards report seeds from 0.
        targets: How many targets are learned, from the first; all if not given. Fewer are faster.
        workers: Runs at once, each a process with one thread; all cores if not given.
        records: Folder of these records.
    """
    add_cwd_to_path()
    with checked_input():
        at_least(0, "--seed", seed)
        at_least(1, "--targets", targets)
        at_least(1, "--workers", workers)
        load_scenario(scenario)
        lists = [[(name, value) for value in text.split(",")] for name, text in values.items()]
        specs = []
        for combination in map(dict, itertools.product(*lists)):
            changes = read_changes(method, combination)
            specs.append(RunSpec(scenario, method, seed, changes, split="validation", targets=targets))
    baseline = RunSpec(scenario, "sft", seed, split="validation", targets=targets)
    going_well = _run_missing([baseline, *specs], records, lambda: Processes(workers))
    Console().print(_tuning_table(baseline, specs, records))
    if not going_well:
        sys.exit(1)


def _tuning_table(baseline: RunSpec, specs: list[RunSpec], records: Path) -> Table:
    """Return what came of the runs that have a record."""
    names = ("adaptation", "retention", "retention_at_matched_adaptation", "question_retention")
    table = Table(title=f"{baseline.scenario}, seed {baseline.seed}, validation episodes")
    table.add_column("settings", no_wrap=True)
    for name in names:
        table.add_column(name.replace("_", " "), justify="right")
    scores = {
        spec.label: Scores.from_record(read_record(spec.path(records)))
        for spec in [baseline, *specs]
        if has_record(spec, records)
    }
    reference = scores.get(baseline.label)
    for label, one in scores.items():
        row = [measure(name, one, {"sft": reference} if reference else {}) for name in names]
        table.add_row(label, *("-" if value is None else f"{value:.2f}" for value in row))
    return table
