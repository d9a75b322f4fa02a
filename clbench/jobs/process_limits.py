"""Compare the memory and writes of a process with its limits, and kill it with everything it started."""

from __future__ import annotations

import contextlib
import os
import signal

from clbench.spec.limits import Limits


def exceeded(limits: Limits, process: int, seconds: float) -> str | None:
    """Return a description of the limit that a process exceeds, None if it exceeds none.

    Args:
        limits: Limits of the process.
        process: Id of the process.
        seconds: Time since its start, in seconds.
    """
    if seconds > limits.seconds:
        return f"it took longer than {limits.seconds:g} s"
    memory, written = usage(process)
    if memory > limits.memory:
        return f"it took {memory / 1e9:.1f} GB of memory, more than {limits.memory / 1e9:.1f} GB"
    if written > limits.written:
        return f"it wrote {written / 1e9:.1f} GB, more than {limits.written / 1e9:.1f} GB"
    return None


def usage(process: int) -> tuple[int, int]:
    """Return the resident bytes and the written bytes of a process and of its living children."""
    import psutil

    memory = written = 0
    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process)
        for one in (parent, *parent.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                memory += one.memory_info().rss
                counters = one.io_counters() if hasattr(one, "io_counters") else None  # not on macOS
                written += getattr(counters, "write_chars", getattr(counters, "write_bytes", 0))
    return memory, written


def end(process: int) -> None:
    """Kill a process and its children, and end its group."""
    import psutil

    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process)
        for one in (*parent.children(recursive=True), parent):
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()
    end_group(process)


def end_group(leader: int) -> None:
    """Kill what is left of the process group that `leader` leads: children may outlive their parent."""
    signal_group(leader, signal.SIGKILL)


def signal_group(leader: int, number: signal.Signals) -> None:
    """Send a signal to the process group that `leader` leads, if there is one."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, number)
