"""One run that dies, or meets a full disk, at any operation that changes files: nothing is lost or torn."""

import random
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fault_server
import pytest
from fault_server import Runs

from clbench.base.leftovers import sweep

POINTS = (0.5, 1.0)
"""Operations at which the quick test lets a run die, as shares of their number; the slow one tries all."""

FULL_DISKS = 20

KILLS, PAST_A_CHECKPOINT = 60, 20
"""Kills at random moments, and how many of them must come after the first checkpoint at least."""


def _leftovers(folder: Path) -> list[str]:
    """Return the names of what killed processes left."""
    return sorted(path.name for path in folder.rglob(".*"))


def _check_next_start(
    runs: Runs, folder: Path, whole: Path, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    """Check that the next start gives the record of an undisturbed run, and leaves nothing else."""
    assert all(path.name == "seed-0.json" for path in folder.glob("records/*/*/[!.]*"))
    assert runs.do(folder)[1] == "success"
    assert lasting_records(folder / "records") == lasting_records(whole / "records")
    assert _leftovers(folder) == []
    assert list((folder / "cache" / "runs").iterdir()) == []


def _die(
    points: list[int],
    runs: Runs,
    tmp_path: Path,
    whole: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
) -> None:
    for point in points:
        folder = tmp_path / str(point)
        assert runs.do(folder, at=point, fault=fault_server.DIES) == (None, "killed")
        _check_next_start(runs, folder, whole, lasting_records)


@pytest.mark.long
def test_a_run_that_dies_at_some_operation_is_completed_by_the_next_start(
    runs: Runs,
    whole: tuple[Path, int],
    tmp_path: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
) -> None:
    folder, count = whole
    points = [round(share * count) for share in POINTS]
    _die(points, runs, tmp_path, folder, lasting_records)


@pytest.mark.slow
def test_a_run_that_dies_at_any_operation_is_completed_by_the_next_start(
    runs: Runs,
    whole: tuple[Path, int],
    tmp_path: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
    record_property: Callable[[str, object], None],
) -> None:
    folder, count = whole
    _die(list(range(1, count + 1)), runs, tmp_path, folder, lasting_records)
    record_property("counts", {"operations": count})


@pytest.mark.slow
def test_a_run_that_is_killed_at_a_random_moment_is_completed_by_the_next_start(
    runs: Runs,
    whole: tuple[Path, int],
    tmp_path: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
    record_property: Callable[[str, object], None],
) -> None:
    begin = time.monotonic()
    assert runs.do(tmp_path / "timed")[1] == "success"
    longest, moments = time.monotonic() - begin, random.Random(0)
    came: Counter[str] = Counter()
    while came["before a checkpoint"] + came["after one"] < KILLS or came["after one"] < PAST_A_CHECKPOINT:
        folder = tmp_path / str(came.total())
        _, end = runs.do(folder, after=moments.uniform(0, longest))
        past = any(folder.glob("cache/runs/*/stage-*"))
        came["too late" if end != "killed" else "after one" if past else "before a checkpoint"] += 1
        _check_next_start(runs, folder, whole[0], lasting_records)
    record_property("counts", dict(came))


@pytest.mark.long
@pytest.mark.parametrize("share", [0.5, pytest.param(None, marks=pytest.mark.slow)])
def test_a_full_disk_ends_a_run_without_a_record_and_the_next_start_completes_it(
    runs: Runs,
    whole: tuple[Path, int],
    tmp_path: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
    share: float | None,
    record_property: Callable[[str, object], None],
) -> None:
    folder, count = whole
    shares = [share] if share else [(number + 0.5) / FULL_DISKS for number in range(FULL_DISKS)]
    for number, place in enumerate(shares):
        mine = tmp_path / str(number)
        _, end = runs.do(mine, at=1 + int(place * count), fault=fault_server.FULL)
        # at its very end a run only removes files, which a full disk allows
        assert end.startswith("refused: ") or (end == "success" and place > 0.9), end
        assert len(list(mine.glob("records/*/*/*.json"))) == (end == "success")
        _check_next_start(runs, mine, folder, lasting_records)
    record_property("counts", {"full disks": len(shares)})


@pytest.mark.long
def test_sweeping_a_folder_of_finished_runs_removes_nothing(whole: tuple[Path, int]) -> None:
    folder, _ = whole
    before = sorted(folder.rglob("*"))
    assert sweep(folder) == 0
    assert sorted(folder.rglob("*")) == before
