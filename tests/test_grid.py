"""The grid: processes that work, fail, die and are stopped."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from clbench.grid import Job, benchmark_jobs, run_jobs
from clbench.progress import Bars
from clbench.run import RunSpec, has_record

TOY = "clbench.testing:clbench/Toy-v0"

JOBS = """
import os, signal, time
from pathlib import Path

def good(progress, path=None):
    progress(1)
    if path: Path(path).write_text("done")
    return "went well"

def bad(progress):
    raise ValueError("went wrong")

def killed(progress):
    os.kill(os.getpid(), signal.SIGKILL)

def slow(progress, path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)
"""


@pytest.fixture
def bars() -> Bars:
    return Bars(10, Console(file=io.StringIO(), width=200))


@pytest.fixture(autouse=True)
def _jobs_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some_jobs.py").write_text(JOBS)
    monkeypatch.syspath_prepend(tmp_path)


def _job(name: str, function: str, *needs: str, **arguments: Any) -> Job:
    return Job(name, f"some_jobs:{function}", arguments, 1, needs)


def _printed(bars: Bars) -> str:
    assert isinstance(bars.console.file, io.StringIO)
    return bars.console.file.getvalue()


def test_a_job_starts_after_what_it_needs(tmp_path: Path, bars: Bars) -> None:
    jobs = [
        _job("second", "good", "first", path=str(tmp_path / "2")),
        _job("first", "good", path=str(tmp_path / "1")),
    ]
    assert run_jobs(jobs, 2, bars) == {}
    assert (tmp_path / "1").stat().st_mtime_ns < (tmp_path / "2").stat().st_mtime_ns
    assert "first: went well" in _printed(bars)


def test_a_job_that_fails_or_is_killed_does_not_stop_the_others(bars: Bars) -> None:
    jobs = [
        _job("wrong", "bad"),
        _job("dead", "killed"),
        _job("hopeless", "good", "dead"),
        _job("worse", "good", "hopeless"),
        _job("fine", "good"),
    ]
    failed = run_jobs(jobs, 2, bars)
    assert set(failed) == {"wrong", "dead", "hopeless", "worse"}
    assert "ValueError: went wrong" in failed["wrong"]
    assert "exit code -9" in failed["dead"]
    assert failed["hopeless"] == "left out, because dead failed"
    assert "fine: went well" in _printed(bars)


def test_stopping_the_grid_ends_its_processes(
    tmp_path: Path, bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "pid"

    def interrupt(*_: Any, **__: Any) -> list[Any]:
        while not path.exists() or not path.read_text():
            time.sleep(0.05)
        raise KeyboardInterrupt

    monkeypatch.setattr("clbench.grid.wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_jobs([_job("slow", "slow", path=str(path))], 1, bars)
    with pytest.raises(ProcessLookupError):
        os.kill(int(path.read_text()), 0)


def _records(folder: Path) -> dict[str, Any]:
    found = {}
    for path in sorted(folder.rglob("*.json")):
        record = json.loads(path.read_text())
        del record["timing"]
        found[path.relative_to(folder).as_posix()] = record
    return found


def test_one_worker_and_two_give_equal_records_and_a_stopped_grid_goes_on(
    empty_caches: Path, bars: Bars
) -> None:
    specs = [RunSpec(TOY, method, seed) for seed in (0, 1) for method in ("sft", "frozen")]
    assert run_jobs(benchmark_jobs(specs, empty_caches / "one"), 1, bars) == {}
    assert run_jobs(benchmark_jobs(specs[:1], empty_caches / "two"), 2, bars) == {}
    missing = [spec for spec in specs if not has_record(spec, empty_caches / "two")]
    assert missing == specs[1:]
    assert run_jobs(benchmark_jobs(missing, empty_caches / "two"), 2, bars) == {}
    records = _records(empty_caches / "one")
    assert len(records) == 4
    assert records == _records(empty_caches / "two")


def _is_gone(group: int) -> bool:
    """Return whether no process of a group is left, within 10 seconds."""
    for _ in range(100):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize(
    ("send", "stop", "code", "said"),
    [(os.killpg, signal.SIGINT, 130, "Finished records are kept"), (os.kill, signal.SIGTERM, 143, "")],
    ids=["ctrl-c", "scheduler"],
)
def test_stopping_the_command_ends_its_workers_and_keeps_finished_records(
    empty_caches: Path, send: Callable[[int, int], None], stop: int, code: int, said: str
) -> None:
    command = [sys.executable, "-m", "clbench", "run", TOY, "frozen", "sft", "joint", "--seeds", "1"]
    command += ["--workers", "1", "--records", str(empty_caches / "records")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    first = empty_caches / "records" / "Toy-v0" / "frozen" / "seed-0.json"
    deadline = time.monotonic() + 100
    while not first.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    send(process.pid, stop)
    _, output = process.communicate(timeout=60)
    assert process.returncode == code
    assert said in output
    assert "Traceback" not in output
    assert _is_gone(process.pid)
    records = _records(empty_caches / "records")
    assert "Toy-v0/frozen/seed-0.json" in records
    assert len(records) < 3
