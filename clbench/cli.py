"""The commands: `clbench list`, `run`, `tune`, `film`, `metrics`, `demonstrations`; the parts add theirs."""

from __future__ import annotations

import itertools
import logging
import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

import clbench
from clbench.arguments import at_least, checked_input
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
app.command("clbench.leaderboard.cli:submit", name="submit")
app.command("clbench.leaderboard.cli:verify", name="verify")
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
def new_method(name: str, /, *, folder: Path = Path()) -> None:
    """Write NAME.py, a commented template of a method, and test_NAME.py.

    Args:
        name: Of the module; that of the class is made from it.
        folder: Where to; nothing in it is overwritten.
    """
    from clbench.new_method import class_name, write_method

    with checked_input():
        module, test = write_method(name, folder)
    lines = [f"Wrote {module} and {test}. Make the method yours, then:"]
    lines += [f"  cd {folder}"] if folder != Path() else []
    lines += [f"  python -m pytest {test.name}", f"  clbench submit {name}:{class_name(name)}"]
    Console().print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)


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
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
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
        checkpoints: Keep the policies of all stages below this folder. Those of runs that have a record are
            made again.
        tensorboard: Log the runs for TensorBoard below this folder, while they are under way.
    """
    from clbench.live import require_tensorboard
    from clbench.method import build_method, method_names
    from clbench.run import RunSpec, check_device
    from clbench.statistics import expected_precision
    from clbench.task import load_scenario

    sys.path.insert(0, os.getcwd())  # a console script lacks it, and module:Class is looked for there
    with checked_input():
        at_least(1, "--seeds", seeds)
        at_least(0, "--first-seed", first_seed)
        at_least(1, "--workers", workers)
        names = dict.fromkeys([*methods, *(method_names() if every else ())])
        if not names:
            raise ValueError("Name at least one method, or --all; `clbench list` shows them.")
        check_device(device)
        if tensorboard:
            require_tensorboard()
        loaded = load_scenario(scenario)
        built = {method: build_method(method, changes or {}) for method in names}
    values = {name: {key: getattr(method, key) for key in changes or {}} for name, method in built.items()}
    specs = [
        RunSpec(scenario, method, seed, values[method], device)
        for seed in range(first_seed, first_seed + seeds)
        for method in built
    ]
    Console(stderr=True).print(expected_precision(loaded, seeds), highlight=False)
    if not _run_missing(specs, records, workers, checkpoints, tensorboard):
        sys.exit(1)


def _run_missing(
    specs: list[RunSpec],
    records: Path,
    workers: int | None,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> bool:
    """Do the runs that have no record yet, keep what policies are to be kept; return whether none failed."""
    from clbench.grid import benchmark_jobs, run_with_bars, stages_jobs
    from clbench.run import has_record
    from clbench.stages import has_stages

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
    runs = benchmark_jobs(missing, records, checkpoints=checkpoints, tensorboard=tensorboard)
    # what both need is made once
    jobs = list({job.name: job for job in (*runs, *stages_jobs(bare, checkpoints))}.values())
    failed = run_with_bars(jobs, workers, console)
    seconds = time.monotonic() - begin
    done = f"{len(missing)} runs" + (f" and the policies of {len(bare)}" if bare else "")
    console.print(f"{done} in {seconds / 60:.1f} minutes; records in {records}.", highlight=False)
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
    with checked_input():
        at_least(0, "--seed", seed)
        at_least(1, "--targets", targets)
        at_least(1, "--workers", workers)
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
def film(
    scenario: str,
    method: str,
    /,
    *,
    seed: int = 0,
    tasks: str | None = None,
    stages: str | None = None,
    episode: int = 0,
    output: Path | None = None,
    size: int = 200,
    fps: int | None = None,
    checkpoints: Path | None = None,
    device: str = "cpu",
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
) -> None:
    """Film METHOD on SCENARIO: the pretrained policy beside that of each stage, in the same initial states.

    The policies are those that `clbench run` kept, or are made again without evaluation.

    Args:
        scenario: Gymnasium id of the scenario.
        method: Name of an installed method, or module:Class.
        seed: Of the run.
        tasks: Names of tasks, as push,lift; every retained skill and target if not given.
        stages: Numbers of stages, as 0,4; all if not given. 0 is before any target.
        episode: Which selection episode; those of the report are not filmed.
        output: A .gif or .mp4 file; if not given, a .gif below films/.
        size: Width of each picture in pixels.
        fps: Steps shown in a second; as in the simulated world if not given.
        checkpoints: Folder below which `clbench run` kept policies.
        device: Where the policies were computed, and are.
        changes: Hyper-parameters that differ from the method's own, as --set.name value.
    """
    from clbench.film import FASTEST, FILMS, check_format, film_run, steps_per_second
    from clbench.method import build_method
    from clbench.progress import Bars
    from clbench.rendering import choose_back_end
    from clbench.run import RunSpec, check_device
    from clbench.stages import load_stages
    from clbench.task import load_scenario

    sys.path.insert(0, os.getcwd())
    with checked_input():
        at_least(0, "--seed", seed)
        at_least(96, "--size", size)
        if fps is not None and not 1 <= fps <= FASTEST:
            raise ValueError(f"--fps must be from 1 to {FASTEST}, not {fps}.")
        check_device(device)
        loaded = load_scenario(scenario)
        built = build_method(method, changes or {})
        spec = RunSpec(scenario, method, seed, {name: getattr(built, name) for name in changes or {}}, device)
        shown = [loaded.task(name) for name in tasks.split(",")] if tasks else loaded.retained + loaded.target
        numbers = _numbers("--stages", stages, len(loaded.target))
        (episode,) = _numbers("--episode", str(episode), loaded.budget.selection_episodes - 1)
        path = output or spec.path(FILMS).with_suffix(".gif")
        check_format(path)
        choose_back_end(task.world for task in shown)
    console = Console(stderr=True)
    policies = load_stages(spec, _stages_folder(spec, checkpoints, console))
    with Bars(len(shown) * len(numbers), console) as bars:
        bars.start("film", len(shown) * len(numbers))
        chosen = {number: policies[number] for number in numbers}
        made = film_run(spec, chosen, shown, episode, size, lambda takes: bars.advance("film", takes))
        made.save(path, fps or steps_per_second(shown[0]))
        width, height = made.size
        bars.finish("film", f"{path} ({width} x {height} pixels, {path.stat().st_size / 1e6:.1f} MB)")


def _numbers(option: str, text: str | None, last: int) -> list[int]:
    """Return the numbers from 0 to `last` that an option names; all if it was not given."""
    if text is None:
        return list(range(last + 1))
    words = text.split(",")
    if not all(word.isdecimal() and int(word) <= last for word in words):
        raise ValueError(f"{option} has numbers from 0 to {last}, not {text}.")
    return [int(word) for word in words]


def _stages_folder(spec: RunSpec, checkpoints: Path | None, console: Console) -> Path:
    """Return where the policies of all stages of a run lie; what is missing is made first."""
    from clbench.grid import run_with_bars, stages_jobs
    from clbench.stages import find_stages, make_stages

    found = find_stages(spec, checkpoints)
    if found is not None:
        return found
    if run_with_bars(stages_jobs([spec], None), None, console):
        sys.exit(1)
    return make_stages(spec)


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
    with checked_input():
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
    from clbench.grid import demonstration_jobs, run_with_bars
    from clbench.task import load_scenario

    with checked_input():
        at_least(1, "--workers", workers)
        loaded = load_scenario(scenario)
    jobs = demonstration_jobs(scenario, [task.name for task in loaded.tasks])
    if run_with_bars(jobs, workers):
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
