"""Hashes of source code, which cache keys contain: a result is made again when the code that made it changes.

A key names packages, each with every package below it, and not single modules: a module that moves inside its
package stays covered, and code that cannot change a result (the film maker, the command line) is not in the
key.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import sys
from pathlib import Path
from types import CodeType

DATA_SOURCES = ("clbench.base", "clbench.spec", "clbench.policy", "clbench.worlds", "clbench.data")
"""Code that demonstrations and questions depend on, besides the suite of their tasks."""

TRAINING_SOURCES = (*DATA_SOURCES, "clbench.learning")
"""Code that a pretrained policy depends on, besides the suites of its tasks and questions."""

RUN_SOURCES = (*TRAINING_SOURCES, "clbench.records", "clbench.evaluation", "clbench.runs")
"""Code that a run depends on, besides the suites of its tasks and the package of its method."""


def source_hash(*modules: str) -> str:
    """Return the hash of the source of `modules`; a package counts with all files below it.

    Args:
        modules: Names of modules and packages, in any order.

    Raises:
        ModuleNotFoundError: A module does not exist. Its name must not be hashed in place of its source: the
            key would never change.
    """
    digest = hashlib.sha256()
    for module in sorted(set(modules)):
        origin = _origin(module)
        digest.update(module.encode())
        if origin is None:  # a class that was typed at a prompt has no source to read
            continue
        for path in sorted(origin.parent.rglob("*")) if origin.name == "__init__.py" else [origin]:
            # Python and numba keep what they compile there, and would change the key in the middle of a run
            if path.is_file() and path.parent.name != "__pycache__":
                status = path.stat()
                digest.update(_file_hash(path, status.st_mtime_ns, status.st_size))
    return digest.hexdigest()[:16]


@functools.lru_cache(maxsize=4096)  # a run asks 20 times, 10 ms each
def _file_hash(path: Path, changed: int, size: int) -> bytes:
    """Return the hash of a file that was last changed at a time and has a size."""
    return hashlib.sha256(path.read_bytes()).digest()


def _origin(module: str) -> Path | None:
    """Return the file of a module, None if it has no file.

    Raises:
        ModuleNotFoundError: The module does not exist.
    """
    try:
        spec = importlib.util.find_spec(module)
    except ValueError:  # `__main__` has no spec
        spec, file = None, getattr(sys.modules.get(module), "__file__", None)
    else:
        file = spec.origin if spec is not None else None
    if spec is None and module not in sys.modules:
        raise ModuleNotFoundError(
            f"There is no module {module!r}, whose source is part of a key.", name=module
        )
    return Path(file) if file is not None else None


def class_hash(cls: type) -> str:
    """Return the hash of the code and the plain values of a class that was typed at a prompt.

    What its methods call outside of the class does not count.
    """
    digest = hashlib.sha256()
    for name, value in sorted(vars(cls).items()):
        function = getattr(value, "__func__", getattr(value, "fget", value))  # of a class method, a property
        code = getattr(function, "__code__", None)
        if code is not None:
            digest.update(f"{name} {_code_text(code)}".encode())
        elif not name.startswith("__") and isinstance(value, str | int | float | tuple | None):
            digest.update(f"{name} {value!r}".encode())
    return digest.hexdigest()[:16]


def _code_text(code: CodeType) -> str:
    """Return what a function does as text, without the numbers of its lines."""

    def text(constant: object) -> str:
        if isinstance(constant, CodeType):
            return _code_text(constant)
        # sets have another order in each process
        return repr(sorted(map(repr, constant))) if isinstance(constant, frozenset) else repr(constant)

    return f"{code.co_code.hex()} {code.co_names} {list(map(text, code.co_consts))}"


def has_source(module: str) -> bool:
    """Return whether a module has a file; the module of a prompt has none."""
    return _origin(module) is not None


def package_of(entry_point: str) -> str:
    """Return the package of "package.module:attribute", or the module if it is in no package."""
    module = entry_point.partition(":")[0]
    package = module.rpartition(".")[0]
    try:
        return package if package and _origin(package) is not None else module
    except ModuleNotFoundError:  # a class whose `__module__` was set by hand is in no package
        return module
