"""Side effects of code: settings of the process that it changes, and files that it writes."""

from __future__ import annotations

import os
import random
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clbench.base.cache import cache_folder
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy

_Setting = tuple[Callable[[], Any], Callable[[Any], object]]

SETTINGS: Mapping[str, _Setting] = {
    "torch.get_num_threads()": (torch.get_num_threads, torch.set_num_threads),
    "torch.get_default_dtype()": (torch.get_default_dtype, torch.set_default_dtype),
    "torch.get_default_device()": (torch.get_default_device, torch.set_default_device),
    "torch.is_grad_enabled()": (torch.is_grad_enabled, torch.set_grad_enabled),
    "torch.is_anomaly_enabled()": (torch.is_anomaly_enabled, torch.autograd.set_detect_anomaly),
    "torch.are_deterministic_algorithms_enabled()": (
        torch.are_deterministic_algorithms_enabled,
        torch.use_deterministic_algorithms,
    ),
    "torch.get_float32_matmul_precision()": (
        torch.get_float32_matmul_precision,
        torch.set_float32_matmul_precision,
    ),
    "os.environ": (lambda: dict(os.environ), lambda value: _fill(os.environ, value)),
    "os.getcwd()": (os.getcwd, os.chdir),
    "sys.path": (lambda: list(sys.path), lambda value: sys.path.__setitem__(slice(None), value)),
    # inside `warnings.catch_warnings`, which restores them
    "warnings.filters": (lambda: list(warnings.filters), lambda _: None),
    "the class clbench.Policy": (lambda: dict(vars(Policy)), lambda value: _set_attributes(Policy, value)),
    "the class of the built-in policies": (
        lambda: dict(vars(TransformerPolicy)),
        lambda value: _set_attributes(TransformerPolicy, value),
    ),
}
"""Settings of the whole process, each with a function that reads and one that restores it."""

GENERATORS: Mapping[str, _Setting] = {
    "Python's random": (random.getstate, random.setstate),
    "numpy.random": (np.random.get_state, np.random.set_state),
    "torch's random": (torch.get_rng_state, torch.set_rng_state),
}
"""The global random generators."""


def read(settings: Mapping[str, _Setting]) -> dict[str, Any]:
    """Return the current values of `settings`."""
    return {name: get() for name, (get, _) in settings.items()}


def same(one: Any, other: Any) -> bool:
    """Return whether two values are equal, including arrays and tensors inside them."""
    if isinstance(one, Tensor):
        return isinstance(other, Tensor) and torch.equal(one, other)
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


@contextmanager
def watched(found: list[str], *, generators: bool) -> Iterator[None]:
    """Add a description of the side effects of the code inside to `found`, and restore the settings.

    Args:
        found: Receives a line for each setting that differs afterwards, and for each new file outside
            clbench's cache that still exists.
        generators: Whether the global random generators count as settings.
    """
    settings = {**SETTINGS, **(GENERATORS if generators else {})}
    with warnings.catch_warnings(), _written() as paths:
        before = read(settings)
        try:
            yield
        finally:
            for name, after in read(settings).items():
                if not same(before[name], after):
                    found.append(_difference(name, before[name], after))
                    settings[name][1](before[name])
    cache = cache_folder()
    left = (path for path in dict.fromkeys(paths) if path.exists() and cache not in path.parents)
    found.extend(f"the file {path} is written" for path in left)


def _difference(name: str, before: Any, after: Any) -> str:
    """Return a description of the change of a setting."""
    if isinstance(before, dict):
        keys = [key for key in {**before, **after} if before.get(key) != after.get(key)]
        return f"{name} differs in {', '.join(sorted(keys))}"
    if isinstance(before, list):
        entries = [str(one) for one in after + before if (one in before) != (one in after)]
        return f"{name} differs in {', '.join(entries) or 'its order'}"
    if name in GENERATORS:
        return f"{name} generator was moved or set"
    return f"{name} is {after}, was {before}"


def _fill(mapping: Any, values: Mapping[str, str]) -> None:
    mapping.clear()
    mapping.update(values)


def _set_attributes(cls: type, values: Mapping[str, Any]) -> None:
    for name in set(vars(cls)) - set(values):
        delattr(cls, name)
    for name, value in values.items():
        if vars(cls).get(name) is not value:
            setattr(cls, name, value)


# ---- files -------------------------------------------------------------------------------------------------

_recording: tuple[int, list[Path]] | None = None
"""Id of the thread whose opened files are recorded, and the list of these files."""
_hooked = False


@contextmanager
def _written() -> Iterator[list[Path]]:
    """Record the files that Python opens for writing inside; files of compiled libraries are missed."""
    global _recording, _hooked
    if not _hooked:  # an audit hook stays until the process ends
        sys.addaudithook(_audit)
        _hooked = True
    outer, paths = _recording, list[Path]()
    _recording = threading.get_ident(), paths
    try:
        yield paths
    finally:
        _recording = outer


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    if event != "open" or _recording is None or _recording[0] != threading.get_ident():
        return
    path, _, flags = arguments
    if isinstance(path, str | bytes | os.PathLike) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        _recording[1].append(Path(os.fsdecode(path)).absolute())
