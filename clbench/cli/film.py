"""The command `clbench film`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console

from clbench.base.cache import hash_of
from clbench.base.errors import InputError
from clbench.base.text import listed, megabytes
from clbench.cli.arguments import (
    MethodName,
    PolicyName,
    ScenarioId,
    Seed,
    add_cwd_to_path,
    check_names,
    checked_input,
    checked_writing,
    items_of,
    whole_number,
)
from clbench.jobs.folders import check_folders
from clbench.spec.identifiers import LONGEST_LABEL
from clbench.spec.policies import DEFAULT_POLICY

LONGEST_NAME = 120
"""Characters of a film's name before a hash; file systems take 255 bytes."""

if TYPE_CHECKING:
    from clbench.policy.policy import Policy
    from clbench.runs.spec import ResolvedRun

# PyTorch and Pillow are imported where they are needed: `--help` does not wait for them.


def film(
    scenario: ScenarioId,
    /,
    *methods: MethodName,
    seed: Seed = 0,
    order: Seed = 0,
    policy: PolicyName = DEFAULT_POLICY,
    tasks: str | None = None,
    stages: str | None = None,
    episode: Annotated[int, whole_number(0)] = 0,
    output: Path | None = None,
    size: Annotated[int, whole_number(96)] = 200,
    fps: Annotated[int | None, whole_number(1)] = None,
    checkpoints: Path | None = None,
    device: str = "cpu",
    changes: Annotated[dict[str, str] | None, Parameter(name="--set")] = None,
) -> None:
    """Film METHODS on SCENARIO: their policies side by side, from the same initial states.

    With one method, the film shows the policy after each stage; with several, before the first target and
    after the last. Methods that start from the same policy share the column before the first target. The film
    uses the policies that `clbench run` kept. If there are none, clbench trains them again, without
    evaluation.

    Args:
        scenario: Gymnasium id of the scenario.
        methods: Names of installed methods, or module:Class; at least one.
        seed: Seed of the run.
        order: Order of the targets, as for `clbench run`.
        policy: flow or discrete_diffusion; a larger size, for example flow-base (5 million parameters) or
            flow-large (40 million); or a class of your own, as module:Class.
        tasks: Names of tasks, for example press,lift (default: all retained skills and targets).
        stages: Numbers of stages, for example 0,4 (default: all stages for one method, 0 and the last for
            several). Stage 0 is before any target.
        episode: Number of the validation episode; test episodes are not filmed.
        output: A .gif or .mp4 file (default: a .gif below films/).
        size: Width of each picture in pixels.
        fps: Steps shown per second, at most 50 (default: the speed of the world).
        checkpoints: Folder below which `clbench run` kept policies.
        device: Device that ran the policies, and runs them now.
        changes: Hyper-parameters that differ from those tuned for the scenario or, without tuning, from the
            method's defaults, as --set.name value.
    """
    check_names([scenario], methods)
    from clbench.jobs.bars import Bars
    from clbench.runs.film import FASTEST, check_format, film_runs, frames_per_second
    from clbench.runs.spec import RunSpec, check_device
    from clbench.worlds.gl_backend import choose_back_end

    add_cwd_to_path()
    with checked_input():
        if not methods:
            raise InputError("Name at least one method, for example sft.")
        if fps is not None and fps > FASTEST:
            raise InputError(f"--fps must be from 1 to {FASTEST}, not {fps}.")
        check_device(device)
        first = RunSpec(scenario, "", seed, changes or {}, device, order=order, policy=policy)
        runs = [replace(first, method=name).resolve() for name in dict.fromkeys(methods)]
        loaded = runs[0].scenario
        names = None if tasks is None else items_of("--tasks", tasks)
        shown = loaded.retained + loaded.target if names is None else tuple(map(loaded.task, names))
        last = len(loaded.target)
        numbers = [0, last] if stages is None and len(runs) > 1 else _stages(stages, last)
        if episode >= loaded.budget.validation_episodes:
            last_episode = loaded.budget.validation_episodes - 1
            raise InputError(f"--episode must be from 0 to {last_episode}, not {episode}.")
        path = output or _path(runs, names, None if stages is None else numbers, episode)
        check_format(path)
        if path.is_dir():
            raise InputError(f"--output {path} is a folder: name a file.")
        check_folders({"--output": path.parent})
        choose_back_end(task.world for task in shown)
    console = Console(stderr=True)
    with checked_input():
        policies = _policies(runs, numbers, checkpoints, console)
    with Bars(len(shown) * len(policies), console) as bars:
        bars.start("film", len(shown) * len(policies))
        made = film_runs(runs, policies, shown, episode, size, lambda takes: bars.advance("film", takes))
        with checked_input(), checked_writing(path):
            made.save(path, fps or frames_per_second(shown[0]))
        width, height = made.size
        bars.finish("film", f"{path} ({width} x {height} pixels, {megabytes(path.stat().st_size)})")


def _path(
    runs: Sequence[ResolvedRun], tasks: Sequence[str] | None, stages: Sequence[int] | None, episode: int
) -> Path:
    """Return the path of a film without --output. Films of other tasks, stages or episodes have others."""
    from clbench.runs.film import FILMS

    path = runs[0].path(FILMS)
    chosen = {"tasks": tasks, "stages": stages, "episode": [episode] if episode else None}
    parts = [f"{name}={','.join(map(str, values))}" for name, values in chosen.items() if values is not None]
    methods = ",".join(run.path(FILMS).parent.name for run in runs)
    name = "+".join([path.stem, *parts])
    return path.parents[1] / _cut(methods, LONGEST_LABEL) / f"{_cut(name, LONGEST_NAME)}.gif"


def _cut(name: str, most: int) -> str:
    """Return a name, or its beginning and a hash where it has more than `most` characters."""
    return name if len(name) <= most else f"{name[:most]}+{hash_of(name)}"


def _policies(
    runs: Sequence[ResolvedRun], numbers: Sequence[int], checkpoints: Path | None, console: Console
) -> dict[str, Policy]:
    """Return the policies by the captions of their columns; equal policies before any target share one."""
    from clbench.runs.film import column_of
    from clbench.runs.stages import load_stages

    folders = _stages_folders(runs, checkpoints, console)
    stages = [load_stages(run, folder) for run, folder in zip(runs, folders, strict=True)]
    starts = _starts(runs, [one[0] for one in stages])
    columns: dict[str, Policy] = {}
    for run, policies, start in zip(runs, stages, starts, strict=True):
        for number in numbers:
            caption = column_of(run, number, alone=len(runs) == 1)
            columns.setdefault(caption if number else f"{start}{caption}", policies[number])
    return columns


def _starts(runs: Sequence[ResolvedRun], policies: Sequence[Policy]) -> list[str]:
    """Return the beginning of each run's caption before any target: the methods that start from its policy.

    It is empty if all do. Tensors that a method adds, such as adapters that are still 0, do not count.
    """
    from clbench.runs.start import starts_as_pretrained

    groups: list[list[int]] = []
    # beside its weights, `prepare` of a stranger's method may change what a policy computes
    known = [starts_as_pretrained(run) for run in runs]
    for index, policy in enumerate(policies):
        like = [one for one in groups if known[index] and known[one[0]] and _alike(policies[one[0]], policy)]
        if like:
            like[0].append(index)
        else:
            groups.append([index])
    names = {index: listed(runs[one].label for one in group) for group in groups for index in group}
    return ["" if len(groups) == 1 else f"{names[index]}, " for index in range(len(runs))]


def _alike(policy: Policy, other: Policy) -> bool:
    """Return whether two policies have the same values in the tensors that both have."""
    weights = other.state_dict()
    return all(value.equal(weights[name]) for name, value in policy.state_dict().items() if name in weights)


def _stages(text: str | None, last: int) -> list[int]:
    """Return the numbers from 0 to `last` that --stages lists; all if it was not given."""
    if text is None:
        return list(range(last + 1))
    words = items_of("--stages", text)
    if not all(word.isdecimal() and int(word) <= last for word in words):
        raise InputError(f"--stages takes numbers from 0 to {last}, not {text}.")
    return [int(word) for word in words]


def _stages_folders(runs: Sequence[ResolvedRun], checkpoints: Path | None, console: Console) -> list[Path]:
    """Return the folders of the policies of all stages of each run; missing policies are made first."""
    from clbench.jobs.plan import Plan
    from clbench.jobs.processes import Processes
    from clbench.jobs.scheduler import run_with_bars
    from clbench.runs.stages import find_stages, make_stages

    found = [find_stages(run, checkpoints) for run in runs]
    plan = Plan()
    for run, folder in zip(runs, found, strict=True):
        if folder is None:
            plan.add_stages(run, None)
    if plan.jobs and run_with_bars(plan.jobs, Processes(device=runs[0].spec.device), console):
        sys.exit(1)
    return [folder or make_stages(run) for run, folder in zip(runs, found, strict=True)]
