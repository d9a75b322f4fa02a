"""Leftovers of killed processes, some of which are still being made."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clbench.base.cache import cached
from clbench.base.lease import Lease, lease_path
from clbench.base.leftovers import LEFT_SECONDS, replacing, sweep, unfinished

HEX = "0123456789abcdef" * 2


def _age(path: Path) -> None:
    long_ago = path.stat().st_mtime - 2 * LEFT_SECONDS
    os.utime(path, (long_ago, long_ago))


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    for name in (f".x.{HEX}.partial", f".y.{HEX}.old"):
        (tmp_path / "below" / name).mkdir(parents=True)
        (tmp_path / "below" / name / "half.txt").write_text("half")
    record = tmp_path / f".seed-0.json.{HEX}.partial"
    record.write_text("{")
    _age(record)
    assert sweep(tmp_path) == 3
    assert [path.name for path in tmp_path.rglob("*")] == ["below"]


@pytest.mark.long
def test_a_lease_goes_with_its_report_once_its_process_is_dead(tmp_path: Path) -> None:
    code = "import os, sys; from pathlib import Path; from clbench.base.lease import Lease; "
    code += "lease = Lease(Path(sys.argv[1])); lease.take(); lease.report(0.5); os._exit(0)"
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "x")], check=True)
    assert {path.name for path in tmp_path.iterdir()} == {".x.lease", ".x.progress"}
    assert sweep(tmp_path) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_report_of_a_record_goes_if_its_lease_is_gone(tmp_path: Path) -> None:
    orphan, owned = tmp_path / ".seed-0.json.progress", Lease(tmp_path / "seed-1.json")
    orphan.write_text("")
    assert owned.take()
    owned.report(0.5)
    assert sweep(tmp_path) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [".seed-1.json.lease", ".seed-1.json.progress"]
    owned.release()


def test_what_is_being_made_stays(tmp_path: Path) -> None:
    lease = Lease(tmp_path / "x")
    assert lease.take()
    lease.report(0.5)
    (tmp_path / f".x.{HEX}.partial").mkdir()
    (tmp_path / f".seed-0.json.{HEX}.partial").write_text("{")
    assert sweep(tmp_path) == 0
    assert len(list(tmp_path.iterdir())) == 4
    lease.release()


def test_a_wrong_clock_removes_nothing_that_another_machine_is_making(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lease = Lease(tmp_path / "x")
    assert lease.take()
    text = lease_path(tmp_path / "x").read_text()
    lease.release()
    lease_path(tmp_path / "x").write_text(re.sub("host=.*", "host=elsewhere", text))
    (tmp_path / f".x.{HEX}.partial").mkdir()
    (tmp_path / f".seed-0.json.{HEX}.partial").write_text("{")
    monkeypatch.setattr(time, "time", lambda: 10.0**10)
    assert sweep(tmp_path) == 0
    _age(lease_path(tmp_path / "x"))
    _age(tmp_path / f".seed-0.json.{HEX}.partial")
    assert sweep(tmp_path) == 2


def test_a_folder_that_a_living_process_of_this_machine_makes_stays_without_its_lease(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        name = unfinished(tmp_path / "x").name.replace(f"{os.getpid():08x}", f"{other.pid:08x}")
        (tmp_path / name).mkdir()
        assert sweep(tmp_path) == 0
        other.kill()
    assert sweep(tmp_path) == 1


@pytest.mark.long
def test_an_unfinished_file_goes_at_once_if_its_process_is_dead(tmp_path: Path) -> None:
    code = "import sys; from pathlib import Path; from clbench.base.leftovers import unfinished; "
    code += "unfinished(Path(sys.argv[1])).touch()"
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "theirs")], check=True)
    mine = unfinished(tmp_path / "mine")
    mine.touch()
    _age(mine)
    assert sweep(tmp_path) == 1
    assert list(tmp_path.iterdir()) == [mine]


def test_nothing_else_is_touched(tmp_path: Path) -> None:
    for name in (
        "notes.partial",
        ".x.123.partial",
        ".config.lease",
        ".config.progress",
        "seed-0.json",
        f"x.{HEX}.partial",
    ):
        (tmp_path / name).write_text("mine")
        _age(tmp_path / name)
    assert sweep(tmp_path) == 0
    assert len(list(tmp_path.iterdir())) == 6


def test_a_result_that_is_made_again_removes_what_its_dead_makers_left(tmp_path: Path) -> None:
    for name in (f".x.{HEX}.partial", f".x.{HEX}.old", f".xy.{HEX}.partial"):
        (tmp_path / name).mkdir()
    cached(tmp_path / "x", {}, lambda folder: None)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f".xy.{HEX}.partial", "x"]


def test_what_replaces_a_file_appears_in_one_step_and_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), replacing(path) as partial:
        partial.write_text((tmp_path / "none").read_text())
    assert (path.read_text(), list(tmp_path.iterdir())) == ("old", [path])
    with replacing(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert (path.read_text(), list(tmp_path.iterdir())) == ("new", [path])
