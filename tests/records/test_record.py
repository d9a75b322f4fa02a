"""Records: what was written is read, and what is no record is refused."""

import dataclasses
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.records.paths import record_path
from clbench.records.reader import RecordError, read_record
from clbench.records.record import Record
from clbench.records.writer import write_record


@pytest.fixture
def record(make_record: Callable[..., Record]) -> Record:
    return make_record(
        [[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]],
        answers={(0, "left"): (10, 9), (1, "left"): (10, 8)},
        sparsity=[[0.9, 0.8, 0.7, 0.6]],
    )


def change(path: Path, **fields: Any) -> None:
    """Set fields of the JSON object at `path`."""
    values = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**values, **fields}), encoding="utf-8")


def test_a_record_that_was_written_is_read_as_it_was(record: Record, tmp_path: Path) -> None:
    record.run["settings"] = {"strength": 0.1, "layers": [1, 2], "name": "naïve | \n"}
    record.diagnostics = {"shed": [0.1, 1e-9]}
    record.error = None
    path = record_path(tmp_path, "clbench/Toy-v0", "sft", 0)
    write_record(record, path)
    assert read_record(path) == record


def test_a_failed_run_says_where(record: Record, tmp_path: Path) -> None:
    error = {"where": "loss of stage 1", "type": "ValueError", "message": "no", "traceback": "..."}
    failed = dataclasses.replace(record, status="failed", error=error)
    write_record(failed, tmp_path / "record.json")
    assert read_record(tmp_path / "record.json").error == error


def test_equal_records_are_equal_files(record: Record, tmp_path: Path) -> None:
    for name in ("one.json", "two.json"):
        write_record(record, tmp_path / name)
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_every_run_has_a_path_of_its_own_below_the_folder(tmp_path: Path) -> None:
    runs: list[Any] = [
        ("clbench/Toy-v0", "sft", 0),
        ("clbench/Toy-v0", "sft", 1),
        ("clbench/Toy-v1", "sft", 0),
        ("clbench/Toy-v0", "sft", 0, 1),
        ("clbench/Toy-v0", "theirs:SFT", 0),
        ("clbench/Toy-v0", "theirs/SFT", 0),
        ("clbench/Toy-v0", "theirs:SFT+strength=2", 0),
        ("theirs/Toy-v0", "sft", 0),
    ]
    paths = {record_path(tmp_path, *run) for run in runs}
    assert len(paths) == len(runs)
    assert all(path.parent.parent.parent == tmp_path for path in paths)


@pytest.mark.parametrize(
    ("scenario", "label"),
    [
        ("../Toy-v0", "sft"),
        ("clbench/Toy-v0", ".."),
        ("clbench/Toy-v0", "sft+x=../../.."),
        ("/Toy-v0", "sft"),
    ],
)
def test_no_name_leads_out_of_the_folder(scenario: str, label: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be the"):
        record_path(tmp_path, scenario, label, 0)


def test_no_link_leads_out_of_the_folder(tmp_path: Path) -> None:
    records = tmp_path / "records"
    records.mkdir()
    (records / "Toy-v0").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="a symbolic link leads out of"):
        record_path(records, "clbench/Toy-v0", "sft", 0)
    (tmp_path / "link").symlink_to(records)  # the folder itself may be one
    assert record_path(tmp_path / "link", "theirs/Toy-v0", "sft", 0).parents[2] == tmp_path / "link"


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
    record.costs["bytes_kept"] = float("nan")
    with pytest.raises(ValueError, match="JSON"):
        write_record(record, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["record.json"]


def test_a_torn_record_is_refused_wherever_it_is_torn(record: Record, tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    whole = path.read_bytes()
    for length in range(0, len(whole) - 2, 97):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordError, match="cannot be read as JSON"):
            read_record(path)


@pytest.mark.parametrize(
    "content",
    [b"[1, 2]", b"7", b"{}", b'{"schema": 0}', b'{"results": {"success": 1.0}}', b'{"schema": 2}'],
)
def test_foreign_json_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "record.json").write_bytes(content)
    with pytest.raises(RecordError, match="schema"):
        read_record(tmp_path / "record.json")


def test_a_record_of_the_first_schema_is_refused_and_says_what_to_do(record: Record, tmp_path: Path) -> None:
    write_record(record, tmp_path / "record.json")
    change(tmp_path / "record.json", schema=1)
    with pytest.raises(RecordError, match="older schema 1, not 2: its run must be done again"):
        read_record(tmp_path / "record.json")


@pytest.mark.parametrize(
    "content", [b"\xff\xfe", b"[" * 100_000, b'{"schema": NaN}', b'{"schema": ' + b"9" * 5000 + b"}"]
)
def test_hostile_bytes_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "record.json").write_bytes(content)
    with pytest.raises(RecordError, match="JSON"):
        read_record(tmp_path / "record.json")


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    for name in ("folder.json", "absent.json"):
        with pytest.raises(RecordError, match="cannot be read"):
            read_record(tmp_path / name)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"schema": 3}, "no record of schema 2"),
        ({"schema": True}, "no record of schema 2"),
        ({"score": 0.99}, "score"),
        ({"status": "great"}, "great"),
        ({"run": None}, "run"),
        ({"costs": [1]}, "costs"),
        ({"error": "yes"}, "error"),
        ({"status": "failed"}, "error must be an object"),
        ({"run": {}}, "run: scenario, method, seed, device, split, settings, changes, uses is missing"),
        (
            {"scenario": {"id": "x"}},
            "scenario: retained, target, held_out, evaluation_steps, budget is missing",
        ),
    ],
)
def test_a_field_that_does_not_fit_the_schema_is_refused_by_name(
    fields: dict[str, Any], words: str, record: Record, tmp_path: Path
) -> None:
    write_record(record, tmp_path / "record.json")
    change(tmp_path / "record.json", **fields)
    with pytest.raises(RecordError, match=words):
        read_record(tmp_path / "record.json")


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ({"order": "1"}, "run: order must be a whole number"),
        ({"order": True}, "run: order must be a whole number"),
        ({"order": 0}, "run: order must be above 0; it is left out where the targets have theirs"),
        ({"perturb": 1}, "run: perturb must be true or false, not 1"),
        ({"perturb": False}, "run: perturb must be true; it is left out where nothing was perturbed"),
        ({"oder": 1}, "No field of run is called 'oder'. Did you mean 'order'?"),
    ],
)
def test_the_order_of_the_targets_is_a_number_above_0_or_left_out(
    field: dict[str, Any], words: str, record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    change(path, run={**record.run, "order": 3})
    assert read_record(path).run["order"] == 3
    change(path, run={**record.run, **field})
    with pytest.raises(RecordError, match=re.escape(words)):
        read_record(path)


@pytest.mark.parametrize("name", ["episodes", "answers", "policy"])
def test_columns_that_do_not_fit_together_are_refused_by_name(
    name: str, record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    columns = getattr(record, name)
    unequal = {**columns, "stage": columns["stage"][1:]}
    foreign = {**columns, "reward": columns["stage"]}
    tables: tuple[Any, ...] = (unequal, foreign, {}, None, [], dict.fromkeys(columns, 1))
    for table in tables:
        write_record(record, path)
        change(path, **{name: table})
        with pytest.raises(RecordError, match=name):
            read_record(path)
