"""What runs must share to make a row together."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve
from clbench.records.paths import label_of, record_path
from clbench.records.reader import RecordError
from clbench.records.record import Record
from clbench.records.writer import write_record

ALIKE = resolve("clbench.leaderboard.board.runs:ALIKE")
read_run = resolve("clbench.leaderboard.board.runs:read_run")
read_runs = resolve("clbench.leaderboard.board.runs:read_runs")

SCENARIO = "clbench/Toy-v0"


@pytest.mark.parametrize(
    ("part", "names"), [("method", {"method": "family:Mine"}), ("policy", {"policy": "mine:Policy"})]
)
def test_seeds_of_code_that_changed_between_them_make_no_row_together(
    part: str, names: dict[str, Any], make_record: Callable[..., Record], tmp_path: Path
) -> None:
    records = tmp_path / "records"
    for seed, code in enumerate(("old", "new", "new")):
        record = make_record([[1.0, 0.0], [0.5, 1.0]], groups=(1, 1, 0), episodes=2, seed=seed, method="sft")
        record.fingerprint[part] = {"source": code} if part == "method" else code
        run = dataclasses.replace(record.run, **names)
        path = record_path(records, SCENARIO, run.method, seed, policy=run.policy)
        write_record(dataclasses.replace(record, run=run), path)
    kept, refused = read_runs(records, read_run, ALIKE)
    assert len(kept) == 2
    (entry,) = refused
    assert entry.reason == f"its settings do not match most seeds: code of the {part} differ."


def test_a_record_that_lacks_a_setting_had_its_default_and_not_what_tuning_chose_later(
    make_record: Callable[..., Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.leaderboard.board.runs.tuned_settings", lambda *_: {"step_factor": 0.3})
    for seed, settings in enumerate(({}, {"step_factor": 0.3}, {"step_factor": 0.3})):
        record = make_record([[1.0, 0.0], [0.5, 1.0]], groups=(1, 1, 0), episodes=2, seed=seed, method="sft")
        run = dataclasses.replace(record.run, settings=settings, policy="tuned:Later")  # a table of its own
        path = record_path(tmp_path, SCENARIO, run.method, seed, policy=run.policy)
        write_record(dataclasses.replace(record, run=run), path)
    kept, refused = read_runs(tmp_path, read_run, ALIKE)
    assert [run.seed for run in kept] == [1, 2]
    (entry,) = refused
    assert entry.reason == "its settings do not match most seeds: step_factor differ."


def test_a_changed_setting_that_the_settings_do_not_have_is_refused(
    make_record: Callable[..., Record], tmp_path: Path
) -> None:
    changes = {"step_factor": 0.3}
    record = make_record(
        [[1.0, 0.0], [0.5, 1.0]],
        groups=(1, 1, 0),
        method="sft",
        settings={"step_factor": 1.0},
        changes=changes,
    )
    path = record_path(tmp_path, SCENARIO, label_of("sft", changes), 0)
    write_record(record, path)
    with pytest.raises(RecordError, match="run: changes and settings differ in step_factor"):
        read_run(tmp_path, path, changed=True)


@pytest.mark.parametrize(("only", "seeds"), [(None, [0, 1]), (("Toy-v0/sft/seed-1.json",), [1]), ((), [])])
def test_of_the_records_that_are_named_no_other_is_read(
    only: Any, seeds: list[int], make_record: Callable[..., Record], tmp_path: Path
) -> None:
    for seed in range(2):
        record = make_record([[1.0, 0.0], [0.5, 1.0]], groups=(1, 1, 0), episodes=2, seed=seed, method="sft")
        write_record(record, record_path(tmp_path, SCENARIO, "sft", seed))
    kept, refused = read_runs(tmp_path, read_run, ALIKE, only)
    assert ([run.seed for run in kept], refused) == (seeds, [])
