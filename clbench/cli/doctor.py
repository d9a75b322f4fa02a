"""The doctor: what is installed, what is missing, and how to get it."""

from __future__ import annotations

import os
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import torch
from packaging.requirements import Requirement
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from clbench.base.cache import cache_folder
from clbench.base.dependencies import extra_of
from clbench.learning.registry import method_names
from clbench.worlds.gl_backend import DEBIAN_PACKAGES, rendering_fault


def doctor() -> None:
    """Show versions, threads, rendering and folders, and say what is missing and how to get it."""
    console = Console()
    console.print(_packages())
    console.print(_machine())
    if not method_names():
        console.print("No method is installed: run `pip install -e .` in the checkout.", style="bold red")


def _packages() -> Table:
    table = Table("package", "found", "tried", "", title="Packages")
    for text in requires("clbench") or []:
        requirement = Requirement(text)
        extra = extra_of(requirement)
        if extra == "dev":
            continue
        try:
            found = version(requirement.name)
            fits = requirement.specifier.contains(found, prereleases=True)
            verdict = (
                "[green]fits[/]"
                if fits
                else f"[red]pip install '{requirement.name}{requirement.specifier}'[/]"
            )
        except PackageNotFoundError:
            found, verdict = (
                "-",
                escape(f"pip install 'clbench[{extra}]'") if extra else "[red]pip install clbench[/]",
            )
        table.add_row(requirement.name, found, str(requirement.specifier), verdict)
    return table


def _machine() -> Table:
    table = Table(title="Machine", show_header=False)
    table.add_row("python", sys.version.split()[0])
    table.add_row("cores", f"{os.cpu_count()} ({torch.get_num_threads()} threads in PyTorch; a run uses one)")
    table.add_row(
        "cuda", torch.cuda.get_device_name() if torch.cuda.is_available() else "no (none is needed)"
    )
    faults = {back_end: rendering_fault(back_end) for back_end in DEBIAN_PACKAGES}
    for back_end, fault in faults.items():
        missing = f"does not work; apt-get install {DEBIAN_PACKAGES[back_end]}"
        table.add_row(f"rendering: {back_end}", "works" if fault is None else missing)
    table.add_row("films", _films(faults))
    table.add_row("cache", _folder(cache_folder(), "CLBENCH_CACHE"))
    minari = Path(os.environ.get("MINARI_DATASETS_PATH", "~/.minari/datasets")).expanduser() / "clbench"
    table.add_row("demonstrations", _folder(minari, "MINARI_DATASETS_PATH"))
    return table


def _films(faults: dict[str, str | None]) -> str:
    """Return which back end draws films, if one does."""
    chosen = os.environ.get("MUJOCO_GL")
    if chosen:
        fault = faults[chosen] if chosen in faults else rendering_fault(chosen)
        return f"{'drawn with' if fault is None else 'cannot be drawn with'} {chosen}, as MUJOCO_GL says"
    working = [back_end for back_end, fault in faults.items() if fault is None]
    if working:
        return f"drawn with {working[0]}; MUJOCO_GL chooses another"
    return "cannot be drawn until one of the above works; scores need none"


def _folder(path: Path, variable: str) -> str:
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.exists() else 0
    return f"{path} ({size / 1e6:.1f} MB; {variable} moves it)"
