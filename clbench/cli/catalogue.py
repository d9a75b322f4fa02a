"""The commands `clbench list` and `clbench metrics`."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from clbench.base.errors import InputError
from clbench.cli.arguments import checked_input


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
        except Exception as error:  # a broken plug-in must not hide the others
            row = ("?", "?", f"cannot be loaded: {error}")
        methods.add_row(name, *row)
    console.print(methods)


def metrics(name: str | None = None, /, *, markdown: Path | None = None) -> None:
    """Show a table of all metrics, or everything about the metric NAME.

    Args:
        name: Name of a metric, for example forgetting.
        markdown: Write the page of all metrics to this file, for example docs/reference/metrics.md, and show
            nothing.
    """
    from clbench.cli import metric_pages
    from clbench.scoring.metrics import load_metric

    console = Console()
    with checked_input():
        if name and markdown:
            raise InputError("The page holds all metrics: give a name or --markdown, not both.")
        metric = load_metric(name) if name else None
    if markdown:
        markdown.parent.mkdir(parents=True, exist_ok=True)
        markdown.write_text(metric_pages.page(), encoding="utf-8", newline="\n")
    elif metric:
        console.print(metric_pages.text(metric), end="", soft_wrap=True, highlight=False, markup=False)
    else:
        width = max(console.width, metric_pages.WIDTH)
        Console(width=width).print(metric_pages.table())
