"""The experts of the dm_control world: small networks trained with SAC, read from files without code."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from clbench.base.entry_points import unknown
from clbench.base.errors import ClbenchError, InputError
from clbench.base.strict_json import StrictJSONError, read_json

from .rules import RULES
from .state import ACTION_SIZE, Observation, State

FOLDER = Path(__file__).parent / "weights"
"""Folder of the experts that are part of the project."""

Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Weights (out, in) and biases (out,)."""


class ExpertError(ClbenchError):
    """The files of an expert are unusable; the message gives the reason, and says how to get new ones."""


@dataclass(frozen=True)
class Expert:
    """A policy without memory: the mean action of a SAC actor, squashed by tanh."""

    layers: tuple[Layer, ...]
    """Layers from the observation to the action, with rectifiers between them."""

    def act(self, observation: Observation | NDArray[np.float32]) -> NDArray[np.float32]:
        """Map an observation (K,) of the body to an action (A,) of its motors, in [-1, 1]."""
        values = observation.astype(np.float32)
        for weight, bias in self.layers[:-1]:
            values = np.maximum(weight @ values + bias, np.float32(0))
        weight, bias = self.layers[-1]
        action: NDArray[np.float32] = np.tanh(weight @ values + bias)
        return action

    def __call__(self, state: State) -> NDArray[np.float32]:
        """Map a state (19,) to an action (2,), with zero where the body has no motor."""
        action = np.zeros(ACTION_SIZE, np.float32)
        moved = self.act(state[: self.layers[0][0].shape[1]])
        action[: len(moved)] = moved
        return action

    def to_bytes(self) -> bytes:
        """Return the content of a safetensors file; equal weights give equal bytes."""
        return save(
            {
                f"{number}.{name}": np.ascontiguousarray(values)
                for number, layer in enumerate(self.layers)
                for name, values in zip(("weight", "bias"), layer, strict=True)
            }
        )


def expert(task: str) -> Expert:
    """Return the task's expert that is part of the project.

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
        ExpertError: The expert's files are missing or damaged, or belong to another task.
    """
    if task not in RULES:
        raise unknown("expert of the dm_control world", task, RULES)
    return _shipped(task)[0]


def expert_return(task: str) -> float:
    """Return the mean return of the expert's episodes, which defines success.

    Raises:
        ExpertError: The expert's files are missing or damaged, or belong to another task.
    """
    return _shipped(task)[1]


@functools.cache
def _shipped(task: str) -> tuple[Expert, float]:
    return read_expert(FOLDER, task)


def read_expert(folder: Path, task: str) -> tuple[Expert, float]:
    """Return the task's expert in `folder` and the mean return of its episodes.

    Raises:
        ExpertError: The expert's files are missing or damaged, or belong to another task.
    """
    weights, card = folder / f"{task}.safetensors", folder / f"{task}.json"
    way_out = f"`clbench experts train {task}` makes it; if it came with clbench, reinstall clbench."
    try:
        said = read_json(card)
        content = weights.read_bytes()
        if said["task"] != task:
            raise InputError(f"belongs to the task {said['task']!r}")
        if hashlib.sha256(content).hexdigest() != said["sha256"]:
            raise InputError("has another hash than its JSON states")
        layers = _layers(load(content), tuple(said["sizes"]))
        mean = float(said["return"])
    except (OSError, KeyError, TypeError, ValueError, SafetensorError, StrictJSONError) as error:
        raise ExpertError(f"The expert {weights} cannot be used ({error}). {way_out}") from error
    return Expert(layers), mean


def _layers(tensors: dict[str, NDArray[np.float32]], sizes: Sequence[int]) -> tuple[Layer, ...]:
    """Return the layers of a network.

    Args:
        tensors: Weights and biases by name.
        sizes: Number of values at the input and after each layer.

    Raises:
        InputError: The tensors do not belong to a network of these sizes, or are not finite.
    """
    expected: dict[str, tuple[int, ...]] = {}
    for number, (width, height) in enumerate(itertools.pairwise(sizes)):
        expected |= {f"{number}.weight": (height, width), f"{number}.bias": (height,)}
    found = {name: values.shape for name, values in tensors.items()}
    if found != expected or any(values.dtype != np.float32 for values in tensors.values()):
        raise InputError(f"has tensors {found} where float32 of {expected} are expected")
    if not all(np.isfinite(values).all() for values in tensors.values()):
        raise InputError("contains values that are not finite")
    return tuple((tensors[f"{number}.weight"], tensors[f"{number}.bias"]) for number in range(len(sizes) - 1))
