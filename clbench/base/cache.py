"""The cache: a slow result is made once, and used again if it is whole and made from the same inputs."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


LOG = logging.getLogger("clbench")

_MANIFEST = "clbench.json"


def cache_folder() -> Path:
    """Return the folder of the cache: `CLBENCH_CACHE`, or clbench below the user's own cache folder."""
    if os.environ.get("CLBENCH_CACHE"):
        return Path(os.environ["CLBENCH_CACHE"]).expanduser().resolve()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "clbench"


def hash_of(values: Any) -> str:
    """Return a short hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def hash_of_tensors(tensors: Mapping[str, Tensor]) -> str:
    """Return a short hash of the names and the bits of tensors."""
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def cached(folder: Path, inputs: Mapping[str, Any], make: Callable[[Path], None]) -> Path:
    """Return `folder`, filled by `make` unless it already holds the result of the same `inputs`.

    A folder that is torn, foreign or made from other inputs is named in the log and made again. The new one
    appears in one step, so that a reader, or a second maker, never meets half of it.

    Args:
        folder: Folder of the result.
        inputs: All that the result depends on, as JSON.
        make: Fills an empty folder.
    """
    key = hash_of(inputs)
    fault = _fault(folder, key)
    if fault is None:
        return folder
    if folder.exists():
        LOG.warning("%s %s; making it again.", folder, fault)
    partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    partial.mkdir(parents=True)
    try:
        make(partial)
        manifest = {"inputs": key, "files": _file_hashes(partial), "made_from": dict(inputs)}
        (partial / _MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        if folder.exists() and _fault(folder, key) is not None:
            folder.rename(partial.with_suffix(".old"))
        try:
            partial.rename(folder)
        except OSError:  # another process was faster: its result from the same inputs is as good
            if _fault(folder, key) is not None:
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(partial.with_suffix(".old"), ignore_errors=True)
    return folder


def is_cached(folder: Path, inputs: Mapping[str, Any]) -> bool:
    """Return whether `folder` is whole and was made from `inputs`."""
    return fault_of(folder, inputs) is None


def fault_of(folder: Path, inputs: Mapping[str, Any]) -> str | None:
    """Return why `folder` cannot serve as the result of `inputs`, as the end of a sentence, or None."""
    return _fault(folder, hash_of(inputs))


def _fault(folder: Path, key: str) -> str | None:
    """Return the fault of `folder`, or None."""
    try:
        manifest = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
        if manifest["inputs"] != key:
            return "was made from other inputs"
        if manifest["files"] != _file_hashes(folder):
            return "is torn: its files are not those that were written"
    except (OSError, ValueError, KeyError, TypeError):
        return "is torn or foreign: it has no readable manifest"
    return None


def _file_hashes(folder: Path) -> dict[str, str]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != _MANIFEST)
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths
    }
