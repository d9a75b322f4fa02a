"""The command line: its short commands, and where the others are."""

from __future__ import annotations

import logging
import signal
import sys
from pathlib import Path

from cyclopts import App
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

import clbench
from clbench.base.errors import InputError
from clbench.cli.arguments import at_least, checked_input

app = App(
    name="clbench",
    help=clbench.__doc__,
    version=clbench.__version__,
    suppress_keyboard_interrupt=False,  # `main` says what is kept
)

# Named, not imported: a command loads what it needs, and the core knows its parts by name alone.
app.command("clbench.cli.runs:run", name="run")
app.command("clbench.cli.runs:tune", name="tune")
app.command("clbench.cli.film:film", name="film")
app.command("clbench.leaderboard.cli:show", name="leaderboard")
app.command("clbench.leaderboard.cli:submit", name="submit")
app.command("clbench.leaderboard.cli:verify", name="verify")
app.command("clbench.leaderboard.cli:claims", name="claims")
app.command("clbench.leaderboard.cli:method_pages", name="method-pages")
app.command("clbench.leaderboard.cli:scenario_card", name="scenario-card")
app.command("clbench.cli.doctor:doctor", name="doctor")
experts = App(
    name="experts", help="Measure the experts that demonstrate tasks, and train those that are learned."
)
experts.command("clbench.cli.experts:measure", name="measure")
experts.command("clbench.envs.dm_control.cli:train", name="train")
app.command(experts)


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
    from clbench.learning.registry import load_method, method_names
    from clbench.spec.identifiers import scenario_ids
    from clbench.spec.registry import registered_scenario

    console = Console()
    scenarios = Table(title="Scenarios", show_lines=True)
    for column in ("id", "retained", "target, in order", "held out"):
        scenarios.add_column(column, no_wrap=column == "id")
    for scenario in map(registered_scenario, scenario_ids()):
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
    from clbench.cli.new_method import class_name, write_method

    with checked_input():
        module, test = write_method(name, folder)
    lines = [f"Wrote {module} and {test}. Make the method yours, then:"]
    lines += [f"  cd {folder}"] if folder != Path() else []
    lines += [f"  python -m pytest {test.name}", f"  clbench submit {name}:{class_name(name)}"]
    Console().print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)


@app.command
def metrics(name: str | None = None, /, *, markdown: Path | None = None) -> None:
    """Show the metrics, or all about the one called NAME.

    Args:
        name: Name of a metric, as forgetting.
        markdown: Write the page of all metrics to this file, as docs/reference/metrics.md, and show nothing.
    """
    from clbench.cli import metric_pages
    from clbench.scoring.metrics import load_metric

    console = Console()
    with checked_input():
        if name and markdown:
            raise InputError("The page has all metrics: give a name or --markdown, not both.")
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
    from clbench.data.demonstrations import dataset_folder, read_dataset
    from clbench.jobs.plan import demonstration_jobs
    from clbench.jobs.processes import Processes
    from clbench.jobs.scheduler import run_with_bars
    from clbench.spec.registry import load_scenario

    with checked_input():
        at_least(1, "--workers", workers)
        loaded = load_scenario(scenario)
    jobs = demonstration_jobs(scenario, [task.name for task in loaded.tasks])
    if run_with_bars(jobs, Processes(workers)):
        sys.exit(1)
    table = Table(title=f"Demonstrations of {loaded.id}")
    for column in ("dataset", "group", "episodes", "noisy", "success", "mean length"):
        table.add_column(column, no_wrap=column == "dataset")
    for task in loaded.tasks:
        episodes = read_dataset(dataset_folder(task, loaded.budget))
        lengths = [len(episode.executed) for episode in episodes]
        table.add_row(
            task.dataset_id,
            loaded.group(task.name),
            str(len(episodes)),
            str(sum(bool(episode.noisy.any()) for episode in episodes)),
            f"{sum(episode.success for episode in episodes) / len(episodes):.2f}",
            f"{sum(lengths) / len(lengths):.1f}",
        )
    Console().print(table)
