"""Hashes of source code, which cache keys contain."""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path


def source_hash(*modules: str) -> str:
    """Return the hash of the source of `modules`; a package counts with all files below it."""
    digest = hashlib.sha256()
    for module in modules:
        origin = _origin(module)
        if origin is None:  # typed in by hand: there is nothing to read
            digest.update(module.encode())
            continue
        for path in sorted(origin.parent.rglob("*")) if origin.name == "__init__.py" else [origin]:
            if path.is_file() and path.suffix != ".pyc":
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _origin(module: str) -> Path | None:
    """Return the file of a module, or None if it has none."""
    try:
        spec = importlib.util.find_spec(module)
    except ValueError:
        return None
    return Path(spec.origin) if spec is not None and spec.origin is not None else None


def package_of(entry_point: str) -> str:
    """Return the package that "package.module:attribute" lies in, or the module if it stands alone."""
    module = entry_point.partition(":")[0]
    package = module.rpartition(".")[0]
    return package if package and _origin(package) is not None else module
