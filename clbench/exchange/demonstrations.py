"""Export of demonstrations to other libraries, and import of recorded ones."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from clbench.base.dependencies import require
from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.base.leftovers import unfinished
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.text import counted
from clbench.data.access import check_demonstrations
from clbench.data.demonstrations import (
    Demonstration,
    dataset_folder,
    dataset_id,
    keep_dataset,
    read_dataset,
)
from clbench.evaluation.definition import recording_of
from clbench.evaluation.views import SIZE, SimulatorCameras
from clbench.exchange.recorded import expert_of, recording_hash
from clbench.exchange.shown import steps_per_second
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

LOG = logging.getLogger("clbench")

Format = Literal["lerobot", "hdf5"]
"""Format of exported demonstrations: one LeRobotDataset, or one HDF5 file for each task."""


def export_demonstrations(
    scenario: Scenario | str,
    output: Path | str,
    *,
    format: Format,  # noqa: A002 - the word that everyone uses
    tasks: Iterable[str] = (),
    noisy: bool = True,
    pictures: Sequence[str] = (),
    picture_size: int = SIZE,
    progress: ProgressCallback = no_progress,
) -> Path:
    """Export demonstrations, which are collected on first use, and return the folder that holds them.

    A warning names the numbers of the actions that never change in the export. For `pictures`, the episodes
    are played again: they are what `clbench.serving.score.score` shows a policy with the same cameras.

    Args:
        scenario: Scenario, or its Gymnasium id.
        output: New folder.
        format: "lerobot" for one LeRobotDataset v3 of all tasks, or "hdf5" for one file per task,
            `TASK_demo.hdf5`, in the layout of robomimic and LIBERO.
        tasks: Names of tasks, or one name; if empty, the retained skills and the targets.
        noisy: Whether to export the episodes with action noise, too.
        pictures: Cameras of the simulator whose pictures to add, for example ("agentview",).
        picture_size: Height and width of these pictures in pixels.
        progress: Called with the share of the episodes that were written since its last call.

    Raises:
        InputError: The folder exists or cannot be made, a world does not give its steps per second, a task
            has no episode without action noise, or the demonstrations cannot have these pictures.
        UnknownNameError: The format or a name is unknown.
        MissingPackageError: A package is not installed.
        LeakError: The running hooks of a method must not read them.
        RenderingError: The tasks have a camera or `pictures` are asked for, and this machine cannot draw.
    """
    loaded, chosen = chosen_tasks(scenario, tasks)
    folder = check_output(output, format, chosen, pictures, picture_size)
    for task in chosen:
        check_demonstrations(task.name)
    found = {task: read_dataset(dataset_folder(task, loaded.budget)) for task in chosen}
    if not noisy:
        found = {task: _without_noise(task, episodes) for task, episodes in found.items()}
    count = sum(map(len, found.values()))
    with closing(SimulatorCameras(pictures, picture_size)) as cameras:
        fill = partial(
            _WRITERS[format],
            tasks=found,
            cameras=cameras if pictures else None,
            progress=lambda written: progress(written / count),
        )
        exported = _in_one_step(folder, fill)
    _warn_if_constant(found.values())
    return exported


def chosen_tasks(scenario: Scenario | str, tasks: Iterable[str]) -> tuple[Scenario, list[Task]]:
    """Return a scenario, and its tasks with the given names; without names, its skills and targets.

    Raises:
        UnknownNameError: A name is unknown; the nearest one is named.
    """
    loaded = load_scenario(scenario) if isinstance(scenario, str) else scenario
    names = dict.fromkeys([tasks] if isinstance(tasks, str) else tasks)
    return loaded, [loaded.task(name) for name in names] or [*loaded.retained, *loaded.target]


def check_output(
    output: Path | str,
    format: str,  # noqa: A002 - as in `export_demonstrations`
    tasks: Sequence[Task],
    pictures: Sequence[str] = (),
    picture_size: int = SIZE,
) -> Path:
    """Check the output of an export before any work starts, and return its folder.

    Raises:
        InputError: The folder exists, a world does not give its steps per second, or the demonstrations
            cannot have these pictures.
        UnknownNameError: There is no such format or camera.
        MissingPackageError: A package that the format needs is not installed.
    """
    if format not in get_args(Format):
        raise unknown("format", format, get_args(Format))
    if format == "lerobot":
        require("pyarrow", "exchange", "A LeRobotDataset")
        if pictures or any(task.camera is not None for task in tasks):
            require("PIL", "film", "A LeRobotDataset with pictures")
    for task in {task.world: task for task in tasks}.values():
        steps_per_second(task)
    if os.path.lexists(output):
        raise InputError(f"{output} already exists: name a new folder for the export.")
    with closing(SimulatorCameras(pictures, picture_size)) as cameras:
        if pictures:
            _check_replayable(tasks)
            cameras.check(tasks)
    return Path(output)


def _check_replayable(tasks: Iterable[Task]) -> None:
    """Refuse tasks whose demonstrations cannot be played again for pictures."""
    for task in tasks:
        if recording_of(task) is not None:
            raise InputError(
                f"The demonstrations of {task.name} have no pictures of the simulator's cameras: they were "
                "recorded elsewhere, and clbench does not know the scenes in which they began."
            )


def _without_noise(task: Task, episodes: Sequence[Demonstration]) -> list[Demonstration]:
    clean = [episode for episode in episodes if not episode.noisy.any()]
    if not clean:
        raise InputError(f"All {counted(len(episodes), 'demonstration')} of {task.name} have action noise.")
    return clean


def _warn_if_constant(tasks: Iterable[Sequence[Demonstration]]) -> None:
    """Warn of numbers of the actions that never change: libraries scale actions by their deviation.

    The deviation of such a number is 0, and the policy returns its mean, whatever the weights are.
    """
    actions = np.concatenate([episode.expert[:-1] for episodes in tasks for episode in episodes])
    constant = np.flatnonzero(np.ptp(actions, axis=0) == 0)
    if constant.size:
        LOG.warning(
            "These action dimensions are the same in every step of this export: %s, counted from 0. A policy "
            "that is normalised with only the statistics of this export cannot return other values: "
            "docs/guide/external.md#normalise-all-stages-alike shows what to do.",
            ", ".join(map(str, constant)),
        )


def _write_files(
    folder: Path,
    tasks: Mapping[Task, Sequence[Demonstration]],
    cameras: SimulatorCameras | None,
    progress: ProgressCallback,
) -> None:
    from clbench.exchange.hdf5 import write_hdf5

    for task, episodes in tasks.items():
        write_hdf5(folder / f"{task.name}_demo.hdf5", task, episodes, cameras, progress)


def _write_dataset(
    folder: Path,
    tasks: Mapping[Task, Sequence[Demonstration]],
    cameras: SimulatorCameras | None,
    progress: ProgressCallback,
) -> None:
    from clbench.exchange.lerobot import write_lerobot

    write_lerobot(folder, tasks, cameras, progress)


_WRITERS = {"lerobot": _write_dataset, "hdf5": _write_files}


def _in_one_step(folder: Path, fill: Callable[[Path], None]) -> Path:
    """Fill a folder, which appears only when it is complete, and return it.

    Raises:
        InputError: The folder cannot be made.
    """
    incomplete = unfinished(folder)
    try:
        incomplete.absolute().mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made: {error.strerror}.") from error
    try:
        fill(incomplete)
        return incomplete.rename(folder)
    finally:
        shutil.rmtree(incomplete, ignore_errors=True)


def import_demonstrations(
    scenario: Scenario | str, task: str, path: Path | str, *, state: Sequence[str] = ("states",)
) -> str:
    """Keep the demonstrations of an HDF5 file as the Minari dataset of a task, and return its id.

    The task must name these demonstrations in place of an expert; if it does not, the error says how. The
    definition of the scenario, which all its records hold, then says which demonstrations the task has.

    Args:
        scenario: Scenario of your own, or its Gymnasium id.
        task: Name of the task.
        path: File in the layout of robomimic and LIBERO, with one group `data/demo_i` for each demonstration.
        state: Names of the datasets of a demonstration that form, side by side, the state of the task's
            world, for example ("obs/ee_states", "obs/gripper_states"), or the name of a single dataset.

    Raises:
        InputError: The file cannot be read or does not fit the task, the task has an expert or names other
            demonstrations, or the budget of the scenario has another number of them.
        UnknownNameError: There is no such scenario or task.
    """
    from clbench.exchange.hdf5 import read_hdf5

    loaded, (chosen,) = chosen_tasks(scenario, [task])
    episodes = read_hdf5(Path(path), chosen, state)
    _check_owner(loaded, chosen, recording_hash(episodes), Path(path))
    if len(episodes) != loaded.budget.demonstrations:
        raise InputError(
            f"{path} has {counted(len(episodes), 'demonstration')}, but the budget of {loaded.id} has "
            f"{loaded.budget.demonstrations}: both must agree, because records show the budget."
        )
    keep_dataset(chosen, loaded.budget, lambda _: episodes)
    return dataset_id(chosen, loaded.budget)


def _check_owner(scenario: Scenario, task: Task, found: str, path: Path) -> None:
    """Check that a task names the demonstrations that were found in a file."""
    named = recording_of(task)
    if named == found:
        return
    how = f'expert="{expert_of(found)}"'
    if named is None:
        raise InputError(
            f"{path} fits the task {task.name} of {scenario.id}, but results of this task belong to the "
            f"demonstrations of its expert. Give a task of your own scenario {how} to learn from this file."
        )
    raise InputError(
        f"{path} holds the recording {found}, but the task {task.name} of {scenario.id} names {named}. To "
        f"learn from this file, give it {how}."
    )
