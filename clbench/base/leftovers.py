"""Leftovers: files and folders that killed processes were making, and the traces of their leases."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from clbench.base.lease import Lease

FILE_SECONDS = 60.0
"""Seconds after which an unfinished file counts as left behind: writing one takes less than a second. Folders
have leases, which tell whether their maker lives."""

_UNFINISHED = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{32}\.(?:partial|old)")
_TRACE = re.compile(r"\.(?P<name>.+)\.(?:lease|progress)")


def is_unfinished(name: str) -> bool:
    """Return whether a file or folder has the name of one that is being made or removed."""
    return _UNFINISHED.fullmatch(name) is not None


def finished_name(name: str) -> str:
    """Return the name of what `name` becomes or was, for names of unfinished files and folders."""
    found = _UNFINISHED.fullmatch(name)
    return name if found is None else found["name"]


def is_left_behind(path: Path) -> bool:
    """Return whether the process that was making or removing `path` is gone."""
    if not path.is_dir():
        with contextlib.suppress(OSError):
            return time.time() - path.stat().st_mtime > FILE_SECONDS
        return False
    # a maker takes the lease first: without an owner, what it made is finished or abandoned
    return Lease(path.with_name(finished_name(path.name))).owner is None


def sweep(*roots: Path) -> int:
    """Remove what killed processes left below the folders, and return how much there was.

    What a living process is making stays, and so does everything that clbench does not make.
    """
    count = 0
    for path in [path for root in roots for path in _found(root)]:
        trace = _TRACE.fullmatch(path.name)
        if trace is None:
            if is_left_behind(path):
                _remove(path)
        elif Lease(path.with_name(trace["name"])).owner is None and path.suffix == ".progress":
            _remove(path)
        count += not path.exists()
    return count


def _found(root: Path) -> Iterator[Path]:
    """Yield everything below a folder with the name of a leftover."""
    for place, folders, files in os.walk(root):
        for name in (*folders, *files):
            if is_unfinished(name) or (name in files and _TRACE.fullmatch(name)):
                yield Path(place, name)
        folders[:] = [name for name in folders if not is_unfinished(name)]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
