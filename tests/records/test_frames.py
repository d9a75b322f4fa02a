"""Records as tables of pandas."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pytest

import clbench
from clbench.base.errors import NoRecordsError
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.scoring.scores import Scores

RATES = [[1.0, 0.5, 0.0, 0.0, 0.25], [0.5, 0.25, 1.0, 0.0, 0.0], [0.0, 0.5, 0.75, 1.0, 0.0]]


@pytest.fixture
def records(tmp_path: Path, make_record: Callable[..., Record]) -> Path:
    """Return a folder with two records, one of them with changed settings, and a file that is none."""
    for method, seed, changes in (("sft", 0, {}), ("lora", 3, {"rank": 4})):
        record = make_record(RATES, episodes=4, method=method, seed=seed, changes=changes, settings=changes)
        name = "lora+rank=4" if changes else method
        write_record(record, record_path(tmp_path, "clbench/Toy-v0", name, seed))
    (tmp_path / "notes.json").write_text("{}")
    return tmp_path


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


def test_a_record_has_a_labelled_matrix_that_equals_its_scores(records: Path) -> None:
    record = clbench.read_record(str(next(records.rglob("seed-0.json"))))
    matrix = record.matrix()
    assert list(matrix.index) == ["pretrained", *record.scenario.target]
    assert matrix.columns.names == ["group", "task"]
    np.testing.assert_allclose(matrix.to_numpy(), RATES)
    np.testing.assert_allclose(matrix.to_numpy(), Scores.from_record(record).success.mean(axis=-1))
    assert matrix["retained"].shape == (3, 2)
    assert len(record.frame()) == len(record.episodes["task"])


def test_records_and_scenarios_say_in_a_line_what_they_are(records: Path) -> None:
    record = clbench.read_record(next(records.rglob("seed-0.json")))
    assert repr(record).startswith("<Record of sft on clbench/Toy-v0, seed 0: success, ")
    assert len(repr(record)) < 100
    html = record._repr_html_()
    assert "&lt;Record of sft" in html
    assert "<table" in html
    text = repr(clbench.load_scenario("clbench.testing:clbench/Toy-v0"))
    assert text == "<Scenario clbench/Toy-v0: retained left, up; targets right, down; held out up_left>"


def test_notebooks_show_scenarios_and_tasks_as_tables() -> None:
    scenario = clbench.load_scenario("clbench.testing:clbench/Toy-v0")
    shown = scenario._repr_html_()
    assert shown.count("<tr>") == 1 + len(scenario.tasks)
    assert "<td>held out</td><td>up_left</td>" in shown
    task = scenario.task("right")
    shown = task._repr_html_()
    assert "<br>".join(task.instructions) in shown
    assert f"<td>horizon</td><td>{task.horizon}</td>" in shown
    assert "<td>camera</td>" not in shown


def test_the_table_of_a_run_that_failed_at_once_is_empty(make_record: Callable[..., Record]) -> None:
    record = make_record(RATES, episodes=4)
    for column in record.episodes.values():
        column.clear()
    assert isinstance(record.frame(), pandas.DataFrame)
    assert record.frame().empty
