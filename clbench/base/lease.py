"""The lease: one process at a time does a piece of work, on one machine or on several that share a folder."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from filelock import SoftFileLease, Timeout

from clbench.base.errors import ClbenchError
from clbench.base.strict_json import OPEN_PLAINLY, read_json
from clbench.base.text import printable

SECONDS = 30.0
"""Seconds without a heartbeat after which another machine may take a lease over. The end of a process is
noticed at once on its own machine."""

REPORT_SECONDS = 5.0
"""Least time between two reports of progress, in seconds."""


class LeaseLostError(ClbenchError, RuntimeError):
    """Another process took the lease over: this one was suspended, or could not reach the folder."""


class Owner(NamedTuple):
    """The process that holds a lease."""

    process: int
    host: str

    def __str__(self) -> str:
        return f"process {self.process} on {printable(self.host)}"


class Report(NamedTuple):
    """How far the owner of a lease is."""

    share: float
    """Share of the work that is done, from 0 to 1."""
    seconds: float
    """Seconds since the work began."""


def lease_path(path: Path) -> Path:
    """Return the file of the lease for making the file or folder `path`."""
    return path.with_name(f".{path.name}.lease")


class Lease:
    """The right of one process to make a file or folder.

    A heartbeat keeps it. If the owner dies, another process takes it over: at once on the same machine, and
    after `SECONDS` on another one that watches it meanwhile.

    Args:
        path: What is made. The file of the lease lies beside it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = lease_path(path)
        self._lock = SoftFileLease(self._file, lease_duration=SECONDS)
        self._begin = self._reported = 0.0

    def take(self) -> bool:
        """Take the lease, and return whether this process has it now; never wait."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._lock.acquire(blocking=False)
        except Timeout:
            return False
        self._begin = time.monotonic()
        return True

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Wait for the lease, and hold it inside."""
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._lock.acquire(poll_interval=0.1):
            yield

    def check(self) -> None:
        """Refuse to go on without the lease.

        Raises:
            LeaseLostError: Another process has it.
        """
        if self._is_lost():
            raise LeaseLostError(
                f"{self._file} was lost to another process: this one did not answer for {SECONDS:.0f} s."
            )

    def _is_lost(self) -> bool:
        """Return whether another process has the lease; the heartbeat alone notices it up to 20 s late."""
        found = self._lock.owner
        return self._lock.compromise is not None or (found is not None and found.token != self._lock.token)

    def release(self) -> None:
        """Give the lease back, if this process has it."""
        if self._lock.is_locked and not self._is_lost():
            self._remove_report()
        self._lock.release()

    def _remove_report(self) -> None:
        with contextlib.suppress(OSError):  # a folder that fails must not end the work
            _report_path(self._path).unlink(missing_ok=True)

    def report(self, share: float) -> None:
        """Tell others how far the work is, every `REPORT_SECONDS` at most."""
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
        if self._lock.owner is None:  # no lease, or a file that someone else put there
            if not self._file.exists():
                self._remove_report()
            return True
        if self.take():
            self.release()
            return True
        return False

    @property
    def owner(self) -> Owner | None:
        """The process that holds the lease, None if none does. The lease of a dead process goes.

        A process of another machine counts for twice `SECONDS` after its last heartbeat.
        """
        if self.clear():
            return None
        found = self._lock.owner
        with contextlib.suppress(OSError):
            if found is not None and time.time() - self._file.stat().st_mtime < 2 * SECONDS:
                return Owner(found.pid, found.hostname)
        return None

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
