"""Side effects of code: settings of the process that it changes, files that it writes, global variables."""

from __future__ import annotations

import contextlib
import copy
import inspect
import os
import random
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from clbench.base.cache import cache_folder
from clbench.base.source import names_in, package_of
from clbench.learning.hooks import functions_of, own_classes
from clbench.learning.method import Method
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
    # torch.get_float32_matmul_precision() raises an error after this was set
    "torch.backends.cuda.matmul.fp32_precision": (
        lambda: torch.backends.cuda.matmul.fp32_precision,
        lambda value: setattr(torch.backends.cuda.matmul, "fp32_precision", value),
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

BY_IMPORTS = ("os.environ", "sys.path", "warnings.filters", "the file ", "the folder ")
"""Beginnings of the descriptions of changes that the import of a package may make, too, once in a process."""

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
    """Return whether two values are equal; they may be arrays and tensors, alone or in tuples.

    In a tensor, NaN equals NaN.
    """
    if isinstance(one, Tensor):
        if not isinstance(other, Tensor) or (one.shape, one.dtype) != (other.shape, other.dtype):
            return False
        return bool(((one == other) | ((one != one) & (other != other))).all())
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


@contextmanager
def watched(found: list[str], *, generators: bool) -> Iterator[None]:
    """Add descriptions of the side effects of the block to `found`, and restore the settings.

    Args:
        found: Receives a line for each setting that differs afterwards, and for each file or folder outside
            clbench's cache that was written and still exists.
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
    for path in dict.fromkeys(paths):
        # /dev/null, which silences a library, is no regular file; imports write to __pycache__
        kind = "file" if path.is_file() else "folder" if path.is_dir() else None
        if kind and cache not in (path, *path.parents) and "__pycache__" not in path.parts:
            found.append(f"the {kind} {path} is written")


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


# ---- memory outside of objects -----------------------------------------------------------------------------


@contextmanager
def forgetting(cls: type[Method]) -> Iterator[Callable[[], None]]:
    """Yield a function that resets what a method keeps outside of its objects, as a new process would.

    It resets the attributes of the class, and the global variables of the class's package that its functions
    use, to copies of their values at the start. Values that cannot be copied stay as they are. At the end
    each variable holds the object that it held at the start.
    """
    places: list[tuple[Any, set[str] | None]] = [(one, None) for one in own_classes(cls)]
    places += [(sys.modules[module], names) for module, names in _used_globals(cls).items()]
    start = [_variables(owner, names) for owner, names in places]
    copies = [_copied(values) for values in start]

    def reset(values: list[dict[str, Any]]) -> None:
        for (owner, names), known, wanted in zip(places, start, values, strict=True):
            for name in _variables(owner, names).keys() - known.keys():
                delattr(owner, name)
            for name, value in wanted.items():
                if vars(owner).get(name) is not value:
                    setattr(owner, name, value)

    try:
        yield lambda: reset([_copied(values) for values in copies])
    finally:
        reset(start)


def _used_globals(cls: type[Method]) -> dict[str, set[str]]:
    """Return the names that a method's functions use, by module, also via functions of its package."""
    found: dict[str, set[str]] = {}
    pending = [function for one in own_classes(cls) for function in functions_of(one).values()]
    packages = {package_of(one.__module__) for one in own_classes(cls)}
    seen: set[FunctionType] = set()
    while pending:
        function = pending.pop()
        module = sys.modules.get(function.__module__)
        if function in seen or module is None or vars(module) is not function.__globals__:
            continue
        seen.add(function)
        names = names_in(function.__code__)
        found.setdefault(function.__module__, set()).update(names)
        called = [inspect.unwrap(one) for name in names if inspect.isfunction(one := vars(module).get(name))]
        pending += [one for one in called if package_of(one.__module__) in packages]
    return found


def _variables(owner: Any, names: set[str] | None) -> dict[str, Any]:
    """Return the variables of a class or a module that hold data: all, or only those in `names`."""
    return {
        name: value
        for name, value in vars(owner).items()
        if not (name.startswith("__") or isinstance(value, ModuleType | type) or inspect.isroutine(value))
        and not hasattr(type(value), "__get__")  # properties and the like
        and (names is None or name in names)
    }


_CONTAINERS = (dict, list, set, bytearray, deque, np.ndarray, Tensor)


def _copied(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values, as copies where they can change, without those that cannot be copied."""
    copies = {}
    for name, value in values.items():
        # a copy of a plain `object()` would no longer serve as a sentinel
        changes = isinstance(value, _CONTAINERS) or bool(getattr(value, "__dict__", None))
        with contextlib.suppress(Exception):
            copies[name] = copy.deepcopy(value) if changes else value
    return copies


# ---- files -------------------------------------------------------------------------------------------------

_WRITING = {"open": 0, "os.rename": 1, "os.mkdir": 0}
"""Audit events of what makes a file or a folder, with the place of its path among their arguments."""
_recording: tuple[int, list[Path]] | None = None
"""Id of the thread whose files and folders are recorded, and the list of these."""
_hooked = False


@contextmanager
def _written() -> Iterator[list[Path]]:
    """Record what Python writes and makes in the block; files of compiled libraries are missed."""
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
    if event not in _WRITING or _recording is None or _recording[0] != threading.get_ident():
        return
    if event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        return
    path = arguments[_WRITING[event]]
    if isinstance(path, str | bytes | os.PathLike) and not (event == "os.mkdir" and os.path.isdir(path)):
        _recording[1].append(Path(os.fsdecode(path)).absolute())
