"""Limits of a process: how long it may take, what memory, and how much it may write.

They stop a method that goes wrong, not one that means harm: it runs as the user who starts it, and can read,
write and send what he can.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What a process and those that it starts may take. The defaults are far above a run of ours."""

    seconds: float = 3600.0
    """Time from its start."""
    memory: int = 8 * 1024**3
    """Bytes of memory that are resident at once."""
    written: int = 4 * 1024**3
    """Bytes that it hands to the system to write, wherever to. Not seen on macOS, which does not tell."""

    def exceeded(self, process: int, seconds: float) -> str | None:
        """Return which limit a process is beyond, in words, or None.

        Args:
            process: Its id.
            seconds: How long ago it was started.
        """
        if seconds > self.seconds:
            return f"it took longer than {self.seconds:g} s"
        memory, written = usage(process)
        if memory > self.memory:
            return f"it took {memory / 1e9:.1f} GB of memory, more than {self.memory / 1e9:.1f} GB"
        if written > self.written:
            return f"it wrote {written / 1e9:.1f} GB, more than {self.written / 1e9:.1f} GB"
        return None


def usage(process: int) -> tuple[int, int]:
    """Return the resident and the written bytes of a process and of those it started that still live."""
    import psutil

    memory = written = 0
    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process)
        for one in (parent, *parent.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                memory += one.memory_info().rss
                written += one.io_counters().write_chars if hasattr(one, "io_counters") else 0
    return memory, written


def end(process: int) -> None:
    """Kill a process and those it started."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process)
        for one in (*parent.children(recursive=True), parent):
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()
