"""Limits: a process that exceeds its limits is ended with a reason, and the others continue."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers import is_gone

from clbench.jobs.bars import Bars
from clbench.jobs.job import Job
from clbench.jobs.process_limits import end, exceeded, usage
from clbench.jobs.processes import Processes
from clbench.jobs.scheduler import run_jobs
from clbench.spec.limits import Limits

Done = Callable[..., dict[str, str]]

JOBS = """
import os, subprocess, sys, time

def short(progress):
    return "went well"

def long(progress):
    time.sleep(60)

def large(progress):
    memory = b"x" * 800_000_000
    time.sleep(60)

def writer(progress, path):
    with open(path, "wb") as file:
        while True:
            file.write(bytes(1_000_000))
            file.seek(0)
            time.sleep(0.01)

def parent(progress, path):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    open(path, "w").write(str(child.pid))
    writer(progress, f"{path} data")
"""


@pytest.fixture(autouse=True)
def _jobs_module(write_module: Callable[[str, str], None]) -> None:
    write_module("limited_jobs", JOBS)


@pytest.fixture
def done(bars: Bars) -> Done:
    """Return a function that does jobs, given as functions with limits, and returns the failures."""

    def done(*jobs: tuple[str, Limits | None], **arguments: Any) -> dict[str, str]:
        module = importlib.import_module("limited_jobs")
        made = [
            Job(name, getattr(module, name), arguments if name in ("writer", "parent") else {}, 1, (), limits)
            for name, limits in jobs
        ]
        return {str(job): message for job, message in run_jobs(made, Processes(2), bars).items()}

    return done


@pytest.mark.long
def test_a_job_that_takes_too_long_is_stopped_and_the_others_are_not(
    done: Done,
) -> None:
    failed = done(("long", Limits(seconds=1.0)), ("short", Limits(seconds=600.0)))
    assert failed == {"long": "stopped, because it took longer than 1 s"}


@pytest.mark.long
def test_a_job_that_takes_too_much_memory_is_stopped(done: Done) -> None:
    (message,) = done(("large", Limits(memory=600_000_000))).values()
    assert message.startswith("stopped, because it took ")
    assert message.endswith("GB of memory, more than 0.6 GB")


@pytest.mark.long
def test_a_job_that_writes_too_much_is_stopped(tmp_path: Path, done: Done) -> None:
    limits = Limits(written=20_000_000)
    (message,) = done(("writer", limits), path=os.fspath(tmp_path / "file")).values()
    assert message.startswith("stopped, because it wrote 0.")
    assert message.endswith("GB, more than 0.0 GB")


@pytest.mark.long
def test_the_children_of_a_stopped_job_are_stopped_too(tmp_path: Path, done: Done) -> None:
    path = tmp_path / "child"
    done(("parent", Limits(written=20_000_000)), path=os.fspath(path))
    assert is_gone(int(path.read_text()))


LARGE = """
import subprocess, sys, time
memory = b"x" * 100_000_000
code = "import time; memory = b'x' * 100_000_000; print(flush=True); time.sleep(600)"
child = subprocess.Popen([sys.executable, "-c", code], start_new_session=True, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
time.sleep(600)
"""


def test_a_process_counts_and_ends_together_with_a_child_that_left_its_group() -> None:
    command = [sys.executable, "-c", LARGE]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        memory, _ = usage(process.pid)
        end(process.pid)
    assert memory > 200_000_000
    assert is_gone(child)


def test_a_process_that_has_ended_exceeds_no_limit() -> None:
    assert exceeded(Limits(), 2**22 - 1, 1.0) is None
