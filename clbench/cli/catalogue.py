"""The commands `clbench list`, `clbench metrics` and `clbench doctor`: what this installation has."""

from __future__ import annotations

import os
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from rich.console import Console
from rich.markup import escape
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


def doctor() -> None:
    """Show package versions, threads, rendering and folders, and how to install missing parts."""
    from clbench.learning.registry import method_names

    console = Console()
    console.print(_packages())
    console.print(_machine())
    if not method_names():
        console.print("No method is installed: run `pip install -e .` in the checkout.", style="bold red")


def _packages() -> Table:
    from packaging.requirements import Requirement

    from clbench.base.dependencies import extra_of

    table = Table("package", "found", "tested", "", title="Packages")
    for text in requires("clbench") or []:
        requirement = Requirement(text)
        extra = extra_of(requirement)
        if extra == "dev":
            continue
        try:
            found = version(requirement.name)
            fits = requirement.specifier.contains(found, prereleases=True)
            install = f"[red]pip install '{requirement.name}{requirement.specifier}'[/]"
            verdict = "[green]fits[/]" if fits else install
        except PackageNotFoundError:
            found = "-"
            verdict = escape(f"pip install 'clbench[{extra}]'") if extra else "[red]pip install clbench[/]"
        table.add_row(requirement.name, found, str(requirement.specifier), verdict)
    return table


def _machine() -> Table:
    import torch

    from clbench.base.cache import cache_folder
    from clbench.cli.arguments import minari_folder
    from clbench.worlds.gl_backend import DEBIAN_PACKAGES, rendering_fault

    table = Table(title="Machine", show_header=False)
    table.add_row("python", sys.version.split()[0])
    table.add_row("cores", f"{os.cpu_count()} ({torch.get_num_threads()} threads in PyTorch; a run uses one)")
    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "none (and none is needed)"
    table.add_row("cuda", cuda)
    faults = {back_end: rendering_fault(back_end) for back_end in DEBIAN_PACKAGES}
    for back_end, fault in faults.items():
        missing = f"does not work; apt-get install {DEBIAN_PACKAGES[back_end]}"
        table.add_row(f"rendering: {back_end}", "works" if fault is None else missing)
    table.add_row("films", _films(faults))
    table.add_row("cache", _folder(cache_folder(), "CLBENCH_CACHE"))
    table.add_row("demonstrations", _folder(minari_folder() / "clbench", "MINARI_DATASETS_PATH"))
    return table


def _films(faults: dict[str, str | None]) -> str:
    """Return the back end that renders films, if one works."""
    from clbench.worlds.gl_backend import rendering_fault

    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        fault = faults[chosen] if chosen in faults else rendering_fault(chosen)
        able = "rendered" if fault is None else "cannot be rendered"
        return f"{able} with {chosen}, which MUJOCO_GL chooses"
    working = [back_end for back_end, fault in faults.items() if fault is None]
    if working:
        return f"rendered with {working[0]}; MUJOCO_GL chooses another"
    return "cannot be rendered until one of the above works; scores need no rendering"


def _folder(path: Path, variable: str) -> str:
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.exists() else 0
    return f"{path} ({size / 1e6:.1f} MB; {variable} moves it)"
