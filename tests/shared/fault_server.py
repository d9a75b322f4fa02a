"""A process that forks runs of `tiny` and lets the file system fail, or the process die, at one operation.

It reads one order per line, as JSON, from standard input, and answers each with a line: how many operations
that change files the run began, and how it ended. Forking takes milliseconds; a new Python takes seconds to
import PyTorch. What a run imports on its way is imported beforehand: otherwise every fork spends 2 s on it.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import minari  # noqa: F401
import torch._inductor.config  # noqa: F401
from tiny import TINY

from clbench.base.leftovers import sweep
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

CHANGES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link"}
"""Audit events of operations that change files, besides opening a file to write. The heartbeat of a lease is
none: it would make the count depend on the clock."""

WRITES = os.O_WRONLY | os.O_RDWR

DIES, FULL = "dies", "full"
KILLED = '[null, "killed"]'


def _watch(at: int | None, fault: str) -> Callable[[], int]:
    """Let the process die before operation `at`, or let that and all later ones meet a full disk.

    Returns:
        A function that returns the number of operations so far.
    """
    count = 0

    def look(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITES
        if not (writes or event in CHANGES):
            return
        count += 1
        if at is None or count < at:
            return
        if fault == DIES:
            os.kill(os.getpid(), signal.SIGKILL)
        if event not in ("os.remove", "os.rmdir"):  # a full disk lets files be removed
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    sys.addaudithook(look)
    return lambda: count


def _die_after(seconds: float) -> None:
    """Let the process be killed in some seconds, whatever it does then."""
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL))
    timer.daemon = True
    timer.start()


def _run(order: dict[str, Any], answer: int) -> None:
    """Do a run in this process, and write how it ended."""
    os.environ.update(order["environment"])
    records = Path(order["records"])
    operations = _watch(order.get("at"), order.get("fault", DIES))
    if "after" in order:
        _die_after(order["after"])
    try:
        sweep(records, *map(Path, order["environment"].values()))
        end: str = execute(RunSpec(TINY.id, order["method"], order["seed"]), records).status
    except OSError as error:  # such as CacheError
        end = f"refused: {error}"
    os.write(answer, json.dumps([operations(), end]).encode())
    os._exit(0)


def serve() -> None:
    """Answer orders until standard input ends."""
    for line in sys.stdin:
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            os.close(reading)
            _run(json.loads(line), writing)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            said = pipe.read()
        os.waitpid(child, 0)
        sys.stdout.write(f"{said or KILLED}\n")
        sys.stdout.flush()


class Runs:
    """Runs of `tiny` in forked processes."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process

    def do(self, folder: Path, method: str = "sft", seed: int = 0, **fault: Any) -> tuple[int | None, str]:
        """Do a run in the caches and the records of a folder; return its operations and how it ended."""
        caches = {"CLBENCH_CACHE": "cache", "MINARI_DATASETS_PATH": "minari"}
        order = {
            "environment": {name: str(folder / place) for name, place in caches.items()},
            "records": str(folder / "records"),
            "method": method,
            "seed": seed,
            **fault,
        }
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        count, end = json.loads(self.process.stdout.readline())
        return count, end


@contextmanager
def start() -> Iterator[Runs]:
    """Start the process, and end it with the block."""
    command = [sys.executable, __file__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield Runs(process)
        assert process.stdin is not None
        process.stdin.close()


if __name__ == "__main__":
    serve()
