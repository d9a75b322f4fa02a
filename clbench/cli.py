"""The commands: `clbench list`, `run`, `tune`, `metrics`, `leaderboard`, `demonstrations`, `doctor`."""

from __future__ import annotations

import itertools
import logging
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

import clbench
from clbench.record import RECORDS, TUNING

if TYPE_CHECKING:
    from clbench.run import RunSpec

app = App(
    name="clbench",
    help=clbench.__doc__,
    version=clbench.__version__,
    suppress_keyboard_interrupt=False,  # `main` says what is kept
)

# Named, not imported: the core knows its parts by name alone.
app.command("clbench.leaderboard.cli:show", name="leaderboard")
app.command("clbench.leaderboard.cli:claims", name="claims")
app.command("clbench.leaderboard.cli:method_pages", name="method-pages")
app.command("clbench.doctor:doctor", name="doctor")


def main() -> None:
    """Run the command line."""
    console = Console(stderr=True)
    handler = RichHandler(console=console, show_time=False, show_path=False)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler])
    # a scheduler's SIGTERM ends the workers too, as Ctrl-C does
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        app()
    except KeyboardInterrupt:
        console.print("Stopped. Finished records are kept; the same command goes on from here.", style="bold")
        sys.exit(130)


@contextmanager
def _input() -> Iterator[None]:
    """Check input inside: a wrong name or value ends with exit code 2 and says the nearest right one."""
    try:
        yield
    except (LookupError, ValueError, TypeError) as error:
        console = Console(stderr=True, soft_wrap=True)
        console.print(
            f"error: {error.args[0] if error.args else error!r}",
            style="bold red",
            highlight=False,
            markup=False,
        )
        sys.exit(2)


def _at_least(least: int, option: str, value: int | None) -> None:
    if value is not None and value < least:
        raise ValueError(f"{option} must be at least {least}, not {value}.")


@app.command(name="list")
def list_() -> None:
    """List the scenarios with their tasks, and the methods with the prior data that they use."""
    from clbench.method import load_method, method_names
    from clbench.task import load_scenario, scenario_ids

    console = Console()
    scenarios = Table(title="Scenarios", show_lines=True)
    for column in ("id", "retained", "target, in order", "held out"):
        scenarios.add_column(column, no_wrap=column == "id")
    for scenario in map(load_scenario, scenario_ids()):
        groups = (scenario.retained, scenario.target, scenario.held_out)
        scenarios.add_row(scenario.id, *(", ".join(task.name for task in group) for group in groups))
    console.print(scenarios)
    methods = Table(title="Methods")
    for column in ("name", "prior demonstrations", "prior questions", "what it does"):
        methods.add_column(column, no_wrap=column == "name")
    for name in method_names():
        try:
            method = load_method(name)
            summary = (method.__doc__ or "").strip().partition("\n")[0]
            row: tuple[str, str, str] = (method.uses.demonstrations, method.uses.questions, summary)
        except Exception as error:  # a plug-in that is broken must not hide the others
            row = ("?", "?", f"cannot be loaded: {error}")
        methods.add_row(name, *row)
    console.print(methods)


@app.command
def run(
    scenario: str,
    /,
    *methods: str,
    every: Annotated[bool, Parameter(name="--all", negative="")] = False,
    seeds: int = 3,
    first_seed: int = 0,
    workers: int | None = None,
    records: Path = RECORDS,
    device: str = "cpu",
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
) -> None:
    """Run METHODS on SCENARIO, once per seed, and write a record of each run.

    What is missing is made first: demonstrations, then a pretrained policy for each seed. A run that has a
    record is skipped, so a stopped command goes on where it was.

    Args:
        scenario: Gymnasium id of the scenario, as clbench/Fetch-v0; module:id imports the module first.
        methods: Names of installed methods, or module:Class.
        every: Run all installed methods.
        seeds: How many seeds.
        first_seed: The first of them.
        workers: Runs at once, each a process with one thread; all cores if not given.
        records: Folder of the records.
        device: Where policies are computed, as cpu or cuda.
        changes: Hyper-parameters that differ from the methods' own, as --set.name value. Such a run has a
            record of its own, which the leaderboard does not show.
    """
    from clbench.method import build_method, method_names
    from clbench.run import RunSpec, check_device
    from clbench.task import load_scenario

    sys.path.insert(0, os.getcwd())  # a console script lacks it, and module:Class is looked for there
    with _input():
        _at_least(1, "--seeds", seeds)
        _at_least(0, "--first-seed", first_seed)
        _at_least(1, "--workers", workers)
        names = dict.fromkeys([*methods, *(method_names() if every else ())])
        if not names:
            raise ValueError("Name at least one method, or --all; `clbench list` shows them.")
        check_device(device)
        load_scenario(scenario)
        built = {method: build_method(method, changes or {}) for method in names}
    values = {name: {key: getattr(method, key) for key in changes or {}} for name, method in built.items()}
    specs = [
        RunSpec(scenario, method, seed, values[method], device)
        for seed in range(first_seed, first_seed + seeds)
        for method in built
    ]
    if not _run_missing(specs, records, workers):
        sys.exit(1)


def _run_missing(specs: list[RunSpec], records: Path, workers: int | None) -> bool:
    """Do the runs that have no record yet, and return whether none failed."""
    from clbench.grid import benchmark_jobs, run_jobs
    from clbench.progress import Bars
    from clbench.run import has_record

    console = Console(stderr=True)
    missing = [spec for spec in specs if not has_record(spec, records)]
    if len(missing) < len(specs):
        console.print(f"{len(specs) - len(missing)} of {len(specs)} runs have a record already.")
    if not missing:
        return True
    begin = time.monotonic()
    jobs = benchmark_jobs(missing, records)
    with Bars(sum(job.length for job in jobs), console) as bars:
        failed = run_jobs(jobs, workers or os.cpu_count() or 1, bars)
    seconds = time.monotonic() - begin
    console.print(
        f"{len(missing)} runs in {seconds / 60:.1f} minutes; records in {records}.", highlight=False
    )
    if failed:
        console.print(
            f"{len(failed)} failed: {', '.join(failed)}.", style="bold red", highlight=False, markup=False
        )
    return not failed


@app.command
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

    Every combination of the values is run with a seed that no board reports and on selection episodes, beside
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
    from clbench.method import build_method
    from clbench.run import RunSpec
    from clbench.task import load_scenario

    sys.path.insert(0, os.getcwd())
    with _input():
        _at_least(0, "--seed", seed)
        _at_least(1, "--targets", targets)
        _at_least(1, "--workers", workers)
        load_scenario(scenario)
        lists = [[(name, value) for value in text.split(",")] for name, text in values.items()]
        specs = []
        for combination in map(dict, itertools.product(*lists)):
            built = build_method(method, combination)
            changes = {name: getattr(built, name) for name in combination}
            specs.append(RunSpec(scenario, method, seed, changes, split="selection", targets=targets))
    baseline = RunSpec(scenario, "sft", seed, split="selection", targets=targets)
    going_well = _run_missing([baseline, *specs], records, workers)
    Console().print(_tuning_table(baseline, specs, records))
    if not going_well:
        sys.exit(1)


def _tuning_table(baseline: RunSpec, specs: list[RunSpec], records: Path) -> Table:
    """Return what came of the runs that have a record."""
    from clbench.metrics import measure
    from clbench.record import read_record
    from clbench.run import has_record
    from clbench.scores import Scores

    names = ("adaptation", "retention", "retention_at_matched_adaptation", "question_retention")
    table = Table(title=f"{baseline.scenario}, seed {baseline.seed}, selection episodes")
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


@app.command
def metrics(name: str | None = None, /, *, markdown: Path | None = None) -> None:
    """Show the metrics, or all about the one called NAME.

    Args:
        name: Name of a metric, as forgetting.
        markdown: Write the page of all metrics to this file, as docs/metrics.md, and show nothing.
    """
    from clbench import metric_pages
    from clbench.metrics import load_metric

    console = Console()
    with _input():
        if name and markdown:
            raise ValueError("The page has all metrics: give a name or --markdown, not both.")
        metric = load_metric(name) if name else None
    if markdown:
        markdown.parent.mkdir(parents=True, exist_ok=True)
        markdown.write_text(metric_pages.page(), encoding="utf-8", newline="\n")
    elif metric:
        console.print(metric_pages.text(metric), end="", soft_wrap=True, highlight=False, markup=False)
    else:
        width = max(console.width, metric_pages.WIDTH)
        Console(width=width).print(metric_pages.table())


@app.command
def demonstrations(scenario: str, /, *, workers: int | None = None) -> None:
    """Collect the expert demonstrations of SCENARIO as Minari datasets, and show a table of them.

    Args:
        scenario: Gymnasium id of the scenario.
        workers: Tasks that are collected at once; all cores if not given.
    """
    from clbench.demonstrations import dataset_folder, read_dataset
    from clbench.grid import demonstration_jobs, run_jobs
    from clbench.progress import Bars
    from clbench.task import load_scenario

    with _input():
        _at_least(1, "--workers", workers)
        loaded = load_scenario(scenario)
    jobs = demonstration_jobs(scenario, [task.name for task in loaded.tasks])
    with Bars(sum(job.length for job in jobs)) as bars:
        failed = run_jobs(jobs, workers or os.cpu_count() or 1, bars)
    if failed:
        sys.exit(1)
    table = Table(title=f"Demonstrations of {loaded.id}")
    for column in ("dataset", "group", "episodes", "disturbed", "success", "mean length"):
        table.add_column(column, no_wrap=column == "dataset")
    for task in loaded.tasks:
        episodes = read_dataset(dataset_folder(task, loaded.budget))
        lengths = [len(episode.executed) for episode in episodes]
        table.add_row(
            task.dataset_id,
            loaded.group(task.name),
            str(len(episodes)),
            str(sum(bool(episode.disturbed.any()) for episode in episodes)),
            f"{sum(episode.success for episode in episodes) / len(episodes):.2f}",
            f"{sum(lengths) / len(lengths):.1f}",
        )
    Console().print(table)
