"""Leftovers: files and folders that killed processes were making, and the traces of their leases."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
import shutil
import socket
import uuid
from collections.abc import Iterator
from pathlib import Path

import psutil

from clbench.base.lease import Lease, now_in

LEFT_SECONDS = 600.0
"""Seconds without a sign of life after which another machine counts as gone. Clocks of machines may differ,
but by less than 300 s: otherwise neither Slurm nor Kerberos would accept their messages."""

_MAKER = r"(?P<host>[0-9a-f]{8})(?P<process>[0-9a-f]{8})[0-9a-f]{16}"
_UNFINISHED = re.compile(rf"\.(?P<name>.+)\.{_MAKER}\.(?:partial|old)")
_LEASE = re.compile(r"\.(?P<name>.+)\.lease|\.(?P<record>seed-.+\.json)\.progress")
"""Names of leases, and of the progress reports beside the leases of records."""


def unfinished(path: Path) -> Path:
    """Return a new path beside `path`, at which this process can make the file or folder."""
    return path.with_name(f".{path.name}.{_host()}{os.getpid():08x}{uuid.uuid4().hex[:16]}.partial")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a new path beside `path`. If the block succeeds, the file there replaces `path` in one step."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    partial = unfinished(path)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@functools.cache
def _host() -> str:
    """Return a hash of the place in which process numbers are unique: a machine, or a container on it."""
    namespace = Path("/proc/self/ns/pid")
    place = f"{socket.gethostname()} {os.readlink(namespace) if namespace.is_symlink() else ''}"
    return hashlib.sha256(place.encode(errors="surrogateescape")).hexdigest()[:8]


def is_unfinished(name: str) -> bool:
    """Return whether a name marks a file or folder as being made or removed."""
    return _UNFINISHED.fullmatch(name) is not None


def finished_name(name: str) -> str:
    """Return the final or former name of an unfinished file or folder; other names stay as they are."""
    found = _UNFINISHED.fullmatch(name)
    return name if found is None else found["name"]


def is_left_behind(path: Path) -> bool:
    """Return whether the process that was making or removing `path` is gone.

    A living process of this machine may be suspended and lose its lease. It still owns what it was making.
    """
    found = _UNFINISHED.fullmatch(path.name)
    made_here = found is not None and found["host"] == _host()
    if found is not None and made_here and psutil.pid_exists(int(found["process"], 16)):
        return False
    if not path.is_dir():
        if made_here:
            return True
        with contextlib.suppress(OSError):
            return now_in(path.parent) - path.stat().st_mtime > LEFT_SECONDS
        return False
    # a maker takes the lease first: without an owner, what it made is finished or abandoned
    return is_idle(path.with_name(finished_name(path.name)))


def is_idle(path: Path) -> bool:
    """Return whether no process can still be making the file or folder `path`."""
    lease = Lease(path)
    return lease.clear() or lease.silence > LEFT_SECONDS


def sweep(*roots: Path) -> int:
    """Remove what killed processes left below the folders, and return the number of removed paths.

    What a living process is making stays, and so does everything that clbench does not make.
    """
    count = 0
    for path in [path for root in roots for path in _found(root)]:
        lease = _LEASE.fullmatch(path.name)
        if lease is not None:
            Lease(path.with_name(lease["name"] or lease["record"])).clear()
        elif is_left_behind(path):
            _remove(path)
        count += not path.exists()
    return count


def _found(root: Path) -> Iterator[Path]:
    """Yield everything below a folder with the name of a leftover."""
    for place, folders, files in os.walk(root):
        for name in (*folders, *files):
            if is_unfinished(name) or (name in files and _LEASE.fullmatch(name)):
                yield Path(place, name)
        folders[:] = [name for name in folders if not is_unfinished(name)]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
