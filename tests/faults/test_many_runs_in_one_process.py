"""Many runs in one process: memory and open files stay what they were."""

import gc
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

RUNS = 50
METHODS = ("sft", "lora", "experience_replay", "aegis", "ewc")
LARGEST_GROWTH = 20
"""Largest growth of the memory between the first runs of each method and the last ones, in MB: a leak of one
policy of the toy, or of one run's demonstrations, per run would be more."""


def _megabytes() -> float:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _handles() -> list[str]:
    """Return what the process has open, without the numbers that differ between equal things."""
    links = [Path("/proc/self/fd", name) for name in os.listdir("/proc/self/fd")]
    return sorted(os.readlink(link).partition(":")[0] for link in links if os.path.lexists(link))


@pytest.mark.slow
def test_memory_and_open_files_do_not_grow_over_many_runs(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    memory, handles, threads = [], [], []
    for number in range(RUNS):
        spec = RunSpec("clbench.testing:clbench/Toy-v0", METHODS[number % len(METHODS)], 0)
        assert execute(spec, tmp_path / str(number)).status == "success"
        memory.append(_megabytes())
        handles.append(_handles())
        threads.append(threading.active_count())
    begin, end = memory[len(METHODS) - 1], memory[-1]
    record_property("counts", {"runs": RUNS, "MB at first": round(begin), "MB at last": round(end)})
    assert end - begin < LARGEST_GROWTH, memory
    assert handles[-1] == handles[len(METHODS) - 1]
    assert threads[-1] == threads[len(METHODS) - 1]
