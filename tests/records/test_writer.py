"""The writer of records: everything that it writes can be read, and comes back equal."""

import dataclasses
import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.errors import InputError
from clbench.base.strict_json import LONGEST_TEXT
from clbench.records.paths import record_path
from clbench.records.reader import RecordError, read_record
from clbench.records.record import Record
from clbench.records.writer import MOST_DIAGNOSTICS, check_diagnostics, write_record, write_result


def test_a_record_that_was_written_is_read_as_it_was(record: Record, tmp_path: Path) -> None:
    record.run.settings = {"strength": 0.1, "layers": [1, 2], "name": "naïve | \n"}
    record.diagnostics = {"shed": [0.1, 1e-9]}
    record.error = None
    path = record_path(tmp_path, "clbench/Toy-v0", "sft", 0)
    write_record(record, path)
    assert read_record(path) == record


def test_a_failed_run_names_the_place(record: Record, tmp_path: Path) -> None:
    error = {"where": "loss of stage 1", "type": "ValueError", "message": "no", "traceback": "..."}
    failed = dataclasses.replace(record, status="failed", error=error)
    write_record(failed, tmp_path / "record.json")
    assert read_record(tmp_path / "record.json").error == error


def test_equal_records_are_equal_files(record: Record, tmp_path: Path) -> None:
    for name in ("one.json", "two.json"):
        write_record(record, tmp_path / name)
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_a_link_in_the_place_of_a_record_is_replaced_and_not_followed(record: Record, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine", encoding="utf-8")
    (tmp_path / "record.json").symlink_to(tmp_path / "precious")
    with pytest.raises(RecordError, match="is a symbolic link"):
        read_record(tmp_path / "record.json")
    write_record(record, tmp_path / "record.json")
    assert (tmp_path / "precious").read_text(encoding="utf-8") == "mine"
    assert read_record(tmp_path / "record.json") == record


def test_writing_leaves_nothing_but_the_record(record: Record, tmp_path: Path) -> None:
    write_record(record, tmp_path / "deep" / "record.json")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["record.json"]


def test_a_record_that_cannot_be_written_leaves_the_old_one_and_no_partial(
    record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    before = path.read_bytes()
    record.costs.bytes_kept = float("nan")  # type: ignore[assignment]
    with pytest.raises(ValueError, match="JSON"):
        write_record(record, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["record.json"]


def test_a_full_disk_leaves_no_torn_copy_of_a_record_of_other_settings(
    record: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(source: Path, target: Path) -> None:
        Path(target).write_text("{")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    path = tmp_path / "seed-0.json"
    write_record(record, path)
    before = path.read_bytes()
    monkeypatch.setattr("shutil.copyfile", fill)
    on_a_gpu = dataclasses.replace(record, run=dataclasses.replace(record.run, device="cuda"))
    with pytest.raises(OSError, match="No space left on device"):
        write_result(on_a_gpu, path)
    assert (list(tmp_path.iterdir()), path.read_bytes()) == ([path], before)


def test_a_record_without_perturbed_episodes_does_not_replace_one_that_has_them(
    record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "seed-0.json"
    perturbed = dataclasses.replace(record, run=dataclasses.replace(record.run, perturb=True))
    write_result(perturbed, path)
    write_result(record, path)
    assert read_record(path) == record
    assert read_record(tmp_path / "seed-0.json.old") == perturbed
    write_result(perturbed, path)  # it holds all that the other one does
    assert len(list(tmp_path.iterdir())) == 2


def test_diagnostics_with_tuples_and_numbers_as_names_can_be_read(record: Record, tmp_path: Path) -> None:
    record.diagnostics = {"1": {2: (1.0, 2.0), 10: "x"}}
    write_record(record, tmp_path / "record.json")
    assert read_record(tmp_path / "record.json").diagnostics == {"1": {"2": [1.0, 2.0], "10": "x"}}


def test_the_middle_of_a_long_error_is_left_out(record: Record, tmp_path: Path) -> None:
    traceback = "first\n" + "x" * (2 * LONGEST_TEXT) + "\nlast"
    error = {"where": "loss", "type": "ValueError", "message": "y" * LONGEST_TEXT, "traceback": traceback}
    failed = dataclasses.replace(record, status="failed", error=error)
    write_record(failed, tmp_path / "record.json")
    found = read_record(tmp_path / "record.json").error
    assert found is not None
    assert found["message"] == error["message"]
    assert len(found["traceback"]) < LONGEST_TEXT
    assert found["traceback"].startswith("first\nx")
    assert found["traceback"].endswith("x\nlast")
    assert f"clbench left out {len(traceback) - LONGEST_TEXT + 200:,} characters" in found["traceback"]


@pytest.mark.parametrize(
    ("diagnostics", "words"),
    [
        ({"1": {"text": "x" * (LONGEST_TEXT + 1)}}, "a string of 100,001 characters"),
        ({"1": {"x" * 201: 1}}, "a name of 201 characters"),
        ({"1": {"number": float("inf")}}, "diagnostics cannot be written as JSON"),
        ({"1": {"policy": object()}}, "diagnostics cannot be written as JSON"),
        ({"1": [0] * MOST_DIAGNOSTICS}, "diagnostics have 6,291,463 bytes, more than 2,097,152"),
    ],
)
def test_diagnostics_that_could_not_be_read_are_refused_by_name_before_a_file_is_made(
    diagnostics: dict[str, Any], words: str, record: Record, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=words):
        check_diagnostics(diagnostics)
    record.diagnostics = diagnostics
    with pytest.raises(InputError, match=words):
        write_record(record, tmp_path / "record.json")
    assert not list(tmp_path.iterdir())


def damage_run(record: Record) -> None:
    record.run.seed = "0"  # type: ignore[assignment]


def damage_scenario(record: Record) -> None:
    record.scenario.retained = ["<b>"]


def damage_status(record: Record) -> None:
    record.status = "failed"


def damage_columns(record: Record) -> None:
    record.episodes["stage"].pop()


def damage_diagnostics(record: Record) -> None:
    record.diagnostics = {"1": {1: "a number", "1": "a text"}}


def damage_size(record: Record) -> None:
    record.fingerprint["texts"] = ["x" * 100_000] * 90


def damage_timing(record: Record) -> None:
    record.timing["x" * 201] = 1


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (damage_run, 'run: seed must be a whole number, not "0"'),
        (damage_scenario, "'<b>' cannot be the name of a task"),
        (damage_status, "error must be an object"),
        (damage_columns, "the columns of episodes have different lengths"),
        (damage_diagnostics, "the name '1' is there twice in one object"),
        (damage_size, "bytes, more than 8,388,608"),
        (damage_timing, "timing: a name of 201 characters"),
    ],
)
def test_a_record_that_could_not_be_read_again_is_not_written(
    damage: Callable[[Record], None], words: str, record: Record, tmp_path: Path
) -> None:
    damage(record)
    with pytest.raises(InputError, match=words):
        write_record(record, tmp_path / "record.json")
    assert not list(tmp_path.iterdir())


def test_a_record_that_could_not_be_read_again_leaves_the_one_before(record: Record, tmp_path: Path) -> None:
    write_record(record, tmp_path / "record.json")
    before = (tmp_path / "record.json").read_bytes()
    damage_columns(record)
    with pytest.raises(InputError, match="different lengths"):
        write_record(record, tmp_path / "record.json")
    assert (tmp_path / "record.json").read_bytes() == before
