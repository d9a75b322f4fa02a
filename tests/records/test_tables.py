"""Records as pandas tables."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pytest
from helpers import RATES, reverse_targets, write_two_records

import clbench
from clbench.records.record import Record
from clbench.scoring.scores import Scores


@pytest.fixture
def records(tmp_path: Path, make_record: Callable[..., Record]) -> Path:
    """Return a folder with two records, and a file that is none."""
    return write_two_records(tmp_path, make_record)


def test_a_record_has_a_labelled_matrix_that_equals_its_scores(records: Path) -> None:
    record = clbench.read_record(str(next(records.rglob("seed-0.json"))))
    matrix = record.matrix()
    assert list(matrix.index) == ["pretrained", *record.scenario.target]
    assert matrix.columns.names == ["group", "task"]
    np.testing.assert_allclose(matrix.to_numpy(), RATES)
    np.testing.assert_allclose(matrix.to_numpy(), Scores.from_record(record).success.mean(axis=-1))
    assert matrix["retained"].shape == (3, 2)
    assert len(record.frame()) == len(record.episodes["task"])


def test_a_matrix_names_the_stages_by_the_targets_in_the_order_in_which_they_were_learned(
    make_record: Callable[..., Record],
) -> None:
    record = make_record(RATES, episodes=4)
    reverse_targets(record)
    matrix = record.matrix()
    assert list(matrix.index) == ["pretrained", "target_1", "target_0"]
    assert list(matrix["target"]) == ["target_1", "target_0"]
    np.testing.assert_allclose(matrix.to_numpy(), RATES)


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


def test_the_matrix_of_a_failed_run_has_no_row_for_a_stage_that_did_not_end(
    make_record: Callable[..., Record],
) -> None:
    rates, on_the_way = np.full((3, 4), 0.5), np.ones((2, 3))
    record = make_record(rates, curves=on_the_way, episodes=4)
    ended = [row for row in record.episode_rows() if (row.stage, row.step) != (2, 400)]
    for column, values in zip(record.episodes.values(), zip(*ended, strict=True), strict=True):
        column[:] = values
    assert max(record.episodes["stage"]) == 2
    assert list(record.matrix().index) == ["pretrained", "target_0"]
    for column in record.episodes.values():
        column.clear()
    assert record.matrix().empty
