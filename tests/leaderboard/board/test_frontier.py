"""The ladder of learning rates: its curves, and gains over settings that tuning rated as highly."""

from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.base.entry_points import resolve
from clbench.records.paths import label_of, record_path
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.tuning import Tried, Tuned
from clbench.scoring.intervals import Estimate

SCENARIO = "clbench/Even-v1"
MODULE = "clbench.leaderboard.board.frontier"
TiedGain = resolve(f"{MODULE}:TiedGain")
side_of_zero = resolve(f"{MODULE}:side_of_zero")
frontiers_of, ladder_of, read_ladder, tied_gains = (
    resolve(f"{MODULE}:{name}") for name in ("frontiers_of", "ladder_of", "read_ladder", "tied_gains")
)
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
read_run = resolve("clbench.leaderboard.board.runs:read_run")


@pytest.fixture
def _tuned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tuning have rated plain fine-tuning alike at 0.1, which it chose, and at 0.3."""
    scores = {1.0: 0.4, 0.1: 0.6, 0.3: 0.6, 0.03: 0.5}
    tried = tuple(Tried({"step_factor": factor}, final, 0.9) for factor, final in scores.items())
    found = {"sft": Tuned({"step_factor": 0.1}, tried)}
    monkeypatch.setattr(f"{MODULE}.tuned", lambda name: found if name == SCENARIO else {})


def test_the_ladder_lies_beside_the_records_as_they_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "board").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "board" / "records").symlink_to(tmp_path / "data")
    assert ladder_of(tmp_path / "board" / "records") == tmp_path / "board" / "ladder"
    monkeypatch.chdir(tmp_path / "board" / "records")
    assert ladder_of(Path("../board/records")) == tmp_path / "board" / "ladder"


@pytest.mark.usefixtures("_tuned")
def test_a_gain_over_a_tied_setting_is_that_over_plain_fine_tuning_there_on_common_seeds(
    even_board: Callable[..., Path],
) -> None:
    for seed, kept in enumerate((0.6, 0.6, 0.7, 0.9)):
        records = even_board("lora", seed, kept)
    for seed, kept in enumerate((0.2, 0.2, 0.5)):
        even_board("sft", seed, kept, "ladder", step_factor=0.3)
        even_board("sft", seed, 0.0, "ladder", step_factor=0.1)  # tuning's choice is on the board already
        even_board("stop_gradient", seed, 0.9, "ladder", step_factor=0.3)
    runs = [read_run(records, path) for path in sorted(records.rglob("seed-*.json"))]
    ladder, _ = read_ladder(ladder_of(records))
    (one,) = tied_gains(SCENARIO, {"lora": {run.seed: run.scores for run in runs}}, ladder)["lora"]
    assert (one.factor, one.seeds) == (0.3, 3)
    # the final average has three tasks that are kept, and the last target, which all learn alike
    differences = [3 / 4 * (0.6 - 0.2), 3 / 4 * (0.6 - 0.2), 3 / 4 * (0.7 - 0.5)]
    assert one.gain.value == pytest.approx(sum(differences) / 3)
    assert one.gain.low < one.gain.value < one.gain.high


@pytest.mark.usefixtures("_tuned")
def test_a_tied_setting_without_runs_shows_no_gain_that_would_be_certain(
    even_board: Callable[..., Path],
) -> None:
    for seed in range(2):
        even_board("sft", seed, 0.1)
        even_board("frozen", seed, 0.9)  # a reference, which does not compete
        records = even_board("lora", seed, 0.9)
    tied = compute_board(records).tied[SCENARIO]
    assert set(tied) == {"lora", "sft"}
    (one,) = tied["lora"]
    assert (one.factor, one.seeds, one.gain.value, one.is_certain) == (0.3, 0, None, False)


def test_a_gain_or_a_loss_is_certain_over_all_tied_settings_or_over_none() -> None:
    gain, loss, neither = (Estimate(middle, middle - 0.01, middle + 0.01) for middle in (0.02, -0.02, 0.005))
    up, down, unsure = (TiedGain(0.3, one, 4) for one in (gain, loss, neither))
    assert [side_of_zero(one, []) for one in (gain, loss, neither)] == [1, -1, 0]
    assert side_of_zero(gain, [up, up]) == 1
    assert side_of_zero(loss, [down]) == -1
    assert [side_of_zero(gain, tied) for tied in ([up, unsure], [unsure, up], [down])] == [0, 0, 0]
    assert [side_of_zero(loss, tied) for tied in ([unsure], [up])] == [0, 0]


def test_curves_of_a_method_with_other_settings_are_named_by_these(even_board: Callable[..., Path]) -> None:
    for factor in (1.0, 0.3):
        even_board("finch", 0, 0.2, "ladder", step_factor=factor)
        even_board("finch", 0, 0.4, "ladder", kappa=0.5, step_factor=factor)
        even_board("l2_sp", 0, 0.4, "ladder", strength=2.0, step_factor=factor)
    curves = compute_board(even_board("sft", 0, 0.1)).frontiers[SCENARIO]
    assert [curve.method for curve in curves] == ["finch", "finch+kappa=0.5", "l2_sp"]
    assert [[rung.factor for rung in curve.rungs] for curve in curves] == [[1.0, 0.3]] * 3


def test_one_learning_rate_is_no_ladder(even_board: Callable[..., Path]) -> None:
    even_board("finch", 0, 0.2, "ladder", step_factor=0.3)
    even_board("sft", 0, 0.2, "ladder", step_factor=0.3)
    assert not compute_board(even_board("sft", 0, 0.1)).frontiers


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
