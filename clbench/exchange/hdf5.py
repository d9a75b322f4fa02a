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
from itertools import pairwise
from numbers import Real
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.text import counted, did_you_mean, quoted
from clbench.data.demonstrations import Demonstration
from clbench.evaluation.views import SimulatorCameras
from clbench.exchange.shown import shown, steps_per_second
from clbench.spec.language import LENGTHS, UnknownWordError, word_ids
from clbench.spec.task import Task
from clbench.worlds.lanes import control_rate
from clbench.worlds.world import World

GYM = 2
"""Number of Gym environments among robomimic's `EnvType`."""

FARTHEST_RATE = 0.01
"""Largest relative difference between the control rates of a file and of a world: rates are often rounded."""

_NAME = re.compile(r"demo_([0-9]+)")

MOST_NUMBERS = 10_000_000
"""Most numbers of a dataset to read. 1,000 steps of 100 numbers are 0.1 million; 60 kB can claim billions."""

_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError)
"""Errors that h5py raises where the bytes of a file make no sense."""


# ---- out ---------------------------------------------------------------------------------------------------


def write_hdf5(
    path: Path,
    task: Task,
    episodes: Sequence[Demonstration],
    cameras: SimulatorCameras | None = None,
    progress: ProgressCallback = no_progress,
) -> None:
    """Write the demonstrations of a task to an HDF5 file.

    Args:
        path: The file, which must not exist.
        task: Task of the demonstrations.
        episodes: The demonstrations.
        cameras: Cameras of the simulator whose pictures to add, named as in robomimic; None adds none.
        progress: Called with the number of episodes written since its last call.

    Raises:
        InputError: The world of the task does not give its steps per second, or an episode cannot be played
            again.
        RenderingError: The task has a camera or `cameras` are given, and this machine cannot draw.
    """
    with h5py.File(path, "x") as file:
        data = file.create_group("data")
        data.attrs.update(_attributes(task, episodes))
        for number, one in enumerate(shown(task, episodes, cameras)):
            episode, group = one.episode, data.create_group(f"demo_{number}")
            group.attrs["num_samples"] = len(episode.executed)
            group["actions"], group["executed"] = episode.expert[:-1], episode.executed
            group["states"], group["rewards"] = episode.state[:-1], episode.reward
            group["dones"] = _dones(episode)
            group["noisy"] = episode.noisy[:-1]
            group["final_state"], group["final_action"] = episode.state[-1], episode.expert[-1]
            group["obs/state"] = one.state
            pictures = {f"obs/{name}_image": pictures for name, pictures in one.pictures.items()}
            if one.image.size:
                pictures["obs/image"] = one.image
            for name, values in pictures.items():
                group.create_dataset(name, data=values, compression="gzip")
            progress(1)


def _dones(episode: Demonstration) -> NDArray[np.uint8]:
    """Return 1 for a last step that ended in success, else 0, (T,)."""
    dones = np.zeros(len(episode.executed), np.uint8)
    dones[-1] = episode.success
    return dones


def _attributes(task: Task, episodes: Sequence[Demonstration]) -> dict[str, Any]:
    """Return the attributes of the group `data`."""
    kwargs = {"world": task.world, "task": task.name, "control_freq": steps_per_second(task)}
    return {
        "total": sum(len(episode.executed) for episode in episodes),
        "num_demos": len(episodes),
        "env_args": json.dumps({"env_name": task.environment_id, "type": GYM, "env_kwargs": kwargs}),
        "problem_info": json.dumps({"language_instruction": task.instructions[0]}),
        "instructions": json.dumps(task.instructions),
        "expert": task.expert,
        "clbench_version": version("clbench"),
    }


# ---- in ----------------------------------------------------------------------------------------------------


def read_hdf5(path: Path, task: Task, state: Sequence[str] = ("states",)) -> list[Demonstration]:
    """Return the demonstrations in an HDF5 file, which must fit a task.

    A file from elsewhere has no final state and no final action. They become NaN; no policy learns from them.

    Args:
        path: The file.
        task: Task whose world, horizon and instructions the demonstrations must fit.
        state: Names of the datasets of a demonstration that form, side by side, the state of the world (S,),
            or the name of a single dataset.

    Raises:
        InputError: The file cannot be read, has another layout, or does not fit the task. The message names
            the demonstration and the dataset.
    """
    state = [state] if isinstance(state, str) else state
    if not state or any(not name or name.startswith("/") for name in state):
        raise InputError(
            "The state must name datasets of a demonstration, such as states or obs/ee_states, not "
            f"{list(state)}."
        )
    _check_readable(path)
    with closing(resolve(task.world)()) as world:
        try:
            with h5py.File(path, "r") as file:
                found = _File(path, file, task, world, state)
                episodes = found.demonstrations()
        except InputError:  # a ValueError, too
            raise
        except _DAMAGE as error:
            raise InputError(f"{path} cannot be read as HDF5: it is damaged ({error}).") from error
    found.check_rate()
    return episodes


def _check_readable(path: Path) -> None:
    """Check that a path is a readable file: HDF5's own error would show flags and addresses."""
    try:
        if (path / "meta" / "info.json").is_file():
            raise InputError(
                f"{path} is a LeRobotDataset, which clbench cannot read: write its episodes to an HDF5 file, "
                "as data/demo_0 and so on."
            )
        if path.is_dir():
            raise InputError(f"{path} is a folder, not an HDF5 file.")
        path.open("rb").close()
    except FileNotFoundError as error:
        raise InputError(f"There is no file {path}.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _is_own_group(data: h5py.Group, name: str) -> bool:
    """Return whether an entry is a group in this place, not a link to another one."""
    is_here = isinstance(data.get(name, getlink=True), h5py.HardLink)
    return is_here and data.get(name, getclass=True) is h5py.Group


class _File:
    """An HDF5 file that is read for a task."""

    def __init__(self, path: Path, file: h5py.File, task: Task, world: World, state: Sequence[str]) -> None:
        self._path, self._file, self._task, self._names = path, file, task, tuple(state)
        self._rate: float | None = None
        self._states, self._actions = world.observation_space, world.action_space
        self._convert = getattr(getattr(world, "vector_world", None), "recorded_states", None)

    def demonstrations(self) -> list[Demonstration]:
        """Return all demonstrations, in the order of their numbers."""
        data = self._file.get("data")
        names = data if isinstance(data, h5py.Group) else ()
        found = sorted((int(one[1]), name) for name in names if (one := _NAME.fullmatch(name)) is not None)
        if not found:
            there = ", ".join(sorted([f"data/{name}" for name in names] or self._file)[:5]) or "nothing"
            raise self._error(
                f"it has no demonstrations: the layout of robomimic and LIBERO has data/demo_0, found {there}"
            )
        others = sorted(name for name in names if _NAME.fullmatch(name) is None and _is_own_group(data, name))
        if others:
            raise self._error(
                f"data also holds {', '.join(others[:5])}: rename each to demo_ and its number, or remove it"
            )
        for (number, name), (following, other) in pairwise(found):
            if number == following:
                raise self._error(f"data has both {name} and {other}: each number may occur once")
        self._check_attributes(data)
        self._check_count(data, "num_demos", "data", len(found), counted(len(found), "demonstration"))
        episodes = [self._demonstration(data, name) for _, name in found]
        steps = sum(len(episode.executed) for episode in episodes)
        self._check_count(data, "total", "data", steps, f"its demonstrations have {counted(steps, 'step')}")
        return episodes

    def _check_attributes(self, data: h5py.Group) -> None:
        """Check the instruction or the name of the task, and read the control rate, where they are given."""
        words = _json(data.attrs.get("problem_info")).get("language_instruction") or []
        parts = words if isinstance(words, list) else [words]
        if not all(isinstance(part, str) for part in parts):
            raise self._error(
                f"language_instruction in problem_info must be a string, not {quoted(str(words))}"
            )
        words = "".join(parts)  # LIBERO joins it, too
        # LIBERO's files name the task, and have words of their own ("open the middle layer of the drawer")
        is_named = PurePosixPath(str(data.attrs.get("bddl_file_name"))).stem == self._task.name
        if parts and not is_named and not self._is_instruction(words):
            raise self._error(
                f"its instruction is {quoted(words)}, which the task {self._task.name} does not have: add it "
                f"to the instructions of the task if it means the same. It has {self._task.instructions}"
            )
        kwargs = _json(data.attrs.get("env_args")).get("env_kwargs")
        rate = kwargs.get("control_freq") if isinstance(kwargs, dict) else None
        self._rate = float(rate) if isinstance(rate, int | float) else None

    def check_rate(self) -> None:
        """Check the control rate that the file gives, if any. The world must run, with errors of its own."""
        if (rate := self._rate) is None:
            return
        own = control_rate(self._task)
        if own is not None and not abs(rate - own) <= FARTHEST_RATE * own:  # also if it is NaN
            raise self._error(
                f"it was recorded at {rate:g} steps per second, but the world {self._task.world} makes "
                f"{own:g}: each action would last a different time"
            )

    def _is_instruction(self, words: str) -> bool:
        """Return whether the task has an instruction, as a policy reads it: without case and punctuation."""
        try:
            found = word_ids([words], LENGTHS[-1])
        except UnknownWordError:
            return False
        return any(found == word_ids([one], LENGTHS[-1]) for one in self._task.instructions)

    def _demonstration(self, data: h5py.Group, name: str) -> Demonstration:
        group, where = data.get(name), f"data/{name}"
        if not isinstance(group, h5py.Group):
            raise self._error(f"{where} must be a group, not another object or a broken link")
        expert = self._rows(group, "actions", where)
        steps = len(expert)
        if not 1 <= steps <= self._task.horizon:
            raise self._error(
                f"{where} has {counted(steps, 'step')}: it must have 1 to {self._task.horizon}, the "
                f"horizon of the task {self._task.name}"
            )
        self._check_count(group, "num_samples", where, steps, f"{counted(steps, 'row')} of actions")
        executed = self._rows(group, "executed", where, steps) if "executed" in group else expert
        parts = [self._rows(group, one, where, steps) for one in self._names]
        states = self._converted(np.concatenate(parts, axis=1), group, where)
        rewards = self._column(group, "rewards", where, steps)
        noisy = self._column(group, "noisy", where, steps) if "noisy" in group else np.zeros(steps)
        if not self._column(group, "dones", where, steps)[-1]:
            raise self._error(f"{where} does not end in success: the last of its dones is 0")
        for what, values, space in (
            ("actions", expert, self._actions),
            ("executed", executed, self._actions),
            (" and ".join(self._names), states, self._states),
        ):
            self._check_range(f"{where}/{what}", values, space)
        return Demonstration(
            np.vstack([states, self._final(group, "final_state", where, self._states)]).astype(np.float32),
            executed.astype(np.float32),
            np.vstack([expert, self._final(group, "final_action", where, self._actions)]).astype(np.float32),
            np.append(noisy != 0, False),
            rewards.astype(np.float64),
            True,
        )

    def _converted(self, states: NDArray[Any], group: h5py.Group, where: str) -> NDArray[Any]:
        """Return the states as the world has them; it may convert the `states` in files of its original."""
        if self._convert is None or self._names != ("states",) or states.shape[1:] == self._states.shape:
            return states
        model = group.attrs.get("model_file")
        try:
            converted: NDArray[Any] = self._convert(self._task.name, states, model)
        except InputError as error:
            raise self._error(
                f"{where}/states is neither a state of the world {self._task.world} nor one of its original: "
                f"{error}"
            ) from error
        except Exception as error:  # else it would count as damage of the file
            what = f"{type(error).__name__}: {error}"
            raise self._error(
                f"the world {self._task.world} cannot convert {where}/states ({what})"
            ) from error
        return converted

    def _check_count(self, group: h5py.Group, name: str, where: str, count: int, found: str) -> None:
        """Check a number in the attributes of a group, where the file gives it."""
        number = group.attrs.get(name, count)
        if not isinstance(number, Real):
            raise self._error(f"{name} of {where} must be a whole number, not {quoted(str(number))}")
        if number != count:
            raise self._error(f"{where} has {name} {number}, but {found}")

    def _rows(self, group: h5py.Group, name: str, where: str, steps: int | None = None) -> NDArray[Any]:
        """Return a dataset with one row of numbers for each step, (T, N)."""
        return self._steps(group, name, where, ("T", "N"), steps)

    def _column(self, group: h5py.Group, name: str, where: str, steps: int) -> NDArray[Any]:
        """Return a dataset with one number for each step, (T,)."""
        return self._steps(group, name, where, ("T",), steps)

    def _steps(
        self, group: h5py.Group, name: str, where: str, axes: tuple[str, ...], steps: int | None
    ) -> NDArray[Any]:
        """Return a dataset with a row for each step."""
        values = self._numbers(group, name, where, axes)
        if steps is not None and len(values) != steps:
            raise self._error(f"{where}/{name} has {len(values)} rows, but there are {steps} actions")
        if not np.isfinite(values).all():
            raise self._error(f"{where}/{name} holds numbers that are not finite")
        return values

    def _numbers(self, group: h5py.Group, name: str, where: str, axes: tuple[str, ...]) -> NDArray[Any]:
        """Return a dataset of numbers with the given axes, which the message names."""
        if not (name in group and isinstance(group[name], h5py.Dataset)):
            known: list[str] = []
            group.visititems(lambda key, one: known.append(key) if isinstance(one, h5py.Dataset) else None)
            raise self._error(f"{where} has no {name!r}.{did_you_mean(name, known)} It has {sorted(known)}")
        found = group[name]
        if found.ndim != len(axes) or found.dtype.kind not in "biuf":
            shape = str(axes).replace("'", "")
            raise self._error(f"{where}/{name} must be numbers {shape}, not {found.dtype} {found.shape}")
        if found.file.filename != self._file.filename or found.external or found.is_virtual:
            raise self._error(f"{where}/{name} has its numbers in another file: copy them into this one")
        if found.size > MOST_NUMBERS:
            raise self._error(f"{where}/{name} has {found.size:,} numbers; the limit is {MOST_NUMBERS:,}")
        return np.asarray(found)

    def _final(self, group: h5py.Group, name: str, where: str, space: Any) -> NDArray[Any]:
        """Return the row after the last step, NaN if it is missing."""
        missing = np.full(space.shape, np.nan, np.float32)
        if name not in group:
            return missing
        values = self._numbers(group, name, where, ("N",))
        if values.shape == space.shape and np.isnan(values).all():
            return missing
        self._check_range(f"{where}/{name}", values[None], space)
        return values

    def _check_range(self, what: str, values: NDArray[Any], space: Any) -> None:
        """Check that rows of numbers have the width and the range of a space of the world."""
        if values.shape[1:] != space.shape:
            raise self._error(
                f"the width of {what} is {values.shape[1]}, but the world {self._task.world} needs "
                f"{space.shape[0]}"
            )
        with np.errstate(over="ignore"):
            kept = values.astype(np.float32)
        outside = ~np.isfinite(kept) | (kept < space.low) | (kept > space.high)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            raise self._error(
                f"row {row}, column {column} of {what} is {values[row, column]:.9g}: the world "
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
