"""Teams: each piece of work is done once, and no thread outlives its team."""

import gc
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import output_of

from clbench.worlds.threads import Copies, Team, cores, share_cores, threads_of_job


class Owner:
    """Owns a team and works with it, like a vector world."""

    def __init__(self) -> None:
        self.team = Team(3)
        self.team.each(self.rest, [0.01] * 3)

    def rest(self, seconds: float) -> None:
        time.sleep(seconds)


def _own_threads(before: set[threading.Thread]) -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread not in before]


@pytest.fixture
def before() -> Iterator[set[threading.Thread]]:
    """Return the threads of other tests, which may end at any time; the test must leave no thread behind."""
    before = set(threading.enumerate())
    yield before
    assert _own_threads(before) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_a_team_does_each_piece_once_and_goes_on_after_one_that_failed(threads: int) -> None:
    team, done = Team(threads), list[int]()

    def work(item: int) -> None:
        if item == 7:
            raise ValueError("no seven")
        done.append(item)

    team.each(work, range(5))
    assert sorted(done) == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="no seven"):
        team.each(work, [7, 7])
    team.each(work, [])
    team.each(work, [5])
    assert sorted(done) == [0, 1, 2, 3, 4, 5]
    team.close()


def test_a_closed_team_has_ended_its_threads_and_works_with_the_calling_thread(
    before: set[threading.Thread],
) -> None:
    team = Team(3)
    team.each(time.sleep, [0.01] * 3)
    assert len(_own_threads(before)) == 2
    team.close()
    assert _own_threads(before) == []
    team.close()
    names: list[str] = []
    team.each(lambda _: names.append(threading.current_thread().name), range(3))
    assert names == [threading.current_thread().name] * 3


def test_a_team_that_nobody_closed_leaves_no_thread_behind(before: set[threading.Thread]) -> None:
    team = Team(3)
    team.each(time.sleep, [0.01] * 3)
    assert len(_own_threads(before)) == 2
    del team
    assert _own_threads(before) == []


@pytest.mark.long
def test_a_team_ends_with_an_owner_whose_method_its_threads_called(before: set[threading.Thread]) -> None:
    owner = Owner()
    assert len(_own_threads(before)) == 2
    del owner
    gc.collect()
    assert _own_threads(before) == []


def test_a_team_that_one_of_its_threads_drops_does_not_wait_for_itself(
    before: set[threading.Thread],
) -> None:
    teams, dropped = [Team(2)], threading.Event()

    def drop(_: int) -> None:
        if threading.current_thread() is not threading.main_thread() and teams:
            teams.pop().close()
            dropped.set()
        dropped.wait(60)

    teams[0].each(drop, range(2))
    assert dropped.is_set()
    deadline = time.monotonic() + 60
    while _own_threads(before) and time.monotonic() < deadline:
        time.sleep(0.01)


def test_a_team_uses_as_many_threads_as_the_share_of_its_job_allows_at_the_moment() -> None:
    team, share = Team(3), [1]

    def check(expected: int) -> None:
        names, together = set[str](), threading.Barrier(expected)

        def work(_: int) -> None:
            names.add(threading.current_thread().name)
            together.wait(timeout=60)

        team.each(work, range(12))
        assert len(names) == expected

    assert threads_of_job() == 1  # this process has no share
    share_cores(lambda: share[0])
    try:
        for share[0], expected in ((1, 1), (2, 2), (8, 3), (1, 1)):
            check(expected)
        assert threads_of_job() == cores()
    finally:
        share_cores(None)
    check(3)
    team.close()


def test_a_team_goes_on_with_fewer_threads_where_the_machine_has_no_more(
    before: set[threading.Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[threading.Thread] = []
    start = threading.Thread.start

    def start_one(thread: threading.Thread) -> None:
        tries.append(thread)
        if len(tries) > 1:
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_one)
    team, done = Team(4), list[int]()
    for _ in range(2):
        team.each(done.append, range(6))
    assert sorted(done) == sorted([*range(6)] * 2)
    assert len(tries) == 2
    team.close()


def test_a_forked_process_works_with_its_own_thread(before: set[threading.Thread]) -> None:
    # a process of its own: pytest and its workers have threads
    code = (
        "import os\n"
        "from clbench.worlds.threads import Team\n"
        "team, done = Team(3), []\n"
        "team.each(lambda _: None, range(3))\n"
        "child = os.fork()\n"
        "team.each(done.append, range(5))\n"
        "assert sorted(done) == list(range(5))\n"
        "if child:\n"
        "    assert os.waitpid(child, 0)[1] == 0\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=60)


def test_an_interpreter_exits_at_once_with_a_team_that_nobody_closed() -> None:
    code = "from clbench.worlds.threads import Team; team = Team(3); done = []; team.each(done.append, 'abc')"
    code += "; print(sorted(done))"
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=600, check=True
    )
    assert (ended.stdout, ended.stderr) == ("['a', 'b', 'c']\n", "")


@pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="a process cannot be held to some cores here"
)
def test_only_the_cores_that_this_process_may_use_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
    code += "from clbench.worlds.threads import cores; print(cores())"
    assert output_of(code) == "1"
    monkeypatch.setattr("clbench.worlds.threads.PROCESS_CGROUPS", tmp_path / "no cgroup")
    assert cores() == len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/", {"cpu.max": "400000 100000"}, 4),
        ("0::/", {"cpu.max": "450000 100000"}, 5),
        ("0::/", {"cpu.max": "50000 100000"}, 1),
        ("0::/", {"cpu.max": "max 100000"}, 128),
        ("0::/", {"cpu.max": "25600000 100000"}, 128),
        ("0::/", {}, 128),
        ("0::/pod/run", {"pod/run/cpu.max": "max 100000", "pod/cpu.max": "300000 100000"}, 3),
        ("0::/pod/run", {"pod/run/cpu.max": "200000 100000", "pod/cpu.max": "300000 100000"}, 2),
        ("0::/docker/of-the-machine", {"cpu.max": "400000 100000"}, 4),
        ("3:cpu,cpuacct:/pod\n1:memory:/", {"cpu/pod/cpu.cfs": "250000 100000"}, 3),
        ("3:cpu,cpuacct:/pod\n0::/", {"cpu/pod/cpu.cfs": "-1 100000", "cpu/cpu.cfs": "700000 100000"}, 7),
        ("3:cpuset:/pod", {"cpu/pod/cpu.cfs": "250000 100000"}, 128),
    ],
)
def test_a_cpu_quota_of_a_control_group_or_its_parents_limits_the_cores(
    groups: str,
    files: dict[str, str],
    expected: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(128), raising=False)
    monkeypatch.setattr("clbench.worlds.threads.PROCESS_CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr("clbench.worlds.threads.CGROUPS", tmp_path)
    (tmp_path / "cgroup").write_text(groups + "\n", encoding="utf-8")
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith(".cfs"):  # version 1 has two files
            quota, period = text.split()
            (path.parent / "cpu.cfs_quota_us").write_text(quota + "\n", encoding="utf-8")
            (path.parent / "cpu.cfs_period_us").write_text(period + "\n", encoding="utf-8")
        else:
            path.write_text(text + "\n", encoding="utf-8")
    assert cores() == expected


@pytest.mark.parametrize("at", ["the caller works", "the caller waits"])
def test_an_interrupted_call_returns_when_no_thread_works_any_more(
    at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    team, done, begun = Team(3), list[int](), threading.Barrier(3)
    caller = threading.current_thread()

    def work(item: int) -> None:
        begun.wait()
        if threading.current_thread() is not caller:
            time.sleep(0.1 * item)
            done.append(item)
        elif at == "the caller works":
            raise KeyboardInterrupt

    if at == "the caller waits":
        team.each(lambda _: None, [1, 2, 3])  # starts the threads
        ended, interrupted = team._helpers[0].ended, list[bool]()

        class Queue:
            put = ended.put

            def get(self) -> Exception | None:
                if not interrupted:
                    interrupted.append(True)
                    raise KeyboardInterrupt
                return ended.get()

        monkeypatch.setattr(team._helpers[0], "ended", Queue())
    with pytest.raises(KeyboardInterrupt):
        team.each(work, [1, 2, 3])
    assert len(done) == 2
    team.each(done.append, [5, 6, 7])
    assert sorted(done[2:]) == [5, 6, 7]
    team.close()


# ---- copies ----------------------------------------------------------------------------------------------


def test_nobody_gets_what_another_has_taken_and_a_copy_is_made_only_then() -> None:
    made: list[str] = []

    def copied() -> str:
        made.append("copy")
        return f"copy {len(made)}"

    copies = Copies("first", copied)
    assert copies.take() == "first"
    copies.give_back("first")
    assert [copies.take(), copies.take(), copies.take()] == ["first", "copy 1", "copy 2"]
    copies.give_back("copy 1")
    assert copies.take() == "copy 1"
    assert len(made) == 2
