"""Demonstrations as HDF5 files in the layout of robomimic and LIBERO, one file for each task.

`data/demo_i` holds `actions` (T, A), `states` (T, S), `rewards` (T,), `dones` (T,) and `obs/*`. The files of
clbench add what the layout has no place for: the actions that were `executed` where action noise replaced the
expert's, `noisy` (T,), and the `final_state` and `final_action` after the last step.

Sources: https://robomimic.github.io/docs/datasets/overview.html, and the files of
https://libero-project.github.io/datasets.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.base.text import counted, did_you_mean, quoted
from clbench.data.demonstrations import Demonstration
from clbench.exchange.shown import shown, steps_per_second
from clbench.spec.task import Task
from clbench.worlds.world import World

GYM = 2
"""Number of Gym environments among robomimic's `EnvType`."""

FARTHEST_RATE = 0.01
"""Largest relative difference between the control rates of a file and of a world: rates are often rounded."""

_NAME = re.compile(r"demo_([0-9]+)")


# ---- out ---------------------------------------------------------------------------------------------------


def write_hdf5(path: Path, task: Task, episodes: Sequence[Demonstration]) -> None:
    """Write the demonstrations of a task to an HDF5 file.

    Args:
        path: The file, which must not exist.
        task: Task of the demonstrations.
        episodes: The demonstrations.

    Raises:
        InputError: The world of the task does not give its steps per second.
        RenderingError: The task has a camera, and no back end of this machine can draw.
    """
    with h5py.File(path, "x") as file:
        data = file.create_group("data")
        data.attrs.update(_attributes(task, episodes))
        for number, one in enumerate(shown(task, episodes)):
            episode, group = one.episode, data.create_group(f"demo_{number}")
            group.attrs["num_samples"] = len(episode.executed)
            group["actions"], group["executed"] = episode.expert[:-1], episode.executed
            group["states"], group["rewards"] = episode.state[:-1], episode.reward
            group["dones"] = _dones(episode)
            group["noisy"] = episode.noisy[:-1]
            group["final_state"], group["final_action"] = episode.state[-1], episode.expert[-1]
            group["obs/state"] = one.state
            if one.image.size:
                group.create_dataset("obs/image", data=one.image, compression="gzip")


def _dones(episode: Demonstration) -> NDArray[np.uint8]:
    """Return 1 for a last step that ended in success, else 0, (T,)."""
    dones = np.zeros(len(episode.executed), np.uint8)
    dones[-1] = episode.success
    return dones


def _attributes(task: Task, episodes: Sequence[Demonstration]) -> dict[str, Any]:
    """Return the attributes of the group `data`."""
    kwargs = {"world": task.world, "task": task.name, "control_freq": steps_per_second(task)}
    name = f"clbench/{task.suite}.{task.name}-v{task.version}"
    return {
        "total": sum(len(episode.executed) for episode in episodes),
        "num_demos": len(episodes),
        "env_args": json.dumps({"env_name": name, "type": GYM, "env_kwargs": kwargs}),
        "problem_info": json.dumps({"language_instruction": task.instructions[0]}),
        "instructions": json.dumps(task.instructions),
        "expert": task.expert,
        "clbench_version": version("clbench"),
    }


# ---- in ----------------------------------------------------------------------------------------------------


def read_hdf5(path: Path, task: Task, state: Sequence[str] = ("states",)) -> list[Demonstration]:
    """Return the demonstrations in an HDF5 file, which must fit a task.

    A file of others has no final state and no final action: they are NaN, and no policy learns from them.

    Args:
        path: The file.
        task: Task whose world, horizon and instructions the demonstrations must fit.
        state: Datasets of each demonstration that make, side by side, the state of the world (S,).

    Raises:
        InputError: The file cannot be read, has another layout, or does not fit the task. The message names
            the demonstration and the dataset.
    """
    try:
        with h5py.File(path, "r") as file, closing(resolve(task.world)()) as world:
            return _File(path, file, task, world, state).demonstrations()
    except OSError as error:
        raise InputError(f"{path} cannot be read as HDF5: {error}.") from error


class _File:
    """An HDF5 file that is read for a task."""

    def __init__(self, path: Path, file: h5py.File, task: Task, world: World, state: Sequence[str]) -> None:
        self._path, self._file, self._task, self._names = path, file, task, tuple(state)
        self._states, self._actions = world.observation_space, world.action_space
        self._rate = world.metadata.get("render_fps")

    def demonstrations(self) -> list[Demonstration]:
        """Return all demonstrations, in the order of their numbers."""
        data = self._file.get("data")
        found = data if isinstance(data, h5py.Group) else ()
        names = {int(one[1]): name for name in found if (one := _NAME.fullmatch(name)) is not None}
        if not names:
            raise self._error("it has no demonstrations: the layout of robomimic and LIBERO has data/demo_0")
        self._check_attributes(data)
        episodes = [self._demonstration(data, names[number]) for number in sorted(names)]
        steps, total = sum(len(episode.executed) for episode in episodes), data.attrs.get("total")
        if total is not None and int(total) != steps:
            raise self._error(f"data has total {total}, but its demonstrations have {steps} steps")
        return episodes

    def _check_attributes(self, data: h5py.Group) -> None:
        """Check the instruction and the control rate, where the file gives them."""
        words = _json(data.attrs.get("problem_info")).get("language_instruction")
        words = "".join(words) if isinstance(words, list) else words  # LIBERO joins it, too
        if isinstance(words, str) and words.strip('" \n') not in self._task.instructions:
            raise self._error(
                f"its instruction is {quoted(words)}, which the task {self._task.name} does not have: add it "
                f"to the instructions of the task if it means the same. It has {self._task.instructions}"
            )
        kwargs = _json(data.attrs.get("env_args")).get("env_kwargs")
        rate = kwargs.get("control_freq") if isinstance(kwargs, dict) else None
        if not isinstance(rate, int | float) or self._rate is None:
            return
        if abs(rate - self._rate) > FARTHEST_RATE * self._rate:
            raise self._error(
                f"it was recorded at {rate:g} steps per second, but the world {self._task.world} makes "
                f"{self._rate:g}: an action would last another time"
            )

    def _demonstration(self, data: h5py.Group, name: str) -> Demonstration:
        group, where = data[name], f"data/{name}"
        expert = self._rows(group, "actions", where)
        steps = len(expert)
        if not 1 <= steps <= self._task.horizon:
            raise self._error(
                f"{where} has {counted(steps, 'step')}, but the task {self._task.name} ends after "
                f"{self._task.horizon}"
            )
        samples = group.attrs.get("num_samples", steps)
        if int(samples) != steps:
            raise self._error(f"{where} has num_samples {samples}, but {steps} rows of actions")
        executed = self._rows(group, "executed", where, steps) if "executed" in group else expert
        parts = [self._rows(group, one, where, steps) for one in self._names]
        states, rewards = np.concatenate(parts, axis=1), self._column(group, "rewards", where, steps)
        noisy = self._column(group, "noisy", where, steps) if "noisy" in group else np.zeros(steps)
        if not self._column(group, "dones", where, steps)[-1]:
            raise self._error(f"{where} does not end in success: the last of its dones is 0")
        for what, values, space in (
            ("actions", expert, self._actions),
            ("executed", executed, self._actions),
            (" and ".join(self._names), states, self._states),
        ):
            self._check_range(f"{where}: {what}", values, space)
        return Demonstration(
            np.vstack([states, self._final(group, "final_state", where, states)]).astype(np.float32),
            executed.astype(np.float32),
            np.vstack([expert, self._final(group, "final_action", where, expert)]).astype(np.float32),
            np.append(noisy != 0, False),
            rewards.astype(np.float64),
            True,
        )

    def _rows(self, group: Any, name: str, where: str, steps: int | None = None) -> NDArray[Any]:
        """Return a dataset with one row of numbers for each step, (T, N)."""
        return self._dataset(group, name, where, 2, steps)

    def _column(self, group: Any, name: str, where: str, steps: int) -> NDArray[Any]:
        """Return a dataset with one number for each step, (T,)."""
        return self._dataset(group, name, where, 1, steps)

    def _dataset(self, group: Any, name: str, where: str, axes: int, steps: int | None) -> NDArray[Any]:
        known: list[str] = []
        if isinstance(group, h5py.Group):
            group.visititems(lambda key, one: known.append(key) if isinstance(one, h5py.Dataset) else None)
        if name not in known:
            raise self._error(f"{where} has no {name!r}.{did_you_mean(name, known)} It has {sorted(known)}")
        values = np.asarray(group[name])
        if values.ndim != axes or values.dtype.kind not in "biuf":
            shape = "(T,)" if axes == 1 else "(T, N)"
            raise self._error(f"{where}/{name} must be numbers {shape}, not {values.dtype} {values.shape}")
        if steps is not None and len(values) != steps:
            raise self._error(f"{where}/{name} has {len(values)} rows, but there are {steps} actions")
        if not np.isfinite(values).all():
            raise self._error(f"{where}/{name} holds numbers that are not finite")
        return values

    def _final(self, group: h5py.Group, name: str, where: str, rows: NDArray[Any]) -> NDArray[Any]:
        """Return the row after the last step, NaN if the file has none."""
        if name not in group:
            return np.full(rows.shape[1], np.nan, np.float32)
        values = np.asarray(group[name])
        if values.shape != rows.shape[1:]:
            raise self._error(f"{where}/{name} has the shape {values.shape}, not {rows.shape[1:]}")
        return values

    def _check_range(self, what: str, values: NDArray[Any], space: Any) -> None:
        """Check that rows of numbers have the width and the range of a space of the world."""
        if values.shape[1:] != space.shape:
            raise self._error(
                f"{what} have the width {values.shape[1]}, but the world {self._task.world} needs "
                f"{space.shape[0]}"
            )
        with np.errstate(over="ignore"):
            kept = values.astype(np.float32)
        outside = ~np.isfinite(kept) | (kept < space.low) | (kept > space.high)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            raise self._error(
                f"{what} hold {values[row, column]:g} in row {row}, column {column}: the world "
                f"{self._task.world} takes float32 numbers from {space.low[column]:g} to "
                f"{space.high[column]:g}"
            )

    def _error(self, fault: str) -> InputError:
        return InputError(f"{self._path}: {fault}.")


def _json(text: Any) -> dict[str, Any]:
    """Return the dictionary in an attribute, empty if it holds none."""
    try:
        found = json.loads(text)
    except (TypeError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
