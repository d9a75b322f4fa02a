"""The place of a row, its letters and its tier, in words; how alike the seeds order the rows."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import Estimate
from clbench.scoring.scores import WEAK, WEAK_WARNING

TiedGain = resolve("clbench.leaderboard.board.certainty:TiedGain")
gain_text = resolve("clbench.leaderboard.views.format:gain_text")
agreement_text = resolve("clbench.leaderboard.views.format:agreement_text")
machine_text = resolve("clbench.leaderboard.views.format:machine_text")
unpaired_text = resolve("clbench.leaderboard.views.format:unpaired_text")
Concordance = resolve("clbench.leaderboard.board.agreement:Concordance")
tier_text = resolve("clbench.leaderboard.views.format:tier_text")
tiers_text = resolve("clbench.leaderboard.views.format:tiers_text")
aligned = resolve("clbench.leaderboard.views.format:aligned")
standing_text = resolve("clbench.leaderboard.views.format:standing_text")
start_text = resolve("clbench.leaderboard.views.format:start_text")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")


@pytest.fixture
def rows(add: Callable[..., Path], matrix: Any, tmp_path: Path) -> dict[str, Any]:
    """Return the rows of five methods by name, with given groups, and of a reference."""
    for number, method in enumerate(("best", "good", "twin", "middle", "worst")):
        add(method, 0, matrix * (1.0, 0.8, 0.8, 0.5, 0.1)[number])
    add("ideal", 0, uses={"demonstrations": "never", "questions": "never", "reference": True})
    table = compute_board(tmp_path / "leaderboard" / "records")
    letters = {"best": "a", "good": "b", "twin": "bc", "middle": "bcd", "worst": "d", "ideal": None}
    return {row.method: dataclasses.replace(row, letters=letters[row.method]) for row in table.rows}


def test_a_place_counts_the_better_rows_and_names_those_that_are_not_told_apart(rows: dict[str, Any]) -> None:
    board = list(rows.values())
    assert standing_text(rows["best"], board) == "place 1 of 5; told apart from the others of its division"
    assert standing_text(rows["good"], board) == "place 2 of 5; not told apart from twin, middle"
    assert standing_text(rows["twin"], board) == "place 2 of 5; not told apart from good, middle"
    assert standing_text(rows["middle"], board, 2) == "place 4 of 5; not told apart from good, twin, 1 more"
    assert standing_text(rows["worst"], board, 2) == "place 5 of 5; not told apart from middle"


def test_a_row_that_does_not_compete_has_no_place(rows: dict[str, Any]) -> None:
    board = list(rows.values())
    assert standing_text(rows["ideal"], board) == "a reference does not compete"
    lost = dataclasses.replace(rows["worst"], letters=None)
    assert standing_text(lost, board) == "no final average"
    assert standing_text(rows["best"], [rows["best"], rows["ideal"]]) == "place 1 of 1"
    two = [rows["best"], rows["worst"]]
    assert standing_text(rows["worst"], two) == "place 2 of 2; told apart from the other one of its division"


def test_letters_are_below_each_other_if_their_groups_are_the_same(rows: dict[str, Any]) -> None:
    board = list(rows.values())
    letters = [aligned(row.letters, board) for row in rows.values()]
    assert letters == ["a   ", " b  ", " bc ", " bcd", "   d", ""]


def test_a_tier_is_the_lowest_of_the_runs_and_names_those_above_it(rows: dict[str, Any]) -> None:
    (run,) = rows["best"].runs
    tiers = ["self-reported", "retrained", "replayed", "replayed"]
    runs = tuple(dataclasses.replace(run, tier=tier) for tier in tiers)
    mixed = dataclasses.replace(rows["best"], runs=runs)
    assert tier_text(mixed) == "self-reported; 2 of 4 runs replayed, 1 retrained"
    assert tier_text(rows["good"]) == "self-reported"
    assert tiers_text([mixed, rows["good"]]) == (
        "A row has the lowest tier of its runs. Runs with a higher tier: 2 of 5 replayed, 1 retrained."
    )
    alike = dataclasses.replace(rows["best"], tier="replayed", runs=runs[2:])
    assert tier_text(alike) == "replayed"
    assert tiers_text([alike, rows["good"]]) == ""


def test_only_an_agreement_beyond_chance_is_called_one() -> None:
    sure = Concordance(0.55, 0.0004, seeds=12, rows=15)
    assert agreement_text(sure) == (
        "The 12 seeds agree on the order of the 15 methods (without controls) more than chance would "
        "explain: Kendall's W 0.55, p < 0.001."
    )
    assert agreement_text(dataclasses.replace(sure, w=0.1, chance=0.2)) == (
        "It is not certain that the 12 seeds agree on the order of the 15 methods (without controls): "
        "Kendall's W 0.10, p = 0.2."
    )
    assert agreement_text(None) == ""


def test_a_table_of_another_kind_of_processor_warns_of_the_published_one() -> None:
    assert machine_text(None) == machine_text("") == ""
    assert machine_text("aarch64").startswith(
        "All these records were made on aarch64, where the simulators behave "
    )


def test_runs_that_did_not_begin_like_plain_fine_tuning_are_named_with_a_way_out() -> None:
    assert unpaired_text(None) == ""
    assert unpaired_text({"mine:Mine": [1, 2], "lora": [3]}) == (
        "These runs started from a different pretrained policy than sft's: mine:Mine (seeds 1, 2); lora "
        "(seeds 3). Their gain therefore compares runs that do not match. To fix this, run sft and these "
        "methods on one machine with a new --records folder."
    )


def test_a_pretrained_policy_at_the_bar_is_not_weak() -> None:
    assert start_text(WEAK) == "The pretrained policy has a success rate of 0.80 on its skills."
    assert start_text(WEAK - 0.01).endswith(WEAK_WARNING)


SURE, OPEN = Estimate(0.1, 0.05, 0.15), Estimate(0.1, -0.02, 0.22)


@pytest.mark.parametrize(
    ("gain", "tied", "certain"),
    [
        (SURE, (), True),
        (OPEN, (), False),
        (SURE, (SURE,), True),
        (SURE, (SURE, OPEN), False),
        (OPEN, (SURE,), False),
    ],
)
def test_a_gain_is_certain_only_if_all_its_intervals_are_above_0(
    gain: Estimate, tied: tuple[Estimate, ...], certain: bool
) -> None:
    text = gain_text("me/Mine-v0", "mine", gain, [TiedGain(0.1, one, 4) for one in tied])
    assert text.startswith(f"On me/Mine-v0, the gain of mine is {'' if certain else 'not '}certain: it is ")
    assert text.count("which scored the same in tuning (4 seeds)") == len(tied)
    assert text.endswith(".")
