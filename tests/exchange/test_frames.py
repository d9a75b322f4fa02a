"""Records as one table: what it has, and which files it leaves out."""

import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import RATES, sealed, write_two_records

import clbench
from clbench.base.errors import NoRecordsError
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.spec.protocol import LARGEST_SEED


@pytest.fixture
def records(tmp_path: Path, make_record: Callable[..., Record]) -> Path:
    """Return a folder with two records, and a file that is none."""
    return write_two_records(tmp_path, make_record)


def test_all_records_come_as_one_long_table(records: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        found = clbench.load_records(records)
    assert "notes.json: is not a record of clbench" in caplog.text
    assert list(dict.fromkeys(found.method)) == ["lora+rank=4", "sft"]
    assert set(found.seed) == {0, 3}
    assert found.success.dtype == bool
    groups = found.drop_duplicates("task").set_index("task").group
    assert list(groups) == ["retained", "retained", "target", "target", "held_out"]
    ends = found[(found.method == "sft") & (found.split == "test")]
    rates = ends[ends.step == ends.groupby("stage").step.transform("max")].groupby(["stage", "task"]).success
    assert sorted(rates.mean()) == sorted(np.ravel(RATES))


def test_an_empty_folder_gives_an_empty_table_and_a_missing_one_an_error(tmp_path: Path) -> None:
    assert list(clbench.load_records(str(tmp_path)).columns) == list(clbench.load_records(tmp_path).columns)
    with pytest.raises(NoRecordsError, match=r"no folder of records at .*nowhere"):
        clbench.load_records(tmp_path / "nowhere")


def test_a_policy_of_another_name_is_told_apart(tmp_path: Path, make_record: Callable[..., Record]) -> None:
    for policy in ("flow", "discrete_diffusion"):
        record = make_record(RATES, episodes=4, policy=policy)
        write_record(record, record_path(tmp_path, "clbench/Toy-v0", "sft", 0, policy=policy))
    found = clbench.load_records(tmp_path)
    assert set(found.policy) == {"flow", "discrete_diffusion"}
    assert not found.duplicated(["policy", "stage", "step", "task", "split", "episode"]).any()


def test_a_second_record_of_a_run_is_left_out(records: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = clbench.load_records(records)
    path = record_path(records, "clbench/Toy-v0", "sft", 0)
    again = record_path(records / "a copy", "clbench/Toy-v0", "sft", 0)
    again.parent.mkdir(parents=True)
    again.write_bytes(path.read_bytes())
    with caplog.at_level(logging.WARNING):
        assert len(clbench.load_records(records)) == len(before)
    assert "its run has another record" in caplog.text


@pytest.mark.parametrize(
    "place", ["A/seed-0.json", "Toy-v0/sft/seed-1.json", "Toy-v0/theirs--mine/seed-0.json"]
)
def test_a_record_at_the_place_of_another_run_adds_nothing_and_hides_nothing(
    place: str, records: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = clbench.load_records(records)
    honest = record_path(records, "clbench/Toy-v0", "sft", 0)
    values = json.loads(honest.read_text(encoding="utf-8"))
    values["episodes"]["success"] = [1] * len(values["episodes"]["success"])
    (records / place).parent.mkdir(parents=True, exist_ok=True)
    (records / place).write_text(json.dumps(sealed(values)), encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        assert clbench.load_records(records).equals(before)
    assert f"{place}: it belongs at Toy-v0/sft/seed-0.json in the folder of records." in caplog.text


def test_a_folder_of_one_method_is_read_from_inside_and_through_a_link(
    records: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = record_path(records, "clbench/Toy-v0", "sft", 0).parent
    (tmp_path / "link").symlink_to(folder)
    monkeypatch.chdir(folder)
    assert len(clbench.load_records(".")) == len(clbench.load_records(tmp_path / "link")) > 0


def test_the_largest_seed_stays_what_it_is(tmp_path: Path, make_record: Callable[..., Record]) -> None:
    path = record_path(tmp_path, "clbench/Toy-v0", "sft", LARGEST_SEED)
    write_record(make_record(RATES, episodes=4, seed=LARGEST_SEED), path)
    assert set(clbench.load_records(tmp_path).seed) == {LARGEST_SEED}


def test_the_log_does_not_control_the_terminal(records: Path, caplog: pytest.LogCaptureFixture) -> None:
    (records / "\x1b[2Jevil.json").write_text("{}", encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        clbench.load_records(records)
    assert "\\x1b[2Jevil.json: is not a record" in caplog.text
    assert "\x1b" not in caplog.text


@pytest.mark.parametrize(
    ("column", "value"),
    [("stage", "abc"), ("stage", 99), ("success", 5), ("episode", 1.7), ("task", "x")],
)
def test_a_record_with_an_impossible_value_is_left_out_by_name(
    column: str, value: object, records: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = record_path(records, "clbench/Toy-v0", "sft", 0)
    values = json.loads(path.read_text(encoding="utf-8"))
    values["episodes"][column][0] = value
    path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        found = clbench.load_records(records)
    assert set(found.method) == {"lora+rank=4"}
    assert f"{path}: episodes: row 0" in caplog.text
