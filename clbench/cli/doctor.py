"""The command `clbench doctor`."""

from __future__ import annotations

import os
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table


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
