"""`clbench cache`: the entries that it shows and deletes."""

import errno
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import lose_home, write_unchecked
from safetensors.numpy import save_file

from clbench.base.cache import cache_folder, cached, hash_of, minari_folder
from clbench.base.lease import Lease
from clbench.cli.cache import entries, find_stale
from clbench.cli.main import app
from clbench.records.record import Record

DAY = 24 * 60 * 60


def _make(kind: str, days: float = 0.0, code: str = "a", purpose: str = "a") -> Path:
    """Make an entry of the cache that was last used a number of days ago, and return its folder."""
    inputs = {"purpose": purpose, "nested": {"source": code, "versions": {"torch": code}}}
    folder = cache_folder() / kind / hash_of([inputs, days])
    return _age(cached(folder, inputs, lambda partial: _fill(partial / "data", 2_000_000)), days)


def _fill(path: Path, size: int) -> None:
    _write(path, size)


def _write(path: Path, size: int = 1) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x" * size)
    return path


def _age(folder: Path, days: float) -> Path:
    for path in (*folder.rglob("*"), folder):
        os.utime(path, (time.time() - days * DAY,) * 2)
    return folder


def _cache(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    app(["cache", *options], result_action="return_value")
    return capsys.readouterr().out


@pytest.mark.usefixtures("empty_caches")
def test_every_kind_is_shown_with_its_number_size_and_age(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _make("runs", 40)
    _make("runs", 3)
    _make("scenes", 1)
    monkeypatch.setenv("COLUMNS", "60")
    out = _cache(capsys)
    assert max(len(line) for line in out.splitlines() if line.startswith("│")) <= 60
    assert "…" not in out
    (runs,) = (line for line in out.splitlines() if line.startswith("│ runs "))
    assert [cell.strip() for cell in runs.strip("│").split("│")][1:] == [
        "2",
        "4.0 MB",
        "40 days",
        "1 (2.0 MB)",
    ]
    assert "│ scenes " in out
    assert "│ pretrained " not in out
    assert f"Cache: {cache_folder()}" in out
    assert "`clbench cache --prune` deletes 1 stale entry, 2.0 MB." in out
    assert len(list(entries())) == 3


@pytest.mark.usefixtures("empty_caches")
def test_pruning_lists_and_deletes_unused_entries(capsys: pytest.CaptureFixture[str]) -> None:
    old, young = _make("pretrained", 31), _make("pretrained", 29)
    out = _cache(capsys, "--dry-run")
    assert f"2.0 MB  {old}: not used for 31 days" in out
    assert old.is_dir()
    out = _cache(capsys, "--prune")
    assert f"2.0 MB  {old}: not used for 31 days" in out
    assert "Deleted 1 stale entry, 2.0 MB." in out
    assert list(old.parent.iterdir()) == [young]
    assert "Deleted 1 stale" in _cache(capsys, "--prune", "--older-than", "20")
    assert list(old.parent.iterdir()) == []


@pytest.mark.usefixtures("empty_caches")
def test_a_recently_read_entry_is_not_stale(capsys: pytest.CaptureFixture[str]) -> None:
    folder = _make("pretrained", 31)
    os.utime(folder / "data", (time.time(), time.time() - 31 * DAY))
    assert "stale entr" not in _cache(capsys)


@pytest.mark.usefixtures("empty_caches")
def test_an_entry_of_older_code_is_stale_unless_it_was_used_since(
    capsys: pytest.CaptureFixture[str],
) -> None:
    old, newer = _make("stages", 5), _make("stages", 2, code="b")
    _make("stages", 4, purpose="b")
    same_code = _make("runs", 5)
    _make("runs", 4)
    assert f"{old}: replaced by {newer.name}, which newer code made" in _cache(capsys, "--dry-run")
    os.utime(old / "data", (time.time(), time.time() - 5 * DAY))
    assert "stale entr" not in _cache(capsys)
    assert same_code.is_dir()


@pytest.mark.usefixtures("empty_caches")
def test_a_run_in_progress_keeps_its_checkpoints(capsys: pytest.CaptureFixture[str]) -> None:
    unused, replaced = _make("runs", 40), _make("runs", 5, purpose="b")
    newer = _make("runs", 2, code="b", purpose="b")
    leases = [Lease(folder) for folder in (unused, replaced)]
    assert all(lease.take() for lease in leases)
    assert "Deleted 0 stale entries" in _cache(capsys, "--prune")
    assert "Deleted 1 stale entry" in _cache(capsys, "--prune", "--older-than", "0")
    assert (unused.is_dir(), replaced.is_dir(), newer.is_dir()) == (True, True, False)
    for lease in leases:
        lease.release()
    assert "Deleted 2 stale entries" in _cache(capsys, "--prune", "--older-than", "0")


@pytest.mark.usefixtures("empty_caches")
def test_leftovers_of_killed_processes_are_deleted(capsys: pytest.CaptureFixture[str]) -> None:
    root, whole = cache_folder() / "stages" / hash_of("run"), "f" * 32
    _write(root / "stage-0" / "data")
    old, fresh = root / f".stage-1.{whole}.partial", root / f".stage-2.{whole}.partial"
    dataset = minari_folder() / "clbench" / "toy" / f".left-v0.{whole}.old"
    for folder in (old, fresh, dataset):
        _write(folder / "data")
    maker = Lease(root / "stage-2")
    assert maker.take()
    out = _cache(capsys, "--prune")
    maker.release()
    assert f"{old}: left behind by a killed process" in out
    assert "Deleted 2 stale entries" in out
    assert sorted(path.name for path in root.iterdir()) == [fresh.name, "stage-0"]
    assert list(dataset.parent.iterdir()) == []


@pytest.mark.usefixtures("empty_caches")
def test_only_entries_made_by_clbench_are_deleted(capsys: pytest.CaptureFixture[str]) -> None:
    foreign = _write(cache_folder() / "runs" / "my thesis" / "record.json")
    dataset = _write(minari_folder() / "d4rl" / "door-v2" / "data" / "main_data.hdf5")
    linked = _write(cache_folder().parent / "elsewhere" / "data")
    (cache_folder() / "runs" / "0123456789abcdef").symlink_to(linked.parent)
    for path in (foreign, dataset, linked):
        _age(path.parent, 1000)
    assert "Deleted 0 stale entries" in _cache(capsys, "--prune", "--older-than", "0")
    assert foreign.is_file()
    assert dataset.is_file()
    assert linked.is_file()


@pytest.mark.usefixtures("empty_caches")
def test_datasets_that_clbench_collected_are_entries() -> None:
    folder = minari_folder() / "clbench" / "toy" / "left-v0"
    cached(folder, {"task": "left"}, lambda partial: _fill(partial / "data" / "main_data.hdf5", 1))
    (entry,) = entries()
    assert (entry.kind, entry.path) == ("demonstrations", folder)
    assert list(find_stale([entry], 30, time.time() + 31 * DAY)) == [entry]


@pytest.mark.usefixtures("empty_caches")
def test_an_empty_cache_is_shown_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert "Deleted 0 stale entries, 0.0 MB." in _cache(capsys, "--prune")


@pytest.mark.usefixtures("empty_caches")
@pytest.mark.parametrize("fault", ["cannot be read: Permission denied", "no home folder"])
def test_a_cache_that_cannot_be_read_is_named(
    fault: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    if fault == "no home folder":
        lose_home(monkeypatch)
    else:
        monkeypatch.setattr(Path, "is_dir", refuse)
    with pytest.raises(SystemExit, match="2"):
        app(["cache"])
    assert fault in capsys.readouterr().err


@pytest.mark.usefixtures("empty_caches")
def test_files_that_clbench_did_not_make_are_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "0123456789abcdef"
    foreign = [
        _write(cache_folder() / "photos" / f"holiday-{name}.jpg"),
        _write(cache_folder() / "projects" / name / "thesis.txt"),
        _write(cache_folder() / "runs" / name / "thesis.txt"),
        _write(cache_folder() / "ray" / name / "thesis.txt"),
        _write(cache_folder() / "experts" / name / "thesis.txt"),
        _write(cache_folder() / "frames" / f"holiday-{name}.jpg"),
        _write(minari_folder() / "precious" / "data" / "x.h5"),
        _write(minari_folder() / "clbench" / "mine" / "push-v0" / "data" / "x.h5"),
    ]
    manifest = next(_make("scenes").glob("clbench.json")).read_bytes()
    for folder in (minari_folder(), minari_folder() / "clbench", minari_folder() / "clbench" / "mine"):
        foreign.append(folder / "clbench.json")
        folder.joinpath("clbench.json").write_bytes(manifest)
    for path in foreign:
        _age(path.parent, 400)
    assert [entry.kind for entry in entries()] == ["scenes"]
    _cache(capsys, "--prune", "--older-than", "0")
    assert all(path.is_file() for path in foreign)


@pytest.mark.usefixtures("empty_caches")
def test_an_entry_with_a_foreign_file_is_named_and_left(capsys: pytest.CaptureFixture[str]) -> None:
    stages = cache_folder() / "stages" / hash_of("run")
    cached(stages / "stage-0", {"stage": 0}, lambda partial: _fill(partial / "data", 1))
    dataset = minari_folder() / "clbench" / "toy" / "left-v0"
    cached(dataset, {"task": "left"}, lambda partial: _fill(partial / "data" / "main_data.hdf5", 1))
    thesis = _make("pretrained", 400) / "thesis.txt"
    foreign = [thesis, stages / "notes" / "a.txt", stages / "b.txt", dataset / "data" / "mine.hdf5"]
    for path in foreign:
        _write(path)
    for folder in (thesis.parent, stages, dataset):
        _age(folder, 400)
    old = _make("scenes", 400)
    out = _cache(capsys, "--prune", "--older-than", "0")
    assert f"{thesis.parent} is not deleted: clbench did not make thesis.txt in it." in out
    assert f"{stages} is not deleted: clbench did not make b.txt and 1 more file in it." in out
    assert f"{dataset} is not deleted: clbench did not make data/mine.hdf5 in it." in out
    assert "Deleted 1 stale entry" in out
    assert not old.exists()
    assert all(path.is_file() for path in (*foreign, stages / "stage-0" / "data"))


@pytest.mark.usefixtures("empty_caches")
def test_records_on_their_way_are_deleted_and_other_json_is_left(
    make_record: Callable[..., Record], capsys: pytest.CaptureFixture[str]
) -> None:
    ours, mixed, foreign = (_write(cache_folder() / "ray" / hash_of(name) / "a.json") for name in "abc")
    for path in (ours, mixed):
        write_unchecked(make_record([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]), path)
    settings = _write(mixed.with_name("settings.json"))
    for path in (ours, mixed, foreign):
        _age(path.parent, 40)
    out = _cache(capsys, "--prune")
    assert f"{mixed.parent} is not deleted: clbench did not make settings.json in it." in out
    assert not ours.parent.exists()
    assert all(path.is_file() for path in (mixed, settings, foreign))


@pytest.mark.usefixtures("empty_caches")
def test_checkpoints_of_expert_training_are_deleted_and_other_weights_are_left(
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = cache_folder() / "experts"
    names = [f"{name}-0123456789abcdef.safetensors" for name in ("left-seed-0", "mine", "text")]
    ours, weights, text = (_write(folder / name) for name in names)
    save_file({"x": np.zeros(1)}, ours, {"training": "{}"})
    save_file({"x": np.zeros(1)}, weights)
    _age(folder, 40)
    assert "Deleted 1 stale entry" in _cache(capsys, "--prune")
    assert [path.is_file() for path in (ours, weights, text)] == [False, True, True]


@pytest.mark.usefixtures("empty_caches")
def test_a_folder_named_like_a_leftover_is_left_unless_an_entry_would_be_there() -> None:
    name = f"draft.{'f' * 32}.partial"
    for place in ("projects", "runs", "runs/projects"):
        _write(cache_folder() / place / f".{name}" / "thesis.txt")
    assert list(entries()) == []


@pytest.mark.usefixtures("empty_caches")
def test_a_linked_folder_is_not_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = _make("runs", 400).parent
    moved = target.rename(tmp_path / "elsewhere")
    target.symlink_to(moved)
    assert list(entries()) == []
    _cache(capsys, "--prune")
    assert len(list(moved.iterdir())) == 1


@pytest.mark.usefixtures("empty_caches")
def test_an_entry_that_cannot_be_deleted_does_not_stop_the_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = sorted((_make("runs", 40), _make("runs", 50)))
    rename = Path.rename

    def refuse(path: Path, target: Path) -> Path:
        if path == first:
            raise PermissionError(13, "Permission denied")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(SystemExit) as ended:
        app(["cache", "--prune"], result_action="return_value")
    assert ended.value.code == 2
    assert f"1 of 2 stale entries could not be deleted. {first}" in capsys.readouterr().err
    assert (first.is_dir(), second.is_dir()) == (True, False)
