"""The scheduler: processes that work, fail, die and are stopped."""

import dataclasses
import importlib
import io
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Hashable, Iterator
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import pytest
from helpers import printed
from rich.console import Console
from tiny import TINY

from clbench.base.errors import InputError
from clbench.base.lease import Lease
from clbench.jobs.bars import Bars
from clbench.jobs.job import Event, Job, Product
from clbench.jobs.plan import Plan
from clbench.jobs.processes import Here, Processes
from clbench.jobs.recorded import has_record
from clbench.jobs.scheduler import run_jobs, run_with_bars
from clbench.runs.spec import RunSpec

TOY = "clbench.testing:clbench/Toy-v0"

JOBS = """
import os, signal, threading, time
from pathlib import Path

def good(progress, path=None):
    progress(1)
    if path: Path(path).write_text("done")
    return "went well"

def loses_its_lease(progress, path):
    from clbench.base.lease import LeaseLostError
    if Path(path).exists(): return "went well"
    Path(path).write_text("tried")
    raise LeaseLostError("lost to another process")

def bad(progress):
    raise ValueError("went wrong")

def killed(progress):
    os.kill(os.getpid(), signal.SIGKILL)

def leaves_a_thread(progress):
    threading.Thread(target=time.sleep, args=(600,)).start()
    return "went well"

def leaves(progress):
    raise SystemExit("for good")

def reads(progress, name):
    return os.environ.get(name, "unset")

def waits(progress):
    from clbench.base.progress import remark
    remark("waiting for process 12 to make x")
    return "went well"

def slow(progress, path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def _jobs_module(write_module: Callable[[str, str], None]) -> None:
    write_module("some_jobs", JOBS)


def _job(title: str, function: str, *needs: Job, **arguments: Any) -> Job:
    return Job(title, _function(function), arguments, 1, needs)


def _function(name: str) -> Callable[..., str]:
    found: Callable[..., str] = getattr(importlib.import_module("some_jobs"), name)
    return found


def _plan(records: Path, *specs: RunSpec) -> list[Job]:
    plan = Plan()
    for spec in specs:
        plan.add_run(spec.resolve(), records)
    return plan.jobs


def test_a_job_starts_after_the_jobs_that_it_needs(tmp_path: Path, bars: Bars) -> None:
    first = _job("first", "good", path=str(tmp_path / "1"))
    second = _job("second", "good", first, path=str(tmp_path / "2"))
    assert run_jobs([second, first], Processes(2), bars) == {}
    assert (tmp_path / "1").stat().st_mtime_ns < (tmp_path / "2").stat().st_mtime_ns
    assert "first: went well" in printed(bars)


def test_a_job_that_fails_or_is_killed_does_not_stop_the_others(bars: Bars) -> None:
    wrong, dead, fine = _job("wrong", "bad"), _job("dead", "killed"), _job("fine", "good")
    hopeless = _job("hopeless", "good", dead)
    jobs = [wrong, dead, hopeless, _job("worse", "good", hopeless), fine]
    failed = {job.title: reason for job, reason in run_jobs(jobs, Processes(2), bars).items()}
    assert set(failed) == {"wrong", "dead", "hopeless", "worse"}
    assert "ValueError: went wrong" in failed["wrong"]
    assert "exit code -9" in failed["dead"]
    assert failed["hopeless"] == "left out, because dead failed"
    assert "fine: went well" in printed(bars)


def _damaged() -> bool:
    raise InputError("the record cannot be read")


@pytest.mark.long
def test_a_job_that_failed_elsewhere_or_cannot_be_judged_does_not_start_and_stops_no_other(
    tmp_path: Path, bars: Bars
) -> None:
    (tmp_path / "file").touch()
    places = {"failed": "a", "unreadable": "b", "locked out": "file/c", "fine": "d"}
    jobs = {name: _claimed(name, tmp_path / place) for name, place in places.items()}
    failed = Product(tmp_path / "a", exists=lambda: False, has_failed=lambda: True)
    jobs["failed"] = dataclasses.replace(jobs["failed"], product=failed)
    unreadable = Product(tmp_path / "b", exists=_damaged)
    jobs["unreadable"] = dataclasses.replace(jobs["unreadable"], product=unreadable)
    found = {job.title: reason for job, reason in run_jobs([*jobs.values()], Processes(1), bars).items()}
    assert found.pop("locked out").startswith("its lease cannot be written: ")
    assert found == {"failed": "failed in another command", "unreadable": "the record cannot be read"}
    assert {path.name for path in tmp_path.iterdir()} <= {"d", "file", "some_jobs.py", "__pycache__"}


def _claimed(title: str, makes: Path) -> Job:
    job = _job(title, "good", path=str(makes))
    return dataclasses.replace(job, product=Product(makes, makes.exists))


HOLD = """
import sys, time
from pathlib import Path
from clbench.base.lease import Lease
made = Path(sys.argv[1])
lease = Lease(made)
assert lease.take()
print("taken", flush=True)
while not made.with_name("other").exists(): time.sleep(0.05)
time.sleep(1)
if sys.argv[2] == "finish": made.write_text("made elsewhere")
"""


@pytest.mark.long
@pytest.mark.parametrize(("end", "text"), [("finish", "made elsewhere"), ("die", "done")])
def test_a_job_that_another_command_does_waits_for_it(
    tmp_path: Path, bars: Bars, end: str, text: str
) -> None:
    made = tmp_path / "made"
    command = [sys.executable, "-c", HOLD, str(made), end]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "taken\n"
        jobs = [_claimed("claimed", made), _claimed("other", tmp_path / "other")]
        assert run_jobs(jobs, Processes(1), bars) == {}
    assert made.read_text() == text
    text = printed(bars)
    assert text.index("other: went well") < text.index("claimed: ")
    assert f"Another command is doing the last job; waiting for process {other.pid} on " in text
    assert ("claimed: done by another command" in text) == (end == "finish")
    assert {path.name for path in tmp_path.iterdir()} <= {"made", "other", "some_jobs.py", "__pycache__"}


def test_a_job_whose_work_another_process_took_over_is_done_later(tmp_path: Path, bars: Bars) -> None:
    taken = _job("taken", "loses_its_lease", path=str(tmp_path / "x"))
    assert run_jobs([taken], Processes(1), bars) == {}
    assert "taken: lost to another process" in printed(bars)
    assert "taken: went well" in printed(bars)


def test_a_job_that_leaves_a_thread_behind_ends_with_its_result(
    bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.jobs.processes.LEAVE_SECONDS", 0.2)
    begin = time.monotonic()
    assert run_jobs([_job("loose", "leaves_a_thread"), _job("next", "good")], Processes(1), bars) == {}
    assert time.monotonic() - begin < 500
    assert "next: went well" in printed(bars)


def test_a_job_of_this_process_that_leaves_it_fails_with_its_words(bars: Bars) -> None:
    failed = run_jobs([_job("leaver", "leaves")], Here(), bars)
    assert "it ended its process (for good)" in str(failed)


def test_a_variable_that_is_unset_is_unset_in_the_next_worker(
    bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLBENCH_SOME_PLACE", "somewhere")
    assert run_jobs([_job("before", "reads", name="CLBENCH_SOME_PLACE")], Processes(1), bars) == {}
    monkeypatch.delenv("CLBENCH_SOME_PLACE")
    assert run_jobs([_job("after", "reads", name="CLBENCH_SOME_PLACE")], Processes(1), bars) == {}
    assert "before: somewhere" in printed(bars)
    assert "after: unset" in printed(bars)


def test_stopping_the_scheduler_ends_its_processes(
    tmp_path: Path, bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "pid"

    def interrupt(*_: Any, **__: Any) -> list[Any]:
        while not path.exists() or not path.read_text():
            time.sleep(0.05)
        raise KeyboardInterrupt

    monkeypatch.setattr("clbench.jobs.processes.wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_jobs([_job("slow", "slow", path=str(path))], Processes(1), bars)
    with pytest.raises(ProcessLookupError):
        os.kill(int(path.read_text()), 0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_ctrl_c_while_a_job_starts_is_not_lost(
    number: signal.Signals, tmp_path: Path, bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    ensure_running, path = forkserver.ensure_running, tmp_path / "pid"

    def interrupted() -> None:
        signal.raise_signal(number)
        ensure_running()

    monkeypatch.setattr(forkserver, "ensure_running", interrupted)
    before = signal.signal(number, signal.default_int_handler)  # tests may run where it is ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            run_jobs([_job("slow", "slow", path=str(path))], Processes(1), bars)
    finally:
        signal.signal(number, before)
    if path.exists() and path.read_text():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


def test_jobs_on_the_longest_chain_start_first(bars: Bars) -> None:
    good = _function("good")
    pretraining = Job("pretraining of the long run", good, {}, 2.0)
    jobs = [
        Job("short run", good, {}, 1.0),
        Job("long run", good, {}, 9.0, (pretraining,)),
        pretraining,
        Job("middle run", good, {}, 5.0),
        Job("run that goes fast", good, {}, 8.0, pace=0.5),
    ]
    assert run_jobs(jobs, Processes(1), bars) == {}
    ended = [line.partition(":")[0] for line in printed(bars).splitlines()]
    assert ended == [
        "pretraining of the long run",
        "long run",
        "middle run",
        "run that goes fast",
        "short run",
    ]


class _Two:
    """Workers that report half of a job's length before they have done it."""

    def __init__(self) -> None:
        self._events: list[Event] = []

    def free(self) -> int:
        return 2

    def start(self, job: Job) -> None:
        self._events += [Event(job, "progress", job.length / 2), Event(job, "done", "went well")]

    def events(self) -> Iterator[Event]:
        while self._events:
            yield self._events.pop(0)

    def close(self) -> None:
        pass


def test_jobs_that_are_done_already_are_not_waited_for(tmp_path: Path, bars: Bars) -> None:
    jobs = [_claimed(name, tmp_path / name) for name in ("one", "two", "three")]
    for job in jobs:
        (tmp_path / job.title).touch()
    assert run_jobs(jobs, _Two(), bars) == {}
    assert [line.partition(":")[2] for line in printed(bars).splitlines()] == [" done by another command"] * 3


def test_a_done_job_keeps_no_lease(tmp_path: Path, bars: Bars, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x").touch()
    there: list[list[str]] = []
    monkeypatch.setattr(bars, "skip", lambda *_: there.append(os.listdir(tmp_path)))
    assert run_jobs([_claimed("x", tmp_path / "x")], _Two(), bars) == {}
    assert ".x.lease" not in there[0]


def test_without_a_free_worker_the_scheduler_waits_for_one_and_says_so_once(
    bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.jobs.scheduler.WAIT_SECONDS", 0.0)

    class Late(_Two):
        """Workers of a cluster that has no core at first."""

        looks = 0

        def free(self) -> int:
            self.looks += 1
            return 0 if self.looks < 9 else 2

    good = _function("good")
    assert run_jobs([Job("one", good, {}, 1.0), Job("other", good, {}, 1.0)], Late(), bars) == {}
    first, *rest = printed(bars).splitlines()
    assert first == "No worker is free for the last 2 jobs; waiting for one."
    assert [line.partition(":")[0] for line in rest] == ["one", "other"]


def test_an_idle_worker_asks_for_the_job_of_another_command_once_a_second(
    tmp_path: Path, bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, asked = Lease.take, list[float]()

    def take(lease: Lease) -> bool:
        asked.append(time.monotonic())
        return usual(lease)

    class Busy(_Two):
        """Workers of which one reports progress again and again."""

        turns = 0

        def events(self) -> Iterator[Event]:
            self.turns += 1
            if self.turns < 200:
                yield Event(self._events[0].job, "progress", 0.0)
            else:
                owner.release()
                yield from super().events()

    owner = Lease(tmp_path / "x")
    assert owner.take()
    monkeypatch.setattr(Lease, "take", take)
    busy = Job("busy", _function("good"), {}, 9.0)
    assert run_jobs([busy, _claimed("claimed", tmp_path / "x")], Busy(), bars) == {}
    assert len(asked) >= 2
    assert all(later - earlier >= 1.0 for earlier, later in itertools.pairwise(asked))


def test_a_job_that_waits_is_shown_without_a_terminal(bars: Bars, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clbench.jobs.bars.LINE_SECONDS", 0.0)
    assert run_jobs([_job("sft seed 0", "waits")], Processes(1), bars) == {}
    assert "  0%: sft seed 0, waiting for process 12 to make x\n" in printed(bars)


def test_progress_is_counted_in_the_expected_time_of_each_job(monkeypatch: pytest.MonkeyPatch) -> None:
    totals, advanced = [], []

    class Watched(Bars):
        def __init__(self, total: float, console: Console | None = None) -> None:
            totals.append(total)
            super().__init__(total, console)

        def advance(self, piece: Hashable, amount: float) -> None:
            advanced.append(amount)
            super().advance(piece, amount)

    monkeypatch.setattr("clbench.jobs.scheduler.Bars", Watched)
    monkeypatch.setattr("clbench.jobs.bars.AT_ONCE", 0.0)  # these jobs take no second, and count all the same
    good = _function("good")
    jobs = [Job("fast", good, {}, 60.0, pace=0.5), Job("slow", good, {}, 70.0)]
    assert run_with_bars(jobs, _Two(), Console(file=io.StringIO())) == {}
    assert totals == [30 + 70]
    assert advanced == [35, 35, 15, 15]


@pytest.mark.long
def test_one_worker_and_two_make_equal_records_and_a_stopped_benchmark_continues(
    tmp_path: Path, bars: Bars, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    specs = [RunSpec(f"tiny:{TINY.id}", method, 0, targets=1) for method in ("frozen", "sft", "joint")]
    assert run_jobs(_plan(tmp_path / "one", *specs), Processes(1), bars) == {}
    assert run_jobs(_plan(tmp_path / "two", *specs[:1]), Processes(2), bars) == {}
    missing = [spec for spec in specs if not has_record(spec.resolve(), tmp_path / "two")]
    assert missing == specs[1:]
    assert run_jobs(_plan(tmp_path / "two", *missing), Processes(2), bars) == {}
    records = lasting_records(tmp_path / "one")
    assert len(records) == 3
    assert records == lasting_records(tmp_path / "two")


def _is_gone(group: int) -> bool:
    """Return whether all processes of a group end within a minute."""
    for _ in range(600):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.parametrize(
    ("send", "stop", "code", "said"),
    [
        pytest.param(os.killpg, signal.SIGINT, 130, "Finished records are kept", id="ctrl-c"),
        pytest.param(os.kill, signal.SIGTERM, 143, "Finished records are kept", id="scheduler"),
    ],
)
@pytest.mark.slow
def test_stopping_the_command_ends_its_workers_and_keeps_finished_records(
    tmp_path: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
    send: Callable[[int, int], None],
    stop: int,
    code: int,
    said: str,
) -> None:
    command = [sys.executable, "-m", "clbench", "run", TOY, "frozen", "sft", "joint", "--seeds", "1"]
    command += ["--workers", "1", "--records", str(tmp_path / "records")]
    process = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # tests that run in the background of a shell ignore Ctrl-C, and so would this process
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    first = tmp_path / "records" / "Toy-v0" / "frozen" / "seed-0.json"
    deadline = time.monotonic() + 600
    while not first.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    send(process.pid, stop)
    _, output = process.communicate(timeout=600)
    assert process.returncode == code
    assert said in output
    assert "Traceback" not in output
    assert _is_gone(process.pid)
    records = lasting_records(tmp_path / "records")
    assert "Toy-v0/frozen/seed-0.json" in records
    assert len(records) < 3
