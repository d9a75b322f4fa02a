"""Processes of jobs: what a job does to its process, and what it starts beside it, ends with the job."""

import dataclasses
import importlib
import os
import signal
import subprocess
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from helpers import is_gone, printed

from clbench.base.cache import cache_folder, minari_folder
from clbench.base.progress import announce
from clbench.jobs.bars import Bars
from clbench.jobs.job import Event, Job, Product
from clbench.jobs.processes import Here, Processes, at_once
from clbench.jobs.scheduler import run_jobs
from clbench.spec.limits import Limits
from clbench.worlds.threads import cores, threads_of_job

JOBS = """
import asyncio, gc, multiprocessing, os, signal, struct, subprocess, threading, time
from multiprocessing.connection import Connection
from pathlib import Path

from clbench.worlds.threads import Team

def leaves_a_child(progress, path):
    child = subprocess.Popen(["sleep", "600"])
    Path(path).write_text(str(child.pid))
    return "went well"

def dies_beside_a_fork(progress, path):
    child = os.fork()
    if child == 0:
        time.sleep(600)
    Path(path).write_text(str(child))
    os.kill(os.getpid(), signal.SIGKILL)

def stubborn(progress, path):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    child = subprocess.Popen(["sleep", "600"])
    Path(path).write_text(f"{os.getpid()} {child.pid}")
    time.sleep(600)

def goes_on(progress, path):
    Path(path).write_text(str(os.getpid()))
    for _ in range(3000):
        progress(0.01)
        time.sleep(0.05)

def thirds(progress):
    for _ in range(3):
        progress(0.25)
    return "went well"

def waits(progress, path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(600)

def has_a_helper(progress):
    helper = multiprocessing.Process(target=time.sleep, args=(0,))
    helper.start()
    helper.join()
    blocked = [*signal.pthread_sigmask(signal.SIG_BLOCK, [])]
    return f"its helper ended with {helper.exitcode}, and it inherits {blocked}"

def names_its_gpu(progress):
    return f"on GPU {os.environ.get('CUDA_VISIBLE_DEVICES')}"

def ends_by(progress, number):
    os.kill(os.getpid(), number)
    time.sleep(600)

def dies_in_a_message(progress):
    # the length of a message and its first bytes, as a process leaves them that is killed while it writes
    is_open = lambda one: type(one) is Connection and not one.closed and one.writable
    for connection in filter(is_open, gc.get_objects()):
        os.write(connection.fileno(), struct.pack("!i", 1000) + bytes(10))
    os.kill(os.getpid(), signal.SIGKILL)

def interrupts(progress):
    raise KeyboardInterrupt("of its own")

def cancels(progress):
    raise asyncio.CancelledError("of its own")

def waits_for(progress, begun, end):
    Path(begun).touch()
    while not Path(end).exists():
        time.sleep(0.05)
    return "went well"

def steps_worlds(progress, awaited, end):
    # works until its team has had each awaited number of threads; after the first, another job may end
    team, deadline = Team(16), time.monotonic() + 30
    try:
        for most in awaited:
            names = set()
            while len(names) != most:
                assert time.monotonic() < deadline, f"{len(names)} threads, not {most}"
                names.clear()
                team.each(lambda _: (names.add(threading.get_ident()), time.sleep(0.02)), range(16))
                assert len(names) <= awaited[-1], f"{len(names)} threads, not {awaited[-1]}"
            Path(end).touch()
    finally:
        Path(end).touch()  # or the other job would never end
        team.close()
    return "went well"

def moves(progress, folder):
    from clbench.base.cache import cache_folder, minari_folder
    os.chdir(folder)
    return f"{cache_folder()} and {minari_folder()}"
"""


@pytest.fixture(autouse=True)
def _jobs_module(write_module: Callable[[str, str], None]) -> None:
    write_module("jobs_with_children", JOBS)


def _job(function: str, **arguments: Any) -> Job:
    return Job(function, getattr(importlib.import_module("jobs_with_children"), function), arguments, 1)


def test_the_children_of_a_job_end_with_it(tmp_path: Path, bars: Bars) -> None:
    path = tmp_path / "child"
    assert run_jobs([_job("leaves_a_child", path=str(path))], Processes(1), bars) == {}
    assert is_gone(int(path.read_text()))


def test_a_job_whose_forked_child_lives_on_is_lost_at_once(tmp_path: Path, bars: Bars) -> None:
    path, begin = tmp_path / "child", time.monotonic()
    (reason,) = run_jobs([_job("dies_beside_a_fork", path=str(path))], Processes(1), bars).values()
    assert reason == "its process ended without a result (exit code -9, SIGKILL)"
    assert time.monotonic() - begin < 300
    assert is_gone(int(path.read_text()))


@pytest.mark.parametrize(("number", "name"), [(9, "SIGKILL"), (40, "signal 40")])
def test_a_job_that_a_signal_ends_is_lost_with_its_name_or_number(number: int, name: str, bars: Bars) -> None:
    (reason,) = run_jobs([_job("ends_by", number=number)], Processes(1), bars).values()
    assert reason == f"its process ended without a result (exit code -{number}, {name})"


def test_a_job_that_dies_in_the_middle_of_a_message_is_lost(bars: Bars) -> None:
    (reason,) = run_jobs([_job("dies_in_a_message")], Processes(1), bars).values()
    assert reason == "its process ended without a result (exit code -9, SIGKILL)"


def test_closing_ends_a_job_that_ignores_it_and_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.jobs.processes.CLOSE_SECONDS", 0.2)
    suspends = signal.getsignal(signal.SIGTSTP)
    path, workers = tmp_path / "pids", Processes(1)
    workers.start(_job("stubborn", path=str(path)))
    while not (path.exists() and path.read_text()):
        time.sleep(0.05)
    workers.close()
    assert all(is_gone(int(pid)) for pid in path.read_text().split())
    assert (workers.free(), signal.getsignal(signal.SIGTSTP)) == (1, suspends)


def test_a_job_may_start_processes_of_its_own(bars: Bars) -> None:
    assert run_jobs([_job("has_a_helper")], Processes(1), bars) == {}
    assert "its helper ended with 0, and it inherits []" in printed(bars)  # no signal is blocked


@pytest.mark.parametrize("workers", [Processes, Here])
@pytest.mark.parametrize(
    ("function", "error"), [("interrupts", "KeyboardInterrupt"), ("cancels", "CancelledError")]
)
def test_an_interrupt_or_a_cancellation_that_a_job_raises_is_its_failure(
    function: str, error: str, workers: Callable[[], Processes | Here], bars: Bars
) -> None:
    (reason,) = run_jobs([_job(function)], workers(), bars).values()
    assert reason.startswith(f"{error}: of its own")


@pytest.mark.parametrize("seconds", [0.0, 1000.0])
def test_reports_add_up_to_the_progress_of_a_job(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clbench.jobs.processes.SEND_SECONDS", seconds)
    workers, found = Here(), list[Event]()
    workers.start(_job("thirds"))
    while not (found and found[-1].ends_job):
        found += workers.events()
    assert sum(event.value for event in found if event.kind == "progress") == 0.75


def test_what_is_announced_after_a_job_of_this_process_is_no_place_of_the_job() -> None:
    workers = Here()
    for job in (_job("interrupts"), _job("cancels")):
        workers.start(job)
        found = list[Event]()
        while not (found and found[-1].ends_job):
            found += workers.events()
        assert [event.job for event in found] == [job]
        announce("elsewhere")


def test_a_job_that_moves_finds_the_folders_of_data_where_they_were(
    tmp_path: Path, bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CLBENCH_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "caches")
    monkeypatch.setenv("MINARI_DATASETS_PATH", "data")
    assert (cache_folder(), minari_folder()) == (tmp_path / "caches/clbench", tmp_path / "data")
    assert run_jobs([_job("moves", folder=os.sep)], Processes(1), bars) == {}
    assert f"{tmp_path}/caches/clbench and {tmp_path}/data" in printed(bars)


def test_where_no_socket_can_be_made_an_error_names_the_variable_of_temporary_files(tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 110)
    folder.mkdir()
    code = (
        "from clbench.jobs.job import Job; from clbench.jobs.processes import Processes\n"
        "Processes(1).start(Job('prints', print, {}, 1))"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "TMPDIR": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "InputError: No worker can start: AF_UNIX path too long. " in found.stderr
    assert "set TMPDIR" in found.stderr


def test_a_limit_on_open_files_is_not_blamed_on_the_folder_of_temporary_files() -> None:
    code = (
        "import os, resource; from multiprocessing import resource_tracker\n"
        "from clbench.jobs.job import Job; from clbench.jobs.processes import Processes\n"
        "workers = Processes(1); resource_tracker.ensure_running()\n"
        "most = len(os.listdir('/proc/self/fd')) + 1\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))\n"
        "workers.start(Job('prints', print, {}, 1))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "InputError: No worker can start: [Errno 24] Too many open files. " in found.stderr
    assert "ulimit" in found.stderr
    assert "TMPDIR" not in found.stderr


def test_leases_are_given_back_if_closing_is_interrupted(tmp_path: Path, bars: Bars) -> None:
    class Interrupted(Processes):
        def events(self) -> Any:
            raise KeyboardInterrupt

        def close(self) -> None:
            super().close()
            raise SystemExit

    job = _job("has_a_helper")
    claimed = [
        Job(job.title, job.function, {}, 1, product=Product(tmp_path / name, lambda: False))
        for name in ("made", "made too")
    ]
    with pytest.raises(SystemExit) as stopped:  # its traceback keeps the leases from the garbage collector
        run_jobs(claimed, Interrupted(2), bars)
    assert not list(tmp_path.glob(".made*"))
    assert stopped.value.code is None


COMMAND = """
import signal
from multiprocessing.context import BaseContext
from jobs_with_children import FUNCTION
from clbench.jobs.job import Job
from clbench.jobs.processes import Processes

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell began the tests with &
    BaseContext.set_forkserver_preload = lambda *_: None  # this job needs no PyTorch
    workers = Processes(1)
    workers.start(Job("job", FUNCTION, {"path": "worker"}, 1))
    try:
        while True:
            list(workers.events())
    finally:
        workers.close()
"""


def _command(function: str, folder: Path) -> subprocess.Popen[bytes]:
    """Start a command with one worker, which writes its process id to the file `worker`."""
    (folder / "command.py").write_text(COMMAND.replace("FUNCTION", function), encoding="utf-8")
    (folder / "jobs_with_children.py").write_text(JOBS, encoding="utf-8")
    arguments = [sys.executable, "command.py"]
    return subprocess.Popen(arguments, cwd=folder, start_new_session=True, stderr=subprocess.DEVNULL)


@pytest.mark.long
def test_a_worker_ends_soon_after_its_command_was_killed(tmp_path: Path) -> None:
    command = _command("goes_on", tmp_path)
    try:
        worker = _read_number(tmp_path / "worker")
    finally:
        command.kill()
        command.wait()
    assert is_gone(worker)


@pytest.mark.long
def test_ctrl_z_stops_the_workers_with_the_command_and_they_go_on_with_it(tmp_path: Path) -> None:
    command = _command("waits", tmp_path)
    try:
        processes = [command.pid, _read_number(tmp_path / "worker")]
        command.send_signal(signal.SIGTSTP)
        assert _all_become(processes, stopped=True)
        command.send_signal(signal.SIGCONT)
        assert _all_become(processes, stopped=False)
        command.send_signal(signal.SIGINT)
        command.wait(60)
    finally:
        command.kill()
        command.wait()
    assert is_gone(processes[1])


def test_the_time_for_which_a_command_is_stopped_does_not_count_for_a_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill, stopped = os.kill, 0

    def stop(process: int, number: int) -> None:
        nonlocal stopped
        if process == os.getpid():
            stopped += 7200
        else:
            kill(process, number)

    begun, end = tmp_path / "begun", tmp_path / "end"
    limits = Limits(seconds=3600)
    signal.signal(signal.SIGTSTP, signal.SIG_DFL)  # workers of another test may not have been closed
    workers = Processes(1)
    suspend = signal.getsignal(signal.SIGTSTP)
    workers.start(dataclasses.replace(_job("waits_for", begun=begun, end=end), limits=limits))
    while not begun.exists():
        time.sleep(0.05)
    clock = types.SimpleNamespace(monotonic=lambda: time.monotonic() + stopped)
    monkeypatch.setattr("clbench.jobs.processes.time", clock)
    monkeypatch.setattr("os.kill", stop)
    assert callable(suspend)
    suspend(signal.SIGTSTP, None)
    events = list(workers.events())  # it looks at the limits first
    end.touch()
    while not any(event.ends_job for event in events):
        events += workers.events()
    workers.close()
    assert (stopped, events[-1].kind, events[-1].value) == (7200, "done", "went well")


def _read_number(path: Path) -> int:
    """Return the number in a file, as soon as it is there."""
    for _ in range(600):
        if path.is_file() and path.read_text():
            return int(path.read_text())
        time.sleep(0.1)
    raise AssertionError(f"{path} did not appear within a minute")


def _all_become(processes: list[int], *, stopped: bool) -> bool:
    """Return whether all processes are stopped, or none is, within a minute."""
    for _ in range(600):
        states = [psutil.Process(one).status() == psutil.STATUS_STOPPED for one in processes]
        if set(states) == {stopped}:
            return True
        time.sleep(0.1)
    return False


def test_runs_on_cuda_have_a_gpu_each_and_as_many_go_at_once(
    bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,MIG-5,6")
    assert (at_once("cuda"), at_once("cuda:1"), at_once("cpu")) == (2, 1, cores())
    workers = Processes(device="cuda")
    assert workers.free() == 2
    elsewhere = _job("names_its_gpu")
    runs = [dataclasses.replace(elsewhere, title=f"run {n}", length=4 - n, device="cuda") for n in range(3)]
    assert run_jobs([*runs, elsewhere], workers, bars) == {}
    lines = [line.partition(" (")[0] for line in printed(bars).splitlines()]
    assert {"run 0: on GPU 3", "run 1: on GPU MIG-5"} <= set(lines)
    assert {"run 2: on GPU 3", "run 2: on GPU MIG-5"} & set(lines)
    assert "names_its_gpu: on GPU 3,MIG-5,6" in lines


@pytest.mark.parametrize(("workers", "awaited"), [(4, [2, 4]), (2, [1, 2]), (20, [8, 8])])
def test_the_worlds_of_a_job_step_with_an_equal_share_of_up_to_8_workers_which_grows_as_others_end(
    workers: int, awaited: list[int], tmp_path: Path, bars: Bars
) -> None:
    begun, end = str(tmp_path / "begun"), str(tmp_path / "end")
    jobs = [_job("waits_for", begun=begun, end=end), _job("steps_worlds", awaited=awaited, end=end)]
    assert run_jobs(jobs, Processes(workers), bars) == {}


@pytest.mark.parametrize(("workers", "threads"), [(Processes, 1), (Here, 1), (Here, 3)])
def test_the_worlds_of_the_only_job_step_with_as_many_threads_as_there_are_workers(
    workers: Callable[[int], Processes | Here], threads: int, tmp_path: Path, bars: Bars
) -> None:
    job = _job("steps_worlds", awaited=[threads, threads], end=str(tmp_path / "end"))
    assert run_jobs([job], workers(threads), bars) == {}
    assert threads_of_job() == 1  # no share is left in this process
