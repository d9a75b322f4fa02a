"""The verdict on a scenario: its sentences hold for any records, and call nothing best that is not."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import Estimate

headline = resolve("clbench.leaderboard.views.page.verdict:headline")
verdicts = resolve("clbench.leaderboard.views.page.verdict:verdicts")
TiedGain = resolve("clbench.leaderboard.board.certainty:TiedGain")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")

REPLAY = {"demonstrations": "throughout", "questions": "never", "reference": False}
REFERENCE = {"demonstrations": "never", "questions": "never", "reference": True}
LEARNED = np.array([[1.0, 1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, 0.0]])
"""Success of a method that learns everything and forgets nothing."""


def matrix(kept: float, learned: float = 1.0) -> Any:
    """Return the success of a method that keeps this much of what it knew."""
    found = LEARNED.copy()
    found[1, :2] = found[2, :3] = kept
    found[1, 2] = found[2, 3] = learned
    return found


@pytest.fixture
def board(add: Callable[..., Path], tmp_path: Path) -> Callable[..., Any]:
    """Return a function that makes the rows of methods with four seeds, given the success of each."""

    def board(**methods: Any) -> Any:
        for seed in range(4):
            for method, success in methods.items():
                uses = {"uses": REPLAY} if "replay" in method else {}
                uses = {"uses": REFERENCE} if method == "frozen" else uses
                add(method, seed, success, **uses)
        return compute_board(tmp_path / "leaderboard" / "records").rows

    return board


def test_a_method_that_ends_higher_is_named_with_its_gain(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.2), replay=matrix(0.9), lora=matrix(0.2))
    gain = next(row.estimates["gain"].value for row in rows if row.method == "replay")
    assert headline(rows) == (
        f"With prior demonstrations, replay ends {gain:.2f} above plain fine-tuning. The one "
        "other method shows no certain gain."
    )


def test_a_board_of_references_alone_has_nothing_to_compare(board: Callable[..., Any]) -> None:
    assert headline(board(frozen=matrix(0.2))) == "No method that competes has run here."


def test_several_methods_that_end_higher_share_a_sentence(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.2), replay=matrix(0.9), lora=matrix(0.6))
    lora, replay = (
        next(row.estimates["gain"].value for row in rows if row.method == name) for name in ("lora", "replay")
    )
    assert headline(rows) == (
        f"Without prior demonstrations, lora ends {lora:.2f} above plain fine-tuning; with prior "
        f"demonstrations, replay ends {replay:.2f} above it."
    )


def test_a_method_with_more_seeds_than_plain_fine_tuning_is_compared_over_the_common_ones(
    board: Callable[..., Any],
) -> None:
    rows = [
        dataclasses.replace(row, runs=row.runs[:3], seeds=row.seeds[:3]) if row.method == "sft" else row
        for row in board(sft=matrix(0.2), lora=matrix(0.9))
    ]
    assert headline(rows).startswith("Without prior demonstrations, lora ends 0.")


def test_without_a_method_that_surely_ends_higher_none_is_named(board: Callable[..., Any]) -> None:
    assert headline(board(sft=matrix(0.2), lora=matrix(0.2), finch=matrix(0.2))) == (
        "No method is shown to end above plain fine-tuning."
    )


@pytest.mark.long
def test_a_gain_that_is_certain_only_without_counting_the_comparisons_names_no_method(
    board: Callable[..., Any],
) -> None:
    same = {f"method_{number}": matrix(0.2) for number in range(8)}
    rows = board(sft=matrix(0.2), lora=matrix(0.3), **same)
    gain = next(row.estimates["gain"] for row in rows if row.method == "lora")
    assert gain.low > 0
    assert headline(rows) == "No method is shown to end above plain fine-tuning."


def test_plain_fine_tuning_alone_is_no_comparison(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.2), frozen=LEARNED)
    final = rows[0].estimates["final_average"].value
    assert headline(rows) == (
        f"Plain fine-tuning ends with a final average of {final:.2f}. No other method has run here."
    )
    (verdict,) = verdicts(rows)
    assert verdict.standing == f"It is alone in its division, with a final average of {final:.2f}."
    assert verdict.keeping == ""
    assert "gain" not in " ".join(fact.name for fact in verdict.facts)


def test_without_plain_fine_tuning_nothing_is_compared(board: Callable[..., Any]) -> None:
    rows = board(lora=matrix(0.2))
    assert headline(rows) == "1 method, not yet compared with plain fine-tuning."
    assert verdicts(rows)[0].keeping == ""


def test_a_leader_that_is_not_told_apart_is_said_to_be_so(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.5), lora=matrix(0.5), finch=matrix(0.55))
    (verdict,) = verdicts(rows)
    final = verdict.leader.estimates["final_average"].value
    assert verdict.standing == (
        f"It ranks first of 3 in final average ({final:.2f}); 2 are not told apart from it: lora and sft."
    )
    assert verdict.keeping == (
        "Among the methods whose learning is not told apart from sft's, it keeps the most (0.60), but what "
        "it keeps is not told apart from sft's (0.50). Its training time was not measured."
    )


def test_the_method_that_keeps_most_is_found_on_the_seeds_of_plain_fine_tuning(
    add: Callable[..., Path], tmp_path: Path
) -> None:
    for seed, luck in enumerate((0.0, 0.1, 0.5, 0.6)):  # the last seeds keep more, whatever the method
        for method, kept in {"sft": 0.1, "lora": 0.3, "finch": 0.2}.items():
            if method == "finch" or seed < 2:
                add(method, seed, matrix(kept + luck))
    (verdict,) = verdicts(compute_board(tmp_path / "leaderboard" / "records").rows)
    assert "it keeps the most (0.35)" in verdict.keeping  # finch has 0.50 in the mean of its four seeds


def test_a_leader_over_common_seeds_is_not_said_to_have_the_highest_final_average(
    add: Callable[..., Path], tmp_path: Path
) -> None:
    for seed, luck in enumerate((0.0, 0.1, 0.5, 0.6)):
        for method, kept in {"sft": 0.1, "lora": 0.3, "finch": 0.2}.items():
            if method != "finch" or seed >= 2:  # lucky seeds only
                add(method, seed, matrix(min(kept + luck, 1.0)))
    rows = compute_board(tmp_path / "leaderboard" / "records").rows
    finals = {row.method: row.estimates["final_average"].value for row in rows}
    assert finals["finch"] > finals["lora"]
    (verdict,) = verdicts(rows)
    assert verdict.leader.method == "lora"
    assert verdict.standing.startswith(
        "It ranks first of 3 over the seeds that each shares with sft, but not in final average "
        f"({finals['lora']:.2f})"
    )


def test_the_one_method_that_is_not_told_apart_from_a_leader_is_named(board: Callable[..., Any]) -> None:
    (verdict,) = verdicts(board(sft=matrix(0.5), lora=matrix(0.6)))
    assert re.fullmatch(
        r"It ranks first of 2 in final average \(0\.\d\d\); sft is not told apart from it\.", verdict.standing
    )
    assert (
        "it keeps the most (0.60), but what it keeps is not told apart from sft's (0.50)." in verdict.keeping
    )


def test_no_method_keeps_more_than_plain_fine_tuning(board: Callable[..., Any]) -> None:
    (verdict,) = verdicts(board(sft=matrix(0.9), lora=matrix(0.2), finch=matrix(0.1)))
    assert verdict.keeping == (
        "Among the methods whose learning is not told apart from sft's, none keeps more than sft itself "
        "(0.90)."
    )


def test_a_leader_that_is_told_apart_from_all_is_said_to_be_so(board: Callable[..., Any]) -> None:
    (verdict,) = verdicts(board(sft=matrix(0.1), lora=matrix(0.9), finch=matrix(0.1)))
    assert verdict.leader.method == "lora"
    assert re.fullmatch(
        r"It ranks first of 3 in final average \(0\.\d\d\), told apart from all others of its division\.",
        verdict.standing,
    )
    assert verdict.keeping == (
        "Among the methods whose learning is not told apart from sft's, it keeps the most (0.90). Its "
        "training time was not measured."
    )


def test_a_training_time_is_a_multiple_of_that_of_plain_fine_tuning(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.1), lora=matrix(0.9))
    for relative, sentence in (
        (2.371, "Its training takes 2.37 times as long as sft's."),
        (0.0, "Its training takes no time."),
    ):
        priced = [dataclasses.replace(row, costs=row.costs | {"relative_cost": relative}) for row in rows]
        (verdict,) = verdicts(priced)
        assert verdict.keeping.endswith(f"keeps the most (0.90). {sentence}")
        (fact,) = (fact for fact in verdict.facts if fact.name == "relative cost")
        assert (fact.text, fact.more) == (
            f"{relative:.2f}\N{MULTIPLICATION SIGN}",
            "the training time of sft",
        )


def test_steps_and_their_time_are_those_of_the_seeds_of_plain_fine_tuning(
    board: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = board(sft=matrix(0.1), lora=matrix(0.9))
    monkeypatch.setattr(
        "clbench.leaderboard.board.costs.step_ratio", lambda run: 1.5 if run.seed < 2 else 9.0
    )
    priced = [
        dataclasses.replace(
            row,
            costs=row.costs | {"relative_cost": 3.0},
            **({"seeds": row.seeds[:2]} if row.method == "sft" else {}),
        )
        for row in rows
    ]
    (verdict,) = verdicts(priced)
    assert "3.00 times as long as sft's: 2.00 times the steps, each 1.50 times as long." in verdict.keeping


def test_a_leader_that_learns_less_does_not_keep_most_of_those_that_learn_alike(
    board: Callable[..., Any],
) -> None:
    (verdict,) = verdicts(board(sft=matrix(0.1), lora=matrix(1.0, 0.3), finch=matrix(0.2)))
    assert verdict.leader.method == "lora"
    assert (
        "It learns less than sft: 0.30 against 1.00. Among the methods whose learning is not told apart from "
        "sft's, finch keeps the most (0.20)" in verdict.keeping
    )


@pytest.mark.long
def test_the_only_method_of_a_division_is_compared_with_plain_fine_tuning(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.1), replay=matrix(0.9))
    assert [verdict.name for verdict in verdicts(rows)] == ["prior-data-free", "prior demonstrations"]
    assert verdicts(rows)[1].keeping == (
        "It learns 1.00 (sft 1.00) and keeps 0.90 (sft 0.10); it is told apart from sft only in what it "
        "keeps. Its training time was not measured."
    )
    alike = verdicts(board(sft=matrix(0.1), replay=matrix(0.1)))[1]
    assert alike.keeping.startswith(
        "It learns 1.00 (sft 1.00) and keeps 0.10 (sft 0.10); it is told apart from sft in neither."
    )


def test_the_only_method_that_learns_like_plain_fine_tuning_is_compared_with_it(
    board: Callable[..., Any],
) -> None:
    rows = board(sft=matrix(0.1), replay=matrix(0.9, 0.3), replay_more=matrix(0.4))
    assert verdicts(rows)[1].keeping.startswith(
        "It learns less than sft: 0.30 against 1.00. The other, replay_more, learns 1.00 (sft 1.00) and "
        "keeps 0.40 (sft 0.10); "
    )
    assert verdicts(rows)[1].keeping.endswith("replay_more's training time was not measured.")


def test_with_one_seed_nothing_is_told_apart(board: Callable[..., Any]) -> None:
    rows = [
        dataclasses.replace(row, runs=row.runs[:1], seeds=row.seeds[:1])
        for row in board(sft=matrix(0.5), lora=matrix(0.4), replay=matrix(0.6))
    ]
    assert headline(rows) == (
        "With one seed, no method can be told apart from plain fine-tuning: the intervals cover only the "
        "noise of episodes."
    )
    assert verdicts(rows)[1].keeping == (
        "It learns 1.00 (sft 1.00) and keeps 0.60 (sft 0.50), with only one seed. Its training time was not "
        "measured."
    )
    assert headline(rows[:2]).startswith("With one seed, the only other method cannot be told apart")


def test_a_gain_that_is_not_certain_over_a_tied_setting_is_not_in_the_headline(
    board: Callable[..., Any],
) -> None:
    rows = board(sft=matrix(0.2), replay=matrix(0.9), lora=matrix(0.6))
    tied = {"lora": (TiedGain(0.1, Estimate(0.01, -0.01, 0.03), 4),)}
    assert headline(rows, tied).startswith("With prior demonstrations, replay ends ")
    tied = {"lora": (TiedGain(0.1, Estimate(0.02, 0.01, 0.03), 4),)}
    assert headline(rows, tied) == headline(rows)


@pytest.mark.long
def test_a_card_says_why_the_gain_of_its_leader_is_not_certain(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.2), lora=matrix(0.6), finch=matrix(0.2))
    assert verdicts(rows)[0].doubt == ""
    tied = {"lora": (TiedGain(0.1, Estimate(0.01, -0.01, 0.03), 4),)}
    assert verdicts(rows, tied)[0].doubt == (
        "Tuning rated sft equally highly at 0.1 times the scenario's learning rate. Over that setting, the "
        "gain is +0.01 [-0.01, +0.03], which is not certain."
    )
    tied = {"lora": (TiedGain(0.1, Estimate(None, None, None), 0),)}
    assert verdicts(rows, tied)[0].doubt == (
        "Its gain is not certain: for plain fine-tuning, 0.1 times the scenario's learning rate scored the "
        "same in tuning, and the ladder beside these records has no runs of it (`clbench leaderboard "
        "--published` copies ours)."
    )
    alike = board(sft=matrix(0.2), lora=matrix(0.25), finch=matrix(0.2))
    leader = alike[0]
    estimates = {**leader.estimates, "gain": Estimate(0.03, 0.01, 0.05)}
    rows = [dataclasses.replace(leader, estimates=estimates), *alike[1:]]
    (verdict,) = verdicts(rows)
    assert verdict.doubt == (
        "Its own interval puts its gain above 0, but the gain is not told apart from 0 when all 2 methods "
        "without prior demonstrations are compared with sft."
    )
