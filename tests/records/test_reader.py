"""The reader of records: a file that is not a record is refused, and the error names its fault."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers import sealed

from clbench.records.reader import RecordError, read_record
from clbench.records.record import Costs, Record, Relearning
from clbench.records.writer import write_record

RELEARNING: dict[str, Any] = {"skill": "left", "successes": 3, "steps": 14, "met": True}


def change(path: Path, **fields: Any) -> None:
    """Set fields of the record at `path`, and its hash."""
    values = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(sealed({**values, **fields})), encoding="utf-8")


def test_a_torn_record_is_refused_wherever_it_is_torn(record: Record, tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    whole = path.read_bytes()
    for length in range(0, len(whole) - 2, 97):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordError, match="cannot be read as JSON"):
            read_record(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[1, 2]", "whole number from 2 to 5, found no object."),
        (b"7", "whole number from 2 to 5, found no object."),
        (b"{}", "whole number from 2 to 5, found none."),
        (b'{"schema": 0}', "whole number from 2 to 5, found '0'."),
        (b'{"results": {"success": 1.0}}', "whole number from 2 to 5, found none."),
        (b'{"schema": 3}', "a record of schema 3: status, run, scenario, "),
    ],
)
def test_foreign_json_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "record.json").write_bytes(content)
    with pytest.raises(RecordError, match=re.escape(words)):
        read_record(tmp_path / "record.json")


@pytest.mark.parametrize(
    "content", [b"\xff\xfe", b"[" * 100_000, b'{"schema": NaN}', b'{"schema": ' + b"9" * 5000 + b"}"]
)
def test_hostile_bytes_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "record.json").write_bytes(content)
    with pytest.raises(RecordError, match="JSON"):
        read_record(tmp_path / "record.json")


def test_a_path_that_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    for name in ("folder.json", "absent.json"):
        with pytest.raises(RecordError, match="cannot be read"):
            read_record(tmp_path / name)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"schema": 6}, "has schema 6, which is newer than 5: update clbench"),
        ({"schema": 1}, r"whole number from 2 to 5, found '1'\."),
        ({"schema": True}, r"found 'True'\."),
        ({"score": 0.99}, "score"),
        ({"status": "great"}, "great"),
        ({"run": None}, "run"),
        ({"costs": [1]}, "costs"),
        ({"error": "yes"}, "error"),
        ({"status": "failed"}, "error must be an object"),
        (
            {"run": {}},
            "run: scenario, method, seed, device, split, settings, changes, uses, order, perturb, policy",
        ),
        (
            {"scenario": {"id": "x"}},
            "scenario: retained, target, held_out, evaluation_steps, budget, balanced are missing",
        ),
        ({"costs": {}}, "costs: optimiser_steps, parameters, preparation_steps, parameters_added, "),
        ({"relearning": "left"}, "relearning must be an object with named entries or null"),
        ({"relearning": {**RELEARNING, "steps": 3.0}}, "relearning: steps must be a whole number, not 3.0"),
        ({"relearning": {**RELEARNING, "met": 1}}, "relearning: met must be true or false, not 1"),
        ({"relearning": {"skill": "left"}}, "relearning: successes, steps, met are missing"),
        ({"status": "failed", "error": {"where": "loss"}}, "error must have the entries where, type, mess"),
        (
            {"status": "failed", "error": dict.fromkeys(("where", "type", "message", "traceback"), 1)},
            "error: where must be a string",
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


@pytest.mark.parametrize("cost", vars(Costs()))
def test_no_cost_but_the_number_of_added_parameters_may_be_below_0(
    cost: str, record: Record, tmp_path: Path
) -> None:
    write_record(record, tmp_path / "record.json")
    change(tmp_path / "record.json", costs={**vars(record.costs), cost: -1})
    if cost == "parameters_added":
        assert read_record(tmp_path / "record.json").costs.parameters_added == -1
        return
    with pytest.raises(RecordError, match=f"costs: {cost} must not be below 0"):
        read_record(tmp_path / "record.json")


def test_relearning_is_read_as_it_was_written(make_record: Callable[..., Record], tmp_path: Path) -> None:
    found = Relearning(**RELEARNING)
    record = make_record([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]], relearning=found)
    write_record(record, tmp_path / "record.json")
    assert read_record(tmp_path / "record.json").relearning == found


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ({"order": "1"}, "run: order must be a whole number"),
        ({"order": True}, "run: order must be a whole number"),
        ({"order": 1.0}, "run: order must be a whole number, not 1.0"),
        ({"order": -1}, "run: order must be from 0 to 99"),
        ({"order": 2**63}, "run: order must be from 0 to 99"),
        ({"split": "all"}, "run: split must be test or validation, not 'all'"),
        ({"perturb": 1}, "run: perturb must be true or false, not 1"),
        ({"seed": False}, "run: seed must be a whole number, not false"),
        ({"method": ["sft"]}, "run: method must be a string"),
        ({"oder": 1}, "No field of run is called 'oder'. Did you mean 'order'?"),
    ],
)
def test_a_field_of_the_run_of_another_type_is_refused_by_name(
    field: dict[str, Any], words: str, record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    change(path, run={**vars(record.run), "order": 3})
    assert read_record(path).run.order == 3
    change(path, run={**vars(record.run), **field})
    with pytest.raises(RecordError, match=re.escape(words)):
        read_record(path)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({"test_questions": None}, "test_questions of its budget must be a whole number, not null"),
        ({"test_questions": "x" * 99}, f'whole number, not "{"x" * 59}.'),
        ({"test_questions": -1}, "test_questions of its budget must be a whole number, not -1"),
        ({"curve_episodes": 10**9}, "curve_episodes of its budget must be at most its test_episodes, "),
    ],
)
def test_a_count_that_no_budget_has_is_refused(
    counts: dict[str, Any], words: str, record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    change(path, scenario={**vars(record.scenario), "budget": {**record.scenario.budget, **counts}})
    with pytest.raises(RecordError, match=re.escape(words)):
        read_record(path)


def test_a_run_cannot_choose_an_order_where_its_seed_does(record: Record, tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    change(path, scenario={**vars(record.scenario), "balanced": True})
    assert read_record(path).scenario.balanced
    change(path, run={**vars(record.run), "order": 3})
    with pytest.raises(RecordError, match="run: order must be 0: each seed of its scenario has"):
        read_record(path)


@pytest.mark.parametrize("name", ["episodes", "answers", "policy"])
def test_columns_that_do_not_fit_together_are_refused_by_name(
    name: str, record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    columns = getattr(record, name)
    unequal = {**columns, "stage": columns["stage"][1:]}
    foreign = {**columns, "reward": columns["stage"]}
    tables: tuple[tuple[Any, str], ...] = (
        (unequal, f"the columns of {name} have different lengths"),
        (foreign, f"{name} must have the columns stage, step"),
        ({}, f"{name} must have the columns stage, step"),
        (None, name),
        ([], name),
        (dict.fromkeys(columns, 1), f"{name}: stage must be a list"),
    )
    for table, words in tables:
        write_record(record, path)
        change(path, **{name: table})
        with pytest.raises(RecordError, match=words):
            read_record(path)


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ({"retained": None}, "scenario: retained must be a list, not null"),
        ({"retained": "skill"}, 'scenario: retained must be a list, not "skill"'),
        ({"retained": [1]}, "an entry of scenario: retained must be a string, not 1"),
        ({"evaluation_steps": None}, "scenario: evaluation_steps must be a list, not null"),
        ({"evaluation_steps": 400}, "scenario: evaluation_steps must be a list, not 400"),
        ({"evaluation_steps": [100.0]}, "scenario: evaluation_steps must be a whole number, not 100.0"),
        ({"evaluation_steps": ["400"]}, 'scenario: evaluation_steps must be a whole number, not "400"'),
        ({"evaluation_steps": [True]}, "an entry of scenario: evaluation_steps must be a whole number"),
        ({"budget": []}, "scenario: budget must be an object with named entries"),
    ],
)
def test_an_entry_of_the_scenario_of_another_type_is_refused_by_name(
    field: dict[str, Any], words: str, record: Record, tmp_path: Path
) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    change(path, scenario={**vars(record.scenario), **field})
    with pytest.raises(RecordError, match=re.escape(words)):
        read_record(path)


def test_a_record_whose_values_changed_is_refused_by_its_hash(record: Record, tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"seed": 0', '"seed": 1'), encoding="utf-8")
    words = "its content does not match its hash: the file was changed or damaged"
    with pytest.raises(RecordError, match=words):
        read_record(path)
    path.write_text(text.replace('"content": "', '"content": "0'), encoding="utf-8")
    with pytest.raises(RecordError, match=words):
        read_record(path)


def test_a_record_without_its_hash_is_refused(record: Record, tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_record(record, path)
    values = json.loads(path.read_text(encoding="utf-8"))
    del values["content"]
    path.write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(RecordError, match="a record of schema 5: content is missing"):
        read_record(path)


def test_a_record_may_be_indented_and_all_its_entries_reordered(record: Record, tmp_path: Path) -> None:
    record.run.settings = {"strength": 0.1, "name": "naïve"}
    path = tmp_path / "record.json"
    write_record(record, path)
    values = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(values, indent=4, ensure_ascii=False, sort_keys=True), encoding="utf-8")
    found = read_record(path)
    assert found == record
    assert found.episode_rows() == record.episode_rows()


def test_success_at_the_start_counts_the_scored_episodes_of_the_retained_skills_alone(
    make_record: Callable[..., Record],
) -> None:
    success = [[1.0, 0.8, 0.1, 0.0, 0.2], [0.6, 0.9, 0.9, 0.2, 0.3], [0.5, 0.4, 0.3, 0.8, 0.1]]
    record = make_record(success, perturbed=[[0.1, 0.1], [0.5, 0.8], [0.4, 0.2]], complete=False)
    assert record.retained_at_start() == pytest.approx((1.0 + 0.8) / 2)


def test_stages_that_are_dropped_leave_the_earlier_ones_whole(record: Record) -> None:
    record.diagnostics = {"0": {"a": 1}, "1": {"a": 2}}
    record.timing["stages"] = [{"evaluation": 1.0}, {"evaluation": 2.0}]  # of an agent, from stage 0
    before = [row for row in record.episode_rows() if row.stage == 0]
    record.drop_stages(1)
    assert record.episode_rows() == before != []
    assert [row.stage for row in record.answer_rows()] == [0]
    assert (record.diagnostics, record.timing["stages"]) == ({"0": {"a": 1}}, [{"evaluation": 1.0}])
