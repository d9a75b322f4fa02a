"""The command `clbench film`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from clbench.base.errors import InputError
from clbench.cli.arguments import add_cwd_to_path, at_least, checked_input
from clbench.jobs.bars import Bars
from clbench.jobs.plan import stages_jobs
from clbench.jobs.processes import Processes
from clbench.jobs.scheduler import run_with_bars
from clbench.runs.checkpoints import find_stages, load_stages, make_stages
from clbench.runs.film import FASTEST, FILMS, check_format, film_run, steps_per_second
from clbench.runs.spec import RunSpec, check_device, read_changes
from clbench.spec.registry import load_scenario
from clbench.worlds.gl_backend import choose_back_end


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
        episode: Which validation episode; those of the report are not filmed.
        output: A .gif or .mp4 file; if not given, a .gif below films/.
        size: Width of each picture in pixels.
        fps: Steps shown in a second; as in the simulated world if not given.
        checkpoints: Folder below which `clbench run` kept policies.
        device: Where the policies were computed, and are.
        changes: Hyper-parameters that differ from the method's own, as --set.name value.
    """
    add_cwd_to_path()
    with checked_input():
        at_least(0, "--seed", seed)
        at_least(96, "--size", size)
        if fps is not None and not 1 <= fps <= FASTEST:
            raise InputError(f"--fps must be from 1 to {FASTEST}, not {fps}.")
        check_device(device)
        loaded = load_scenario(scenario)
        spec = RunSpec(scenario, method, seed, read_changes(method, changes or {}), device)
        shown = [loaded.task(name) for name in tasks.split(",")] if tasks else loaded.retained + loaded.target
        numbers = _numbers("--stages", stages, len(loaded.target))
        (episode,) = _numbers("--episode", str(episode), loaded.budget.validation_episodes - 1)
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
        raise InputError(f"{option} has numbers from 0 to {last}, not {text}.")
    return [int(word) for word in words]


def _stages_folder(spec: RunSpec, checkpoints: Path | None, console: Console) -> Path:
    """Return where the policies of all stages of a run lie; what is missing is made first."""
    found = find_stages(spec, checkpoints)
    if found is not None:
        return found
    if run_with_bars(stages_jobs([spec], None), Processes(), console):
        sys.exit(1)
    return make_stages(spec)
