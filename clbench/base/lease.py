"""The lease: one process at a time does a piece of work, on one machine or on several that share a folder."""

from __future__ import annotations

import contextlib
import json
import math
import os
import tempfile
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from filelock import LeaseSettingsMismatch, SoftFileLease, Timeout

from clbench.base.errors import ClbenchError
from clbench.base.progress import remark
from clbench.base.strict_json import OPEN_PLAINLY, read_json
from clbench.base.text import printable

SECONDS = 30.0
"""Seconds without a heartbeat after which another machine may take a lease over. The end of a process is
noticed at once on its own machine."""

_REMOVAL = 1.5
"""Multiple of `SECONDS` after which a file that filelock leaves behind is removed. It is above 1, so that
filelock comes first where it can."""

REPORT_SECONDS = 5.0
"""Minimum time between two progress reports, in seconds."""


class LeaseLostError(ClbenchError, RuntimeError):
    """Another process took the lease over: this one was suspended, or could not reach the folder."""


class Owner(NamedTuple):
    """The process that holds a lease."""

    process: int
    """Number of the process; 0 if its name has not reached this machine."""
    host: str

    def __str__(self) -> str:
        return f"process {self.process} on {printable(self.host)}" if self.process else "an unknown process"


class Report(NamedTuple):
    """Progress that the owner of a lease reports."""

    share: float
    """Share of the work that is done, from 0 to 1."""
    seconds: float
    """Seconds since the work began."""


def lease_path(path: Path) -> Path:
    """Return the file of the lease for making the file or folder `path`."""
    return path.with_name(f".{path.name}.lease")


class Lease:
    """The right of one process to make a file or folder.

    A heartbeat keeps the lease. If the owner dies, another process takes the lease over: at once on the same
    machine, and after `SECONDS` on another machine that has watched it meanwhile. Where filelock cannot do
    this, any process that watches the lease takes it over after 1.5 times `SECONDS`.

    Args:
        path: File or folder to make. The file of the lease lies beside it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = lease_path(path)
        # the file is gone before it is closed: an error on closing then says nothing about the lease
        self._lock = SoftFileLease(self._file, lease_duration=SECONDS, close_error_policy="suppress")
        self._begin = self._reported = 0.0
        self._seen: tuple[int, int, bytes] | None = None
        self._since = 0.0

    def take(self) -> bool:
        """Take the lease, and return whether this process has it now; never wait."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        return self._acquires() or (self._removes_dead() and self._acquires())

    def _acquires(self) -> bool:
        try:
            self._lock.acquire(blocking=False)
        except (Timeout, LeaseSettingsMismatch):  # the second one: an owner with another `SECONDS`
            return False
        self._begin = time.monotonic()
        return True

    def _removes_dead(self) -> bool:
        """Remove the file of a dead owner, which filelock leaves in two cases, and return whether it is gone.

        filelock exchanges two names in one step, which NFS and Lustre refuse. It also never removes an empty
        file, which a machine leaves if it stops before the content is on the disk. Here the file is renamed
        and read again. If it is the lease of a new owner by then, it is put back. That owner may miss it for
        a moment; then `check` stops its work, and no two owners write.
        """
        aside = self._file.with_name(f".{self._path.name}.{uuid.uuid4().hex}.lease")
        try:
            seen = _look(self._file)
            if seen != self._seen:
                self._seen, self._since = seen, time.monotonic()
            if time.monotonic() - self._since < _REMOVAL * SECONDS:
                return False
            self._file.rename(aside)
        except OSError:
            return False
        with contextlib.suppress(OSError):  # a third process may have the lease by now
            if _look(aside) != seen:
                os.link(aside, self._file)
        with contextlib.suppress(OSError):
            aside.unlink()
        return True

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Wait for the lease, report now and then who holds it, and hold it inside the block."""
        begin, told = time.monotonic(), -SECONDS
        while not self.take():
            waited = time.monotonic() - begin
            if waited - told >= SECONDS:
                told = waited
                remark(f"waiting for {self._holder() or 'another process'} to make {self._path}")
            time.sleep(0.1 if waited < 1 else 1.0)  # short waits, then long ones: a file server serves all
        try:
            if told >= 0:
                remark("")
            yield
        finally:
            self.release()

    def check(self) -> None:
        """Refuse to go on without the lease.

        Raises:
            LeaseLostError: Another process has it, or its file was removed.
        """
        if self._is_lost():
            raise LeaseLostError(
                f"This process lost {self._file}: it did not answer for {SECONDS:.0f} s and another process "
                "took over, or the file was removed."
            )

    def _is_lost(self) -> bool:
        """Return whether another process has the lease; the heartbeat alone would notice up to 20 s late."""
        if self._lock.compromise is not None:
            return True
        found = self._lock.owner
        if found is not None:
            return found.token != self._lock.token
        try:
            return self._file.lstat().st_size == 0  # the file of a new owner, whose content has not arrived
        except FileNotFoundError:  # a new owner may be about to write its own file
            return True
        except OSError:  # the heartbeat decides whether the folder fails for too long
            return False

    def release(self) -> None:
        """Give the lease back, if this process has it."""
        if self._lock.is_locked and not self._is_lost():
            self._remove_report()
        self._lock.release()

    def _remove_report(self) -> None:
        with contextlib.suppress(OSError):  # a folder that fails must not end the work
            _report_path(self._path).unlink(missing_ok=True)

    def report(self, share: float) -> None:
        """Tell other processes how far the work is, at most once every `REPORT_SECONDS`."""
        now = time.monotonic()
        if now - self._reported >= REPORT_SECONDS and not self._is_lost():
            self._reported = now
            text = json.dumps(Report(share, now - self._begin))
            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | OPEN_PLAINLY  # a link leads to another file
            with contextlib.suppress(OSError):  # a full disk must not end the work
                descriptor = os.open(_report_path(self._path), flags, 0o666)
                with open(descriptor, "w", encoding="utf-8") as file:
                    file.write(text)

    def clear(self) -> bool:
        """Remove the lease of a dead process, and its report; return whether nobody holds the lease."""
        if not self._file.exists():
            self._remove_report()
            return True
        if self._lock.owner is not None and self.take():
            self.release()
            return True
        return False  # it is held, has no content yet, or someone else put the file there

    @property
    def silence(self) -> float:
        """Seconds since the last heartbeat of an owner, infinite without a lease.

        The clock is that of the file server where it can be read: the clock of this machine may be wrong.
        """
        try:
            changed = self._file.stat().st_mtime
        except OSError:
            return math.inf
        return now_in(self._file.parent) - changed

    @property
    def owner(self) -> Owner | None:
        """The process that holds the lease, None if none does. The lease of a dead process is removed.

        A process on another machine counts as alive for twice `SECONDS` after its last heartbeat.
        """
        return None if self.clear() else self._holder()

    def _holder(self) -> Owner | None:
        """Return the process that the file names, None if its last heartbeat is too old."""
        if self.silence >= 2 * SECONDS:
            return None
        found = self._lock.owner
        if found is not None:
            return Owner(found.pid, found.hostname)
        with contextlib.suppress(OSError):
            if self._file.stat().st_size == 0:  # the content has not reached this machine
                return Owner(0, "")
        return None  # a file that someone else put there

    @property
    def progress(self) -> Report | None:
        """The last report of the owner, None if there is none."""
        try:
            share, seconds = read_json(_report_path(self._path))
            return Report(float(share), float(seconds)) if 0 <= share <= 1 and seconds >= 0 else None
        except (ValueError, TypeError):
            return None


def _report_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.progress")


def _look(file: Path) -> tuple[int, int, bytes]:
    """Return what a heartbeat or a new owner changes; the file is opened, so that NFS asks its server."""
    descriptor = os.open(file, os.O_RDONLY | OPEN_PLAINLY)
    try:
        status = os.fstat(descriptor)
        return status.st_ino, status.st_mtime_ns, os.read(descriptor, 4096)
    finally:
        os.close(descriptor)


def now_in(folder: Path) -> float:
    """Return the time on a folder's file server, or on this machine where nothing can be written."""
    try:
        with tempfile.TemporaryFile(dir=folder, prefix=".") as file:
            return os.fstat(file.fileno()).st_mtime
    except OSError:
        return time.time()
