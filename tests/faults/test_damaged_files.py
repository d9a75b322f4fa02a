"""Damaged files by the hundred: each is refused or made again, and never changes a result."""

import importlib
import json
import random
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fault_server
import numpy as np
import pytest
from fault_server import Runs
from helpers import resealed
from verification import TOY, verify

from clbench.base.cache import fault_of
from clbench.base.errors import InputError
from clbench.jobs.recorded import has_record, set_aside
from clbench.records.reader import RecordError
from clbench.runs.run import execute
from clbench.runs.spec import ResolvedRun, RunSpec

CACHED = {
    "pretrained policy": "cache/pretrained/*/*",
    "states of the questions": "cache/scenes/*/*",
    "first evaluation": "cache/reports/*/*",
    "definition": "cache/definitions/*/*",
    "demonstrations": "minari/clbench/toy/*/*-v0/**/*",
    "names of the demonstrations": "minari/**/namespace_metadata.json",
}
"""Kinds of files that a finished run leaves for the next one, with their places."""

HALF_WAY = {"checkpoint": "cache/runs/*/*/*"}
"""Kinds of files that a killed run leaves, with their places."""

BESIDE = {"numbers of the board": "site/board.json", "verification": "records/*/*/*.verified"}
"""Kinds of files that commands make from records, with their places."""

runs_of = importlib.import_module("clbench.leaderboard.board.runs")
rows = importlib.import_module("clbench.leaderboard.board.rows")
tiers = importlib.import_module("clbench.leaderboard.board.tiers")
publishing = importlib.import_module("clbench.leaderboard.publishing")


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Return `content` with one thing wrong: a bit, a digit, something inserted, removed or cut off."""
    place = chance.randrange(len(content))
    digits = [number for number, byte in enumerate(content[:10_000]) if 48 <= byte <= 57]
    how = chance.choice(("bit", "digit", "insert", "remove", "cut", "empty"))
    if how == "digit" and digits:
        place = chance.choice(digits)
        other = chance.choice([digit for digit in range(48, 58) if digit != content[place]])
        return content[:place] + bytes([other]) + content[place + 1 :]
    if how == "insert":
        return content[:place] + chance.randbytes(chance.randint(1, 40)) + content[place:]
    if how == "remove":
        return content[:place] + content[place + chance.randint(1, 40) :]
    if how == "cut":
        return content[:place]
    if how == "empty":
        return b""
    return content[:place] + bytes([content[place] ^ 1 << chance.randrange(8)]) + content[place + 1 :]


def _files(folder: Path, place: str) -> list[Path]:
    found = sorted(path for path in folder.glob(place) if path.is_file() and path.stat().st_size)
    assert found, place
    return found


# ---- files of the caches -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(whole: tuple[Path, int]) -> Path:
    """Return the folder of a finished run."""
    return whole[0]


@pytest.fixture(scope="module")
def half_way(runs: Runs, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run that was killed after a stage, with the caches of the finished run."""
    folder = tmp_path_factory.mktemp("half_way")
    _copy_caches(finished, folder)
    count, _ = runs.do(folder)
    shutil.rmtree(folder / "records")
    assert count is not None
    assert runs.do(folder, at=round(0.7 * count), fault=fault_server.DIES) == (None, "killed")
    assert len(list(folder.glob("cache/runs/*/stage-*"))) >= 2
    return folder


def _copy_caches(source: Path, folder: Path) -> None:
    for name in ("cache", "minari"):
        shutil.copytree(source / name, folder / name)


def _check_run(
    runs: Runs, folder: Path, finished: Path, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    """Check that a run with the caches of `folder` gives the record of the finished run."""
    assert runs.do(folder)[1] == "success"
    assert lasting_records(folder / "records") == lasting_records(finished / "records")


@pytest.mark.slow
def test_a_run_whose_cached_files_are_all_damaged_gives_the_same_record(
    runs: Runs, finished: Path, tmp_path: Path, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    _copy_caches(finished, tmp_path)
    chance = random.Random(0)
    for place in CACHED.values():
        for path in _files(tmp_path, place):
            path.write_bytes(damaged(path.read_bytes(), chance))
    _check_run(runs, tmp_path, finished, lasting_records)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*CACHED, *HALF_WAY])
def test_a_run_with_a_damaged_file_gives_the_same_record(
    kind: str,
    runs: Runs,
    finished: Path,
    half_way: Path,
    tmp_path: Path,
    lasting_records: Callable[[Path], dict[str, Any]],
) -> None:
    chance, place = random.Random(kind), {**CACHED, **HALF_WAY}[kind]
    for number in range(25):
        folder = tmp_path / str(number)
        _copy_caches(half_way if kind in HALF_WAY else finished, folder)
        path = chance.choice(_files(folder, place))
        path.write_bytes(damaged(path.read_bytes(), chance))
        _check_run(runs, folder, finished, lasting_records)


@pytest.mark.long
@pytest.mark.parametrize("kind", [kind for kind in (*CACHED, *HALF_WAY) if not kind.startswith("names")])
@pytest.mark.parametrize("count", [20, pytest.param(500, marks=pytest.mark.slow)])
def test_a_damaged_file_of_a_cached_result_is_found(
    kind: str,
    count: int,
    finished: Path,
    half_way: Path,
    tmp_path: Path,
    record_property: Callable[[str, object], None],
) -> None:
    _copy_caches(half_way if kind in HALF_WAY else finished, tmp_path)
    chance = random.Random(kind)
    files = _files(tmp_path, {**CACHED, **HALF_WAY}[kind])
    came: Counter[str] = Counter()
    for _ in range(count):
        path = chance.choice(files)
        folder = next(parent for parent in path.parents if (parent / "clbench.json").exists())
        content, manifest = path.read_bytes(), json.loads((folder / "clbench.json").read_text("utf-8"))
        path.write_bytes(damaged(content, chance))
        if fault_of(folder, manifest["made_from"]) is None:  # only what the manifest tells to people changed
            assert path.name == "clbench.json"
            changed = json.loads(path.read_text("utf-8"))
            assert [changed[part] for part in ("inputs", "files")] == [manifest["inputs"], manifest["files"]]
            came["same content"] += 1
        else:
            came["found"] += 1
        path.write_bytes(content)
    record_property("counts", dict(came))
    assert came["found"] > 0.5 * count


# ---- records -----------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_damaged_record_is_refused_by_all_commands_or_shows_the_same_numbers(
    count: int, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    records = tmp_path / "records"
    spec = RunSpec(TOY, "sft", 0)
    execute(spec, records)
    run = spec.resolve()
    path, chance = run.path(records), random.Random(0)
    content, honest = path.read_bytes(), runs_of.read_run(records, path)
    came: Counter[str] = Counter()
    for number in range(count):
        wrong = damaged(content, chance)
        path.write_bytes(resealed(wrong) if number % 2 else wrong)
        shown, verified = (_reads(records, path, changed) for changed in (False, None))
        assert shown == verified
        counts, failed = _counts(run, records), _failed(path)
        if counts is None:  # a forger's definition; the board knows those that are pinned
            assert number % 2
            came["refused as of another definition"] += 1
            continue
        assert shown or not counts
        aside = set_aside(run, records)
        assert (aside is None) == (path.exists())
        if aside is not None:
            assert not shown
            assert str(path) in aside
            came["set aside"] += 1
        elif not shown:  # the record of another run, or of one that failed: it is done again
            assert failed or not counts
            came["refused"] += 1
        elif number % 2:
            came["another run's" if not counts else "a forger's"] += 1
        else:
            found = runs_of.read_run(records, path)
            assert np.array_equal(found.scores.success, honest.scores.success)
            assert found.record.costs == honest.record.costs
            came["same numbers"] += 1
    record_property("counts", dict(came))
    assert came["set aside"] > 0.5 * count


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a board with a record that was verified."""
    folder = tmp_path_factory.mktemp("board")
    records, spec = folder / "records", RunSpec(TOY, "frozen", 0)
    execute(spec, records)
    verify(spec.path(records), "recomputed", by="Ada")
    publishing.write_site(rows.compute_board(records), records, publishing.inputs_of(records))
    return folder


def _told(board: Path) -> tuple[Any, Any]:
    """Return the kept numbers of a board and what the verification of its record found, None if refused."""
    (record,) = (board / "records").glob("*/*/*.json")
    kept = publishing.read_unchanged(board / "records", publishing.inputs_of(board / "records"))
    return kept and kept.to_json(), tiers.verification_of(record).notes or None


@pytest.mark.long
@pytest.mark.parametrize("kind", BESIDE)
@pytest.mark.parametrize("count", [20, pytest.param(500, marks=pytest.mark.slow)])
def test_a_damaged_file_beside_the_records_changes_no_number_of_the_board(
    kind: str, count: int, board: Path, record_property: Callable[[str, object], None]
) -> None:
    chance, honest = random.Random(kind), _told(board)
    assert None not in honest
    (path,) = _files(board, BESIDE[kind])
    content = path.read_bytes()
    came: Counter[str] = Counter()
    for _ in range(count):
        path.write_bytes(damaged(content, chance))
        told = _told(board)[list(BESIDE).index(kind)]
        assert told in (None, honest[list(BESIDE).index(kind)])
        came["refused" if told is None else "same numbers"] += 1
    path.write_bytes(content)
    record_property("counts", dict(came))
    assert came["refused"] > 0.5 * count


def _counts(run: ResolvedRun, records: Path) -> bool | None:
    """Return whether a record counts as the run's; None if it is refused as of another definition."""
    try:
        return has_record(run, records)
    except InputError as error:
        if not str(error).startswith(
            f"{run.path(records)} was made with another definition of clbench/Toy-v0"
        ):
            raise
        return None


def _failed(path: Path) -> bool:
    try:
        return bool(json.loads(path.read_bytes())["status"] != "success")
    except (ValueError, TypeError, KeyError):
        return False


def _reads(records: Path, path: Path, changed: bool | None) -> bool:
    try:
        runs_of.read_run(records, path, changed=changed)
    except RecordError:
        return False
    return True
