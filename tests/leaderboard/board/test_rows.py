"""Rows of the board where methods have other seeds than plain fine-tuning, or were trained elsewhere."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import complete_record, set_in, write_unchecked

from clbench.base.entry_points import resolve
from clbench.records.record import Record

agreement = resolve("clbench.leaderboard.board.rows:agreement")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
costs_of = resolve("clbench.leaderboard.board.costs:costs_of")
division_of = resolve("clbench.leaderboard.board.runs:division_of")
no_row = resolve("clbench.leaderboard.board.runs:no_row")
pretrained_success = resolve("clbench.leaderboard.board.rows:pretrained_success")
standing_of = resolve("clbench.leaderboard.board.rows:standing_of")
unpaired = resolve("clbench.leaderboard.board.rows:unpaired")
values_by_seed = resolve("clbench.leaderboard.board.rows:values_by_seed")

LUCK = (0.1, 0.1, 0.5, 0.5)
"""What plain fine-tuning keeps with each of four seeds."""


@pytest.fixture
def board(even_board: Callable[..., Path]) -> Path:
    """Return records in which a method has lucky seeds only; with them it is worse than plain fine-tuning."""
    for seed, kept in enumerate(LUCK):
        even_board("sft", seed, kept)
        records = even_board("lora", seed, kept + 0.1)
    for seed in (2, 3):
        even_board("finch", seed, LUCK[seed] - 0.1)
    return records


def test_a_method_with_lucky_seeds_alone_does_not_stand_above_methods_that_beat_it_on_them(
    board: Path,
) -> None:
    rows = compute_board(board).rows
    assert [row.method for row in rows] == ["lora", "sft", "finch"]
    finals = {row.method: row.estimates["final_average"].value for row in rows}
    assert finals["finch"] > finals["sft"]
    assert [standing_of(row, rows).place for row in rows] == [1, 2, 3]


def test_a_method_with_more_seeds_than_plain_fine_tuning_is_sorted_by_the_common_ones(
    board: Path, even_board: Callable[..., Path]
) -> None:
    even_board("finch", 4, 0.9)
    assert [row.method for row in compute_board(board).rows] == ["lora", "sft", "finch"]


def test_a_method_without_a_seed_of_plain_fine_tuning_comes_after_the_others(
    board: Path, even_board: Callable[..., Path]
) -> None:
    before = [row.method for row in compute_board(board).rows]
    even_board("l2_sp", 5, 0.45)  # the highest final average, with a seed that may be lucky
    assert [row.method for row in compute_board(board).rows] == [*before, "l2_sp"]


def test_without_any_seed_of_plain_fine_tuning_rows_are_sorted_by_final_average(
    even_board: Callable[..., Path],
) -> None:
    for method, rate in (("lora", 0.4), ("l2_sp", 0.5), ("finch", 0.3)):
        records = even_board(method, 0, rate)
    assert [row.method for row in compute_board(records).rows] == ["l2_sp", "lora", "finch"]


def test_a_row_with_fewer_seeds_takes_no_seed_from_the_others(board: Path) -> None:
    rows = compute_board(board).rows
    values = values_by_seed(rows)
    assert {method: len(found) for method, found in values.items()} == {"lora": 4, "sft": 4}


def test_a_control_does_not_count_as_one_more_method(even_board: Callable[..., Path]) -> None:
    for method in ("sft", "consft_calibrated", "constant_weight", "shuffled_weights"):
        records = even_board(method, 0, 0.5)
    rows = compute_board(records).rows
    assert len(rows) == 4
    assert sorted(values_by_seed(rows)) == ["consft_calibrated", "sft"]


def test_values_of_two_metrics_are_of_the_same_methods_and_seeds(board: Path) -> None:
    rows = compute_board(board).rows
    kept, finals = values_by_seed(rows, "kept"), values_by_seed(rows)
    assert {method: len(values) for method, values in kept.items()} == {
        method: len(values) for method, values in finals.items()
    }
    assert kept["sft"] == pytest.approx(LUCK, abs=0.03)
    assert values_by_seed(rows, "gain") == {}  # it needs a reference


def test_the_relative_cost_compares_equal_seeds(even_board: Callable[..., Path]) -> None:
    for seed in range(2):
        records = even_board("sft", seed, 0.5)
    even_board("lora", 1, 0.5)
    runs = {row.method: row.runs for row in compute_board(records).rows}
    for run, steps in zip((*runs["sft"], *runs["lora"]), (10, 40, 20), strict=True):
        run.record.costs.optimiser_steps = steps
        run.record.timing["step_ratio"] = 3.0
    assert costs_of(runs["lora"], runs["sft"])["relative_cost"] == pytest.approx(1.5)
    assert costs_of(runs["sft"], runs["sft"][:1])["relative_cost"] == 1.0
    assert costs_of(runs["lora"], runs["sft"][:1])["relative_cost"] is None
    # a mean over the seeds that state a cost alone would be another
    runs["sft"][0].record.costs.bytes_kept = None
    costs = costs_of(runs["sft"], runs["sft"])
    assert (costs["bytes_kept"], costs["steps"]) == (None, 25)


def test_steps_to_the_criterion_of_one_seed_have_no_interval(even_board: Callable[..., Path]) -> None:
    (row,) = compute_board(even_board("sft", 0, 0.5)).rows
    steps, success = row.estimates["steps_to_criterion"], row.estimates["final_average"]
    assert steps.value is not None
    assert (steps.low, steps.high) == (None, None)
    assert success.low < success.value < success.high


def test_a_setting_that_older_records_lack_splits_no_row(add: Callable[..., Path], tmp_path: Path) -> None:
    add("lora", 0, edit=set_in("run", "settings", {"rank": 16}))
    add("lora", 1, edit=set_in("run", "settings", {"rank": 16, "speed": 3.0}))
    board = compute_board(tmp_path / "leaderboard" / "records")
    assert [(row.method, row.seeds) for row in board.rows] == [("lora", (0, 1))]
    assert board.not_shown == ()


# ---- rows as far as the functions read them ----------------------------------------------------------------


def _row(method: str, scores: dict[int, Any], division: str = "prior-data-free", **fields: Any) -> Any:
    """Return a row of a scenario whose seeds have orders of their own."""
    given = {"balanced": True, "starts": [1.0], "height": 0.0, "letters": "a", **fields}
    runs = [
        SimpleNamespace(
            published=SimpleNamespace(balanced=given["balanced"]),
            record=SimpleNamespace(retained_at_start=lambda start=start: start),
        )
        for start in given["starts"]
    ]
    return SimpleNamespace(
        method=method,
        division=division,
        scores=scores,
        seeds=tuple(scores),
        runs=runs,
        height=given["height"],
        letters=given["letters"],
    )


def test_rows_of_one_height_share_a_place_and_the_next_one_counts_both() -> None:
    heights = {"one": 0.2, "two": 0.2 + 1e-12, "three": 0.1, "reference": 0.9, "missing": None}
    rows = [_row(name, {}, height=height) for name, height in heights.items()]
    rows[3].division, rows[4].letters = "reference", None
    standings = [standing_of(row, rows) for row in rows]
    assert [one and (one.place, one.count) for one in standings] == [(1, 3), (1, 3), (3, 3), (1, 1), None]


def test_the_success_of_the_pretrained_policy_is_that_of_plain_fine_tuning_or_of_another_method() -> None:
    joint, lora = _row("joint", {}, "reference", starts=[0.1]), _row("lora", {}, starts=[0.9, None, 0.7])
    sft = _row("sft", {}, starts=[0.2, 0.3])
    assert pretrained_success([joint, lora, sft]) == pytest.approx(0.25)
    assert pretrained_success([joint, lora]) == pytest.approx(0.8)
    assert pretrained_success([joint]) is None
    assert pretrained_success([_row("sft", {}, starts=[None])]) is None


def test_only_seeds_with_orders_of_their_own_have_an_agreement(scores: Callable[..., Any]) -> None:
    made = []
    for number, name in enumerate(("sft", "ewc", "lora", "aegis", "lwf", "finch")):
        run = scores(np.full((2, 2), 0.1 * number), groups=(1, 1, 0), episodes=10)
        made.append(_row(name, dict.fromkeys(range(4), run)))
    found = agreement(made)
    assert (found.w, found.seeds, found.rows) == (pytest.approx(1.0), 4, 6)
    for row in made:
        row.runs[0].published.balanced = False
    assert agreement(made) is None


@pytest.mark.parametrize(
    ("demonstrations", "questions", "reference", "division"),
    [
        ("never", "never", False, "prior-data-free"),
        ("never", "prepare", False, "prior questions"),
        ("throughout", "never", False, "prior demonstrations"),
        ("prepare", "throughout", False, "prior demonstrations"),  # of both, what tells more counts
        ("prepare", "throughout", True, "reference"),
    ],
)
def test_a_method_competes_with_those_that_may_look_at_as_much(
    demonstrations: str, questions: str, reference: bool, division: str
) -> None:
    uses = {"demonstrations": demonstrations, "questions": questions, "reference": reference}
    assert division_of(uses) == division


def test_a_page_of_a_reason_is_cut() -> None:
    assert no_row("a", "x" * 300).reason == "x" * 300
    assert no_row("a", "x" * 301).reason == "x" * 300 + "…"


# ---- policies that were trained elsewhere ------------------------------------------------------------------


@pytest.fixture
def add_elsewhere(make_record: Callable[..., Record], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that adds the record of a policy that was trained elsewhere."""

    def add(seed: int, checks: dict[str, list[Any]] | None = None) -> Path:
        run = {
            "method": "me/elsewhere",
            "seed": seed,
            "scenario": "clbench/Even-v1",
            "uses": {"external": True},
        }
        record = make_record(np.full((3, 5), 0.5), steps=(20,), ends=(20, 20), complete=False, **run)
        record.scenario.balanced = True  # its targets keep the published order all the same
        record.checks = {name: [] for name in record.checks}
        complete_record(record)
        record.checks |= checks or {}
        path = tmp_path / "records" / "Even-v1" / "me--elsewhere" / f"seed-{seed}.json"
        write_unchecked(record, path)
        return tmp_path / "records"

    return add


def test_a_policy_trained_elsewhere_has_a_row_with_every_seed(
    even_board: Callable[..., Path], add_elsewhere: Callable[..., Path]
) -> None:
    for seed in range(4):
        even_board("sft", seed, 0.5)
        records = add_elsewhere(seed)
    table = compute_board(records)
    assert table.not_shown == ()
    assert {row.method: row.seeds for row in table.rows} == {
        "sft": (0, 1, 2, 3),
        "me/elsewhere": (0, 1, 2, 3),
    }
    gains = {row.method: row.estimates["gain"].value for row in table.rows}
    assert gains == {"sft": 0, "me/elsewhere": None}  # it had other data, and is compared with nothing


def test_a_policy_trained_elsewhere_has_no_learning_curve_where_stages_end_at_a_criterion(
    add_elsewhere: Callable[..., Path],
) -> None:
    (row,) = compute_board(add_elsewhere(0)).rows
    assert row.estimates["forward_transfer_libero"].value is None
    assert row.estimates["area_under_curve_libero"].value is None


def test_an_episode_of_a_tuning_seed_makes_no_row(add_elsewhere: Callable[..., Path]) -> None:
    table = compute_board(add_elsewhere(100))
    assert table.rows == ()
    assert "seeds from 100 are for tuning" in table.not_shown[0].reason


def test_a_policy_trained_elsewhere_cannot_have_checks(add_elsewhere: Callable[..., Path]) -> None:
    checks = {"stage": [99], "step": [1], "successes": ["x"], "episodes": [20]}
    table = compute_board(add_elsewhere(0, checks))
    assert table.rows == ()
    assert "a policy that was trained elsewhere is not checked" in table.not_shown[0].reason


def test_runs_that_began_with_another_pretrained_policy_than_plain_fine_tuning_are_listed() -> None:
    def row(method: str, division: str = "prior-data-free", **policies: str) -> Any:
        runs = [
            SimpleNamespace(seed=int(seed[1:]), record=SimpleNamespace(fingerprint={"pretrained": policy}))
            for seed, policy in policies.items()
        ]
        return SimpleNamespace(method=method, division=division, runs=runs)

    sft = row("sft", s0="a", s1="b")
    others = row("mine:Mine", s0="a", s1="c", s2="d"), row("lora", s0="a", s1="b")
    assert unpaired([sft, *others, row("them", "external", s0="z")]) == {"mine:Mine": [1]}
    assert unpaired(others) == {}


def test_a_relative_cost_takes_steps_and_times_of_the_seeds_that_both_methods_have(
    even_board: Callable[..., Path],
) -> None:
    for seed in range(2):
        records = even_board("sft", seed, 0.5)
    for seed in (1, 2):
        even_board("lora", seed, 0.5)
    runs = {row.method: row.runs for row in compute_board(records).rows}
    figures = zip((*runs["sft"], *runs["lora"]), (10, 40, 20, 80), (1, 1, 3.0, 9.0), strict=True)
    for run, steps, ratio in figures:
        run.record.costs.optimiser_steps, run.record.timing["step_ratio"] = steps, ratio
    assert costs_of(runs["lora"], runs["sft"])["relative_cost"] == pytest.approx(20 / 40 * 3.0)


def test_the_time_of_a_step_is_the_geometric_mean_of_the_seeds_that_measured_it(
    even_board: Callable[..., Path],
) -> None:
    for seed in range(3):
        even_board("sft", seed, 0.5)
        records = even_board("lora", seed, 0.5)
    runs = {row.method: row.runs for row in compute_board(records).rows}
    for run, ratio in zip(runs["lora"], (2.0, 8.0, None), strict=True):
        run.record.costs.optimiser_steps = runs["sft"][0].record.costs.optimiser_steps
        run.record.timing["step_ratio"] = ratio
    assert costs_of(runs["lora"], runs["sft"])["relative_cost"] == pytest.approx(4.0)


def test_a_method_without_a_step_costs_nothing_though_no_time_of_a_step_was_measured(
    even_board: Callable[..., Path],
) -> None:
    even_board("sft", 0, 0.5)
    runs = {row.method: row.runs for row in compute_board(even_board("frozen", 0, 0.5)).rows}
    runs["frozen"][0].record.costs.optimiser_steps = 0
    runs["frozen"][0].record.timing["step_ratio"] = None
    assert costs_of(runs["frozen"], runs["sft"])["relative_cost"] == 0.0
    assert costs_of(runs["frozen"], [])["relative_cost"] == 0.0


def test_references_are_in_no_group(even_board: Callable[..., Path]) -> None:
    for method in ("sft", "lora", "frozen", "joint"):
        records = even_board(method, 0, 0.5)
    letters = {row.method: row.letters for row in compute_board(records).rows}
    assert letters == {"sft": "a", "lora": "a", "frozen": None, "joint": None}
