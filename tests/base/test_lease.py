"""Leases, with owners in other processes."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from clbench.base import lease as leases
from clbench.base.lease import Lease, LeaseLostError, lease_path
from clbench.base.progress import announce, listen

HOLD = """
import sys, time
from pathlib import Path
from clbench.base.lease import Lease
lease = Lease(Path(sys.argv[1]))
assert lease.take()
lease.report(0.25)
print("taken", flush=True)
time.sleep(60)
"""


@pytest.fixture
def other(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Return a process that holds the lease of the file x."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "x")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "taken\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_lease_has_one_owner(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    lease = Lease(tmp_path / "x")
    assert not lease.take()
    owner, progress = lease.owner, lease.progress
    assert owner is not None
    assert owner.process == other.pid
    assert progress is not None
    assert progress.share == 0.25


def test_the_lease_of_a_dead_process_is_taken_over_at_once(
    tmp_path: Path, other: subprocess.Popen[str]
) -> None:
    lease = Lease(tmp_path / "x")
    other.kill()
    other.wait()
    assert lease.owner is None
    assert lease.take()
    lease.release()
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def _like_nfs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the file system refuse to exchange two names, as NFS and Lustre do."""
    monkeypatch.setattr(leases, "SECONDS", 0.2)
    inside = [module for name, module in sys.modules.items() if name.startswith("filelock.")]
    for module in inside:  # each version keeps the function in another one, and others import it
        if hasattr(module, "exchange_names"):
            monkeypatch.setattr(module, "exchange_names", lambda *_: False)


def _from_elsewhere(path: Path) -> None:
    """Leave the lease that a process of another machine took with its last heartbeat."""
    lease = Lease(path)
    assert lease.take()
    text = lease_path(path).read_text()
    lease.release()
    host = next(line for line in text.splitlines() if line.startswith("host="))
    lease_path(path).write_text(text.replace(host, "host=elsewhere"))


def _with_other_seconds(path: Path) -> None:
    """Leave the lease that another version of clbench, with other `SECONDS`, took on another machine."""
    _from_elsewhere(path)
    text, seconds = lease_path(path).read_text(), f"duration={leases.SECONDS}"
    assert seconds in text
    lease_path(path).write_text(text.replace(seconds, f"duration={2 * leases.SECONDS}"))


@pytest.mark.usefixtures("_like_nfs")
@pytest.mark.parametrize(
    "leave", [_from_elsewhere, _with_other_seconds, lambda path: lease_path(path).touch()]
)
def test_a_lease_without_a_heartbeat_is_taken_over_where_names_cannot_be_exchanged(
    tmp_path: Path, leave: Callable[[Path], None]
) -> None:
    leave(tmp_path / "x")
    assert not Lease(tmp_path / "x").take()
    begin = time.monotonic()
    with Lease(tmp_path / "x").held():
        assert leases.SECONDS < time.monotonic() - begin < 60
        assert [path.name for path in tmp_path.iterdir()] == [".x.lease"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("_like_nfs")
def test_a_lease_without_a_heartbeat_is_removed_after_one_and_a_half_times_its_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lease_path(tmp_path / "x").touch()
    lease, now = Lease(tmp_path / "x"), [0.0]
    monkeypatch.setattr(leases, "time", SimpleNamespace(monotonic=lambda: now[0], time=time.time))
    for times, taken in ((0.0, False), (1.4, False), (1.6, True)):
        now[0] = times * leases.SECONDS
        assert lease.take() == taken
    lease.release()


@pytest.mark.usefixtures("_like_nfs")
def test_a_lease_with_a_heartbeat_stays_with_its_owner_where_names_cannot_be_exchanged(
    tmp_path: Path,
) -> None:
    _from_elsewhere(tmp_path / "x")
    lease, deadline = Lease(tmp_path / "x"), time.monotonic() + 4 * leases.SECONDS
    while time.monotonic() < deadline:
        os.utime(lease_path(tmp_path / "x"))
        assert not lease.take()
        time.sleep(0.05)


@pytest.mark.usefixtures("_like_nfs")
def test_a_new_owner_that_is_faster_keeps_its_lease(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _from_elsewhere(tmp_path / "x")
    slow, fast = Lease(tmp_path / "x"), Lease(tmp_path / "x")

    def rename(path: Path, target: Path) -> Path:
        if path == lease_path(tmp_path / "x"):  # between the last look of the slow process and its rename
            path.unlink()
            assert fast.take()
        return usual(path, target)

    usual = Path.rename
    assert not slow.take()
    time.sleep(2 * leases.SECONDS)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename)
        assert not slow.take()
    fast.check()
    assert [path.name for path in tmp_path.iterdir()] == [".x.lease"]
    fast.release()


def test_a_lease_whose_content_has_not_arrived_has_an_unknown_owner(tmp_path: Path) -> None:
    lease_path(tmp_path / "x").touch()
    lease = Lease(tmp_path / "x")
    assert not lease.clear()
    assert str(lease.owner) == "an unknown process"
    long_ago = time.time() - 3 * leases.SECONDS
    os.utime(lease_path(tmp_path / "x"), (long_ago, long_ago))
    assert lease.owner is None


def test_an_owner_notices_the_lease_of_another_one_whose_content_has_not_arrived(tmp_path: Path) -> None:
    lease = Lease(tmp_path / "x")
    assert lease.take()
    lease_path(tmp_path / "x").unlink()
    lease_path(tmp_path / "x").touch()
    with pytest.raises(LeaseLostError):
        lease.check()


def test_a_wrong_clock_of_this_machine_ends_no_lease(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _from_elsewhere(tmp_path / "x")
    monkeypatch.setattr(time, "time", lambda: 10.0**10)
    assert str(Lease(tmp_path / "x").owner) == f"process {os.getpid()} on elsewhere"


def test_a_process_that_waits_for_a_lease_says_for_whom(tmp_path: Path, other: subprocess.Popen[str]) -> None:
    said: list[tuple[str, str]] = []

    def die() -> None:
        other.kill()
        other.wait()

    timer = threading.Timer(1.0, die)
    timer.start()
    listen(lambda place, text: said.append((place, text)))
    try:
        announce("stage 1")
        with Lease(tmp_path / "x").held():
            pass
    finally:
        listen(None)
    timer.join()
    (first, waiting, last) = said
    assert (first, last) == (("stage 1", ""), ("stage 1", ""))
    assert waiting[0] == "stage 1"
    assert waiting[1].startswith(f"waiting for process {other.pid} on ")
    assert waiting[1].endswith(f" to make {tmp_path / 'x'}")


def test_a_lease_that_is_waited_for_comes_when_its_owner_ends(
    tmp_path: Path, other: subprocess.Popen[str]
) -> None:
    def end() -> None:
        other.kill()
        other.wait()  # until then its number stays taken

    timer, begin = threading.Timer(0.5, end), time.monotonic()
    timer.start()
    with Lease(tmp_path / "x").held():
        assert 0.3 < time.monotonic() - begin < leases.SECONDS / 2
    timer.join()


def test_an_owner_learns_that_it_lost_its_lease(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "SECONDS", 0.3)
    lease = Lease(tmp_path / "x")
    assert lease.take()
    lease.check()
    lease_path(tmp_path / "x").unlink()
    with pytest.raises(LeaseLostError, match=r"This process lost .*\.x\.lease: it did not answer"):
        _check_for_a_while(lease)
    lease.release()


@pytest.mark.long
def test_an_owner_that_slept_learns_at_once_that_another_process_took_over(tmp_path: Path) -> None:
    lease, path = Lease(tmp_path / "x"), tmp_path / "x"
    assert lease.take()
    mine = lease_path(path).read_text()
    lease_path(path).unlink()
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "taken\n"
        with pytest.raises(LeaseLostError, match=r"This process lost .*\.x\.lease: it did not answer"):
            lease.check()
        lease.report(0.75)
        lease.release()
        assert lease_path(path).read_text() != mine
        progress = Lease(path).progress
        assert progress is not None
        assert progress.share == 0.25
        other.kill()


def test_an_owner_whose_lease_is_gone_learns_it_at_once(tmp_path: Path) -> None:
    lease = Lease(tmp_path / "x")
    assert lease.take()
    lease_path(tmp_path / "x").unlink()
    with pytest.raises(LeaseLostError, match=r"This process lost .*\.x\.lease: it did not answer"):
        lease.check()
    lease.release()


def _check_for_a_while(lease: Lease) -> None:
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        lease.check()
        time.sleep(0.05)


def test_a_foreign_file_in_the_place_of_a_lease_is_left_alone(tmp_path: Path) -> None:
    lease_path(tmp_path / "x").write_text("mine")
    assert Lease(tmp_path / "x").owner is None
    assert lease_path(tmp_path / "x").read_text() == "mine"


def test_a_lease_whose_owner_is_on_another_machine_counts_while_it_is_fresh(tmp_path: Path) -> None:
    _from_elsewhere(tmp_path / "x")
    lease = Lease(tmp_path / "x")
    owner = lease.owner
    assert owner is not None
    assert str(owner) == f"process {os.getpid()} on elsewhere"
    long_ago = time.time() - 3 * leases.SECONDS
    os.utime(lease_path(tmp_path / "x"), (long_ago, long_ago))
    assert lease.owner is None


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "",
        "{}",
        "[0.5]",
        "[NaN, 1]",
        '["nan", 1]',
        "[1.5, 1]",
        "[0.5, -1]",
        "[0.5, 1e999]",
        '"ab"',
    ],
)
def test_a_report_that_nobody_wrote_counts_as_none(text: str, tmp_path: Path) -> None:
    (tmp_path / ".x.progress").write_text(text)
    assert Lease(tmp_path / "x").progress is None


def test_a_report_does_not_follow_a_link(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / ".x.progress").symlink_to(tmp_path / "mine")
    lease = Lease(tmp_path / "x")
    assert lease.take()
    lease.report(0.5)
    assert lease.progress is None
    lease.release()
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_report_that_cannot_be_removed_does_not_keep_the_lease(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, missing_ok: bool = False) -> None:
        if path.name.endswith(".progress"):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        usual(path, missing_ok)

    usual = Path.unlink
    lease = Lease(tmp_path / "x")
    assert lease.take()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        lease.release()
    assert Lease(tmp_path / "x").take()


def test_the_name_of_an_owners_machine_controls_no_terminal() -> None:
    assert str(leases.Owner(1, "\x1b[2Jhost")) == r"process 1 on \x1b[2Jhost"
