"""The commands `clbench list`, `clbench metrics` and `clbench doctor`: what this installation has."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from packaging.requirements import Requirement
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from clbench import __version__
from clbench.base.dependencies import extra_of, is_for_this_python
from clbench.base.errors import InputError
from clbench.base.leftovers import replacing
from clbench.base.text import megabytes, print_plain, printable
from clbench.cli.arguments import AsJson, checked_input, checked_writing, print_json
from clbench.records.tables import GROUPS
from clbench.spec.identifiers import scenario_ids
from clbench.spec.registry import registered_scenario

TaskNames = Annotated[tuple[str, ...], Parameter(consume_multiple=True, show_default=False)]
"""Names of tasks on the command line, one or more after one option."""


def list_(*, as_json: AsJson = False) -> None:
    """List the scenarios with their tasks, and the methods with the prior data that they use.

    Args:
        as_json: Print one JSON object with both, and no tables.
    """
    scenarios, methods = _scenarios(), _methods()
    if as_json:
        print_json({"scenarios": scenarios, "methods": methods})
        return
    console = Console()
    for values in scenarios:
        names = {group.replace("_", " "): ", ".join(values[group]) for group in GROUPS if values[group]}
        if values["fault"] is not None:
            names = {"cannot be loaded:": values["fault"]}
        _print_entries(console, values["id"], names)
    by_data: dict[str, dict[str, str]] = {}
    for method in methods:
        by_data.setdefault(_prior_data(method), {})[str(method["name"])] = str(method["summary"])
    for data, entries in sorted(by_data.items(), key=lambda item: len(item[0])):
        _print_entries(console, f"Methods that use {data}", entries)


def _print_entries(console: Console, title: str, entries: Mapping[str, str]) -> None:
    """Print names with their texts, which wrap between words alone."""
    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in entries.items():
        table.add_row(f"  {name}", Text(text))
    console.print(Text(title, style="bold"), table, "")


def _prior_data(method: Mapping[str, str | None]) -> str:
    """Return the prior data of a method in words."""
    kinds = {kind: method[kind] for kind in ("demonstrations", "questions")}
    if None in kinds.values():
        return "unknown prior data"
    times = {"prepare": "before the first target", "throughout": "throughout"}
    used = [f"prior {kind} {times[when]}" for kind, when in kinds.items() if when in times]
    return " and ".join(used) or "no prior data"


def _scenarios() -> list[dict[str, Any]]:
    """Return the registered scenarios with their tasks; those that cannot be loaded have a fault instead."""
    found: list[dict[str, Any]] = []
    for name in scenario_ids():
        values: dict[str, Any] = {"id": name, **dict.fromkeys(GROUPS), "fault": None}
        try:
            one = registered_scenario(name)
            values |= {group: [task.name for task in getattr(one, group)] for group in GROUPS}
        except Exception as error:  # a broken plug-in must not hide the others
            values["fault"] = printable(str(error))
        found.append(values)
    return found


def _methods() -> list[dict[str, str | None]]:
    """Return the installed methods, each with the prior data that it uses and its summary."""
    from clbench.learning.registry import load_method, method_names

    found: list[dict[str, str | None]] = []
    for name in method_names():
        values: dict[str, str | None] = {"name": name, "demonstrations": None, "questions": None}
        try:
            method = load_method(name)
            values |= {"demonstrations": method.uses.demonstrations, "questions": method.uses.questions}
            summary = (method.__doc__ or "").strip().partition("\n")[0]
        except Exception as error:  # a broken plug-in must not hide the others
            summary = f"cannot be loaded: {error}"
        found.append({**values, "summary": printable(summary)})
    return found


def metrics(
    name: str | None = None,
    /,
    *,
    retained: TaskNames = (),
    target: TaskNames = (),
    held_out: TaskNames = (),
    unit: Literal["share", "percent"] | None = None,
    markdown: Path | None = None,
    as_json: AsJson = False,
) -> None:
    """List all metrics, explain the metric NAME, or compute the metrics of success rates in a CSV file.

    A file has the column stage and one column for each task, or the columns stage, task and success. The
    columns method and seed are optional. robocasa365.csv is an example that comes with clbench.

    Args:
        name: Name of a metric, for example forgetting, or a CSV file.
        retained: Tasks of the file that are known before stage 1 and never trained again.
        target: Tasks of the file that are learned, in this order (default: all other tasks, as in the file).
        held_out: Tasks of the file that are never trained.
        unit: Unit of the rates in the file (default: percent if a rate is above 1, otherwise share).
        markdown: Write the page of all metrics to this file, for example docs/reference/metrics.md, and show
            nothing.
        as_json: Print a JSON list with an object for each metric, or one object for the file.
    """
    from clbench.cli import metric_pages
    from clbench.cli.metric_pages import facts
    from clbench.metrics import view
    from clbench.metrics.tables import find, from_csv, is_table, notes
    from clbench.scoring.metrics import METRICS, load_metric

    console = Console()
    with checked_input():
        if name and markdown:
            raise InputError("The page holds all metrics: give a name or --markdown, not both.")
        if markdown and as_json:
            raise InputError("--markdown writes a page, and --json prints JSON: give one of them.")
        if name and is_table(name):
            path = find(name)
            report = from_csv(path, retained=retained, target=target or None, held_out=held_out, unit=unit)
            if as_json:
                print_json(view.as_values(report))
            else:
                console.print(view.text(report, notes(path)), highlight=False)
            return
        if retained or target or held_out or unit:
            raise InputError("--retained, --target, --held-out and --unit need a CSV file.")
        metric = load_metric(name) if name else None
    if markdown:
        with checked_input():
            _write_page(markdown, metric_pages.page())
    elif as_json:
        chosen = [metric] if metric else METRICS.values()
        print_json([{"name": one.name, "description": one.description, **facts(one)} for one in chosen])
    elif metric:
        console.print(metric_pages.text(metric), end="", soft_wrap=True, highlight=False, markup=False)
    else:
        console.print(metric_pages.listing(), highlight=False)


def _write_page(path: Path, text: str) -> None:
    """Write a page.

    Raises:
        InputError: The file system refuses.
    """
    with checked_writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_text(text, encoding="utf-8", newline="\n")


def doctor(*, as_json: AsJson = False) -> None:
    """Show package versions, threads, rendering and folders, and how to install missing parts.

    The last line says whether clbench can run here. If not, the command ends with exit code 1.

    Args:
        as_json: Print one JSON object, and no tables.
    """
    from clbench.jobs.folders import check_folders
    from clbench.learning.registry import method_names

    packages, machine = _packages(), _machine()
    faults = [one.advice for one in packages if one.is_wrong]
    faults += [] if method_names() else ["pip install -e . in the checkout, as no method is installed"]
    try:
        check_folders({})
    except InputError as error:
        faults.append(str(error).removesuffix("."))
    if as_json:
        print_json(
            {
                "clbench": __version__,
                "ready": not faults,
                "fix": faults,
                "packages": {
                    one.requirement.name: {"found": one.found, "tested": str(one.requirement.specifier)}
                    for one in packages
                },
                "machine": machine,
            }
        )
    else:
        _print_doctor(packages, machine, faults)
    if faults:
        raise SystemExit(1)


def _print_doctor(packages: Sequence[_Package], machine: Mapping[str, str], faults: Sequence[str]) -> None:
    console = Console()
    table = Table("package", "found", "tested", "", title="Packages")
    for one in packages:
        table.add_row(one.requirement.name, one.found or "-", str(one.requirement.specifier), one.verdict)
    console.print(table)
    table = Table(title="Machine", show_header=False)
    for name, value in machine.items():
        table.add_row(name, escape(value))
    console.print(table)
    if faults:
        print_plain(console, f"clbench {__version__} cannot run here yet: {'; '.join(faults)}", "bold red")
    else:
        console.print(f"clbench {__version__} is ready.", style="bold green", highlight=False)


@dataclass(frozen=True)
class _Package:
    """A package that clbench needs, or that an extra brings."""

    requirement: Requirement
    extra: str
    """Extra of clbench that brings it, empty if all need it."""
    found: str | None
    """The installed version."""

    @property
    def fits(self) -> bool:
        """Whether the installed version is one that was tried."""
        return self.found is not None and self.requirement.specifier.contains(self.found, prereleases=True)

    @property
    def is_wrong(self) -> bool:
        """Whether clbench cannot do without what is missing or wrong."""
        return not self.fits and not self.extra

    @property
    def is_left_out(self) -> bool:
        """Whether it belongs to an extra, and is not installed."""
        return bool(self.extra) and self.found is None

    @property
    def advice(self) -> str:
        """The command that installs a version that fits."""
        what = f"clbench[{self.extra}]" if self.is_left_out else self.requirement
        return f"pip install '{what}'"

    @property
    def verdict(self) -> Text:
        """The last cell of its row."""
        if self.fits:
            return Text("fits", "green")
        return Text(self.advice, "" if self.is_left_out else "red")


def _packages() -> list[_Package]:
    found = []
    for text in requires("clbench") or []:
        requirement = Requirement(text)
        extra = extra_of(requirement)
        if extra == "dev" or not is_for_this_python(requirement):
            continue
        requirement.marker = None
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            installed = None
        found.append(_Package(requirement, extra, installed))
    return found


def _machine() -> dict[str, str]:
    """Return what matters of this machine."""
    import torch

    from clbench.base.cache import cache_folder, minari_folder
    from clbench.runs.fingerprint import arithmetic_hash
    from clbench.worlds.gl_backend import DEBIAN_PACKAGES, rendering_fault
    from clbench.worlds.threads import cores

    back_ends = tuple(DEBIAN_PACKAGES) if sys.platform == "linux" else ("glfw",)
    faults = {back_end: rendering_fault(back_end) for back_end in back_ends}
    working = [back_end for back_end, fault in faults.items() if fault is None]
    rendering = {}
    for back_end, fault in faults.items():
        packages = DEBIAN_PACKAGES.get(back_end)
        missing = f"apt-get install {packages}" if packages else "it needs a screen"
        help_ = "not needed" if working else missing
        rendering[f"rendering: {back_end}"] = "works" if fault is None else f"does not work; {help_}"
    machine = {
        "python": sys.version.split()[0],
        "cores": f"{cores()} ({torch.get_num_threads()} threads in PyTorch; a run computes with one)",
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else "none (and none is needed)",
        "arithmetic": f"{arithmetic_hash()} (the same on machines that train to the same bits)",
        **rendering,
        "films": _films(faults),
    }
    with suppress(InputError):  # the user has no home folder: the last line says so
        machine["cache"] = _folder(cache_folder(), "CLBENCH_CACHE")
        machine["demonstrations"] = _folder(minari_folder() / "clbench", "MINARI_DATASETS_PATH")
    return machine


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
    from clbench.cli.cache import size_of

    return f"{path} ({megabytes(size_of(path))}; {variable} moves it)"
