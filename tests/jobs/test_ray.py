"""Ray: it makes the same records as one machine, and a lost worker loses no work."""

import importlib
import io
import os
import re
import threading
import time
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import psutil
import pytest
from rich.console import Console

from clbench.jobs.bars import Bars
from clbench.jobs.job import Job
from clbench.jobs.plan import Plan
from clbench.jobs.processes import Processes
from clbench.jobs.ray import RayWorkers
from clbench.jobs.scheduler import run_jobs
from clbench.runs.spec import RunSpec
from clbench.spec.limits import Limits

TOY = "clbench.testing:clbench/Toy-v0"

JOBS = """
import os, time
from pathlib import Path

def good(progress):
    progress(1)
    return "went well"

def waits(progress, started, until):
    Path(started).touch()
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not Path(until).exists():
        time.sleep(0.05)
    for _ in range(20):
        progress(0.01)
        time.sleep(0.1)
    return "waited"

def bad(progress):
    raise ValueError("went wrong")

def lost_once(progress, path):
    attempts = Path(path)
    with attempts.open("a") as file:
        file.write(f"{os.getpid()}\\n")
    while len(attempts.read_text().split()) == 1:
        time.sleep(0.1)
        progress(0)
    return "went well in the end"

def lost_always(progress):
    os._exit(3)

def endless(progress):
    time.sleep(60)

def taken_once(progress, path):
    from clbench.base.lease import LeaseLostError
    time.sleep(0.3)
    progress(1)
    time.sleep(1.5)
    if not Path(path).exists():
        Path(path).touch()
        raise LeaseLostError("lost to another process")
    return "went well"

def niceness(progress):
    return f"nicer by {os.nice(0)}"
"""

# each test has its own cluster; Ray leaves a socket and a log file to the garbage collector
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]


@pytest.fixture(autouse=True)
def _jobs_module(write_module: Callable[[str, str], None]) -> None:
    write_module("some_jobs", JOBS)


def _kill_first(path: Path, ancestor: int) -> None:
    """Kill the process whose id is the first in a file, or an ancestor of it, once the file exists."""
    deadline = time.monotonic() + 100
    while time.monotonic() < deadline:
        if path.exists() and path.read_text().strip():
            process = psutil.Process(int(path.read_text().split()[0]))
            [process, *process.parents()][ancestor].kill()
            return
        time.sleep(0.05)


@pytest.mark.parametrize("ancestor", [0, 2], ids=["process", "worker"])
def test_a_job_that_fails_leaves_the_others_alone_and_one_whose_worker_is_killed_is_done_again(
    ancestor: int, tmp_path: Path, bars: Bars
) -> None:
    path = tmp_path / "attempts"
    some = importlib.import_module("some_jobs")
    wrong = Job("wrong", some.bad, {}, 1)
    jobs = [
        wrong,
        Job("hopeless", some.good, {}, 1, (wrong,)),
        Job("fine", some.good, {}, 1),
        Job("lost", some.lost_once, {"path": str(path)}, 1),
        Job("cursed", some.lost_always, {}, 1),
        Job("endless", some.endless, {}, 1, limits=Limits(seconds=3)),
    ]
    killer = threading.Thread(target=_kill_first, args=(path, ancestor))
    killer.start()
    failed = {job.title: reason for job, reason in run_jobs(jobs, RayWorkers("local", 2), bars).items()}
    killer.join()
    assert set(failed) == {"wrong", "hopeless", "cursed", "endless"}
    assert failed["endless"] == "stopped, because it took longer than 3 s"
    assert failed["cursed"] == (
        "its worker was lost 4 times: its process ended without a result (exit code 3)"
    )
    assert "ValueError: went wrong" in failed["wrong"]
    assert len(path.read_text().split()) == 2
    assert isinstance(bars.console.file, io.StringIO)
    assert "lost: went well in the end" in bars.console.file.getvalue()


def test_jobs_go_on_without_the_actor_that_shows_their_progress(tmp_path: Path, bars: Bars) -> None:
    some, started = importlib.import_module("some_jobs"), tmp_path / "started"

    def kill_the_actor() -> None:
        deadline = time.monotonic() + 100
        while time.monotonic() < deadline and not started.exists():
            time.sleep(0.05)
        for process in psutil.process_iter(["cmdline"]):
            if any("_ProgressActor" in part for part in process.info["cmdline"] or ()):
                process.kill()
                (tmp_path / "killed").touch()

    killer = threading.Thread(target=kill_the_actor)
    killer.start()
    job = Job("patient", some.waits, {"started": str(started), "until": str(tmp_path / "killed")}, 1)
    assert run_jobs([job, Job("fine", some.good, {}, 1)], RayWorkers("local", 2), bars) == {}
    killer.join()
    assert (tmp_path / "killed").exists()


def test_the_records_equal_those_of_one_machine(
    tmp_path: Path, bars: Bars, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    here, on_ray = Plan(), Plan()
    for method in ("sft", "frozen", "experience_replay"):
        here.add_run(RunSpec(TOY, method, 0).resolve(), tmp_path / "here")
    assert run_jobs(here.jobs, Processes(2), bars) == {}
    for method in ("sft", "frozen", "experience_replay"):
        on_ray.add_run(RunSpec(TOY, method, 0).resolve(), tmp_path / "ray")
    assert run_jobs(on_ray.jobs, RayWorkers("local", 2), bars) == {}
    records = lasting_records(tmp_path / "here")
    assert len(records) == 3
    assert records == lasting_records(tmp_path / "ray")


def test_a_job_that_another_process_took_over_is_shown_from_its_new_start(tmp_path: Path) -> None:
    shares = []

    class Watched(Bars):
        def finish(self, piece: Hashable, text: str) -> None:
            shares.append(self.share(piece))
            super().finish(piece, text)

    taken_once = importlib.import_module("some_jobs").taken_once
    job = Job("taken", taken_once, {"path": str(tmp_path / "tried")}, 1)
    assert run_jobs([job], RayWorkers("local", 1), Watched(1, Console(file=io.StringIO()))) == {}
    assert shares == [1.0]


def test_a_job_on_this_machine_has_normal_priority(bars: Bars) -> None:
    niceness = importlib.import_module("some_jobs").niceness
    assert run_jobs([Job("niceness", niceness, {}, 1)], RayWorkers("local", 1), bars) == {}
    assert isinstance(bars.console.file, io.StringIO)
    assert f"niceness: nicer by {os.nice(0)} (" in bars.console.file.getvalue()


@pytest.mark.parametrize("address", ["auto", "localhost:1", "ray://127.0.0.1:1", "[::1]:1"])
def test_a_cluster_that_does_not_run_is_refused_at_once(address: str) -> None:
    begin = time.monotonic()
    message = f"No Ray cluster answers at '{re.escape(address)}'; --ray local starts one"
    with pytest.raises(LookupError, match=message):
        RayWorkers(address)
    assert time.monotonic() - begin < 60  # Ray itself tries for minutes


@pytest.mark.parametrize("address", ["foo", "foo:bar"])
def test_an_address_of_another_form_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match=f"--ray must be auto, local or host:port, not '{address}'"):
        RayWorkers(address)
