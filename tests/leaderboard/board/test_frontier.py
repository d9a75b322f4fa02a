"""The ladder of learning rates: its curves."""

from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.base.entry_points import resolve
from clbench.records.paths import label_of, record_path
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record

SCENARIO = "clbench/Even-v1"
MODULE = "clbench.leaderboard.board.frontier"
frontiers_of, ladder_of, read_ladder = (
    resolve(f"{MODULE}:{name}") for name in ("frontiers_of", "ladder_of", "read_ladder")
)
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")


def test_the_ladder_lies_beside_the_records_as_they_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "board").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "board" / "records").symlink_to(tmp_path / "data")
    assert ladder_of(tmp_path / "board" / "records") == tmp_path / "board" / "ladder"
    monkeypatch.chdir(tmp_path / "board" / "records")
    assert ladder_of(Path("../board/records")) == tmp_path / "board" / "ladder"


def test_curves_of_a_method_with_other_settings_are_named_by_these(even_board: Callable[..., Path]) -> None:
    for factor in (1.0, 0.3):
        even_board("finch", 0, 0.2, "ladder", step_factor=factor)
        even_board("finch", 0, 0.4, "ladder", kappa=0.5, step_factor=factor)
        even_board("l2_sp", 0, 0.4, "ladder", strength=2.0, step_factor=factor)
    curves = compute_board(even_board("sft", 0, 0.1)).frontiers[SCENARIO]
    assert [curve.method for curve in curves] == ["finch", "finch+kappa=0.5", "l2_sp"]
    assert [[rung.factor for rung in curve.rungs] for curve in curves] == [[1.0, 0.3]] * 3


def test_curves_are_over_the_seeds_that_all_runs_of_the_ladder_have(even_board: Callable[..., Path]) -> None:
    for factor in (1.0, 0.3):
        for seed in (0, 1):
            even_board("finch", seed, 0.2, "ladder", step_factor=factor)
        even_board("sft", 1, 0.2, "ladder", step_factor=factor)
    even_board("sft", 2, 0.9, "ladder", step_factor=0.3)  # a lucky seed, which the others do not have
    curves = compute_board(even_board("sft", 0, 0.1)).frontiers[SCENARIO]
    assert [(curve.method, [rung.seeds for rung in curve.rungs]) for curve in curves] == [
        ("sft", [(1,), (1,)]),
        ("finch", [(1,), (1,)]),
    ]


def test_one_learning_rate_is_no_ladder(even_board: Callable[..., Path]) -> None:
    even_board("finch", 0, 0.2, "ladder", step_factor=0.3)
    even_board("sft", 0, 0.2, "ladder", step_factor=0.3)
    assert not compute_board(even_board("sft", 0, 0.1)).frontiers


@pytest.mark.parametrize("factor", [1, 1.0000001, 0.0, -1.0])
def test_a_learning_rate_that_no_run_writes_is_no_rung_and_takes_no_record_of_one_away(
    factor: float, even_board: Callable[..., Path]
) -> None:
    for honest in (1.0, 0.3):
        even_board("sft", 0, 0.2, "ladder", step_factor=honest)
    even_board("sft", 0, 0.9, "ladder", step_factor=factor)
    board = compute_board(even_board("sft", 0, 0.1))
    (curve,) = board.frontiers[SCENARIO]
    assert [(rung.factor, rung.kept.value, rung.seeds) for rung in curve.rungs] == [
        (1.0, pytest.approx(0.2), (0,)),
        (0.3, pytest.approx(0.2), (0,)),
    ]
    (refused,) = board.not_shown
    assert refused.path == f"ladder/Even-v1/sft+step_factor={factor}/seed-0.json"
    assert "its changes have no step_factor, the ladder's setting, of up to six digits" in refused.reason


def test_a_ladder_of_another_simulator_has_no_curve_and_the_board_says_why(
    even_board: Callable[..., Path],
) -> None:
    records = even_board("sft", 0, 0.1)
    for factor in (1.0, 0.3):
        even_board("finch", 0, 0.2, "ladder", step_factor=factor)
    for path in (records.parent / "ladder").rglob("seed-*.json"):
        record = read_record(path)
        record.fingerprint["rollouts"] = {"clbench.testing:ToyWorld": "another"}
        write_record(record, path)
    board = compute_board(records)
    assert not board.frontiers
    assert [one.reason for one in board.not_shown] == [
        "it cannot be compared with the board: rollouts differ."
    ] * 2


def test_a_rung_has_what_was_learned_in_each_stage_and_what_is_kept_of_skills_and_earlier_targets(
    make_record: Callable[..., Record], tmp_path: Path
) -> None:
    for factor, kept in ((0.3, 0.2), (0.1, 0.8)):
        success = [[1, 1, 0, 0, 0], [0.5, 0.5, 0.9, 0, 0], [0.6, 0.4, kept, 0.8, 0]]
        changes = {"step_factor": factor}
        record = make_record(success, settings=changes, changes=changes)
        write_record(record, record_path(tmp_path / "ladder", "clbench/Toy-v0", label_of("sft", changes), 0))
    (curve,) = frontiers_of(read_ladder(tmp_path / "ladder")[0])["clbench/Toy-v0"]
    found = [(rung.factor, rung.learned.value, rung.kept.value) for rung in curve.rungs]
    assert found == [pytest.approx((0.3, 0.85, 1.2 / 3)), pytest.approx((0.1, 0.85, 1.8 / 3))]
