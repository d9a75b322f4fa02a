"""The verdict of a scenario: sentences that hold for any records, and call nothing best that is not."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve

headline = resolve("clbench.leaderboard.views.page.verdict:headline")
verdicts = resolve("clbench.leaderboard.views.page.verdict:verdicts")
read_table = resolve("clbench.leaderboard.board.rows:read_table")

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
        return read_table(tmp_path / "leaderboard" / "records").rows

    return board


def test_a_method_that_ends_higher_is_named_with_its_gain(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.2), replay=matrix(0.9), lora=matrix(0.2))
    gain = next(row.estimates["gain"].value for row in rows if row.method == "replay")
    assert headline(rows) == (
        f"With prior demonstrations, replay ends {gain:.2f} above plain fine-tuning. The one "
        "other method shows no certain gain."
    )


def test_several_methods_that_end_higher_share_a_sentence(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.2), replay=matrix(0.9), lora=matrix(0.6))
    lora, replay = (
        next(row.estimates["gain"].value for row in rows if row.method == name) for name in ("lora", "replay")
    )
    assert headline(rows) == (
        f"Without prior demonstrations, lora ends {lora:.2f} above plain fine-tuning; with prior "
        f"demonstrations, replay by {replay:.2f}."
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
    assert verdict.standing.startswith("Alone in its division.")
    assert verdict.keeping == ""
    assert "gain" not in " ".join(fact.name for fact in verdict.facts)


def test_without_plain_fine_tuning_nothing_is_compared(board: Callable[..., Any]) -> None:
    rows = board(lora=matrix(0.2))
    assert headline(rows) == "1 method, not yet compared with plain fine-tuning."
    assert verdicts(rows)[0].keeping == ""


def test_a_leader_that_is_not_told_apart_is_said_to_be_so(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.5), lora=matrix(0.5), finch=matrix(0.55))
    (verdict,) = verdicts(rows)
    assert verdict.standing.startswith("First of 3, with a final average of ")
    assert "but not told apart from" in verdict.standing
    assert "; not told apart from 2 others." in verdict.keeping


def test_a_leader_that_is_told_apart_from_all_is_said_to_be_so(board: Callable[..., Any]) -> None:
    (verdict,) = verdicts(board(sft=matrix(0.1), lora=matrix(0.9), finch=matrix(0.1)))
    assert verdict.leader.method == "lora"
    assert verdict.standing.endswith(", told apart from all others of its division.")
    assert verdict.keeping == (
        "Among the methods not told apart from sft in learning, lora keeps the most: 0.90, at a cost that "
        "was not measured."
    )


def test_a_leader_that_learns_less_does_not_keep_most_of_those_that_learn_alike(
    board: Callable[..., Any],
) -> None:
    (verdict,) = verdicts(board(sft=matrix(0.1), lora=matrix(1.0, 0.3), finch=matrix(0.2)))
    assert verdict.leader.method == "lora"
    assert (
        "It learns less than sft: 0.30 against 1.00. Among the methods not told apart from sft in learning, "
        "finch keeps the most" in verdict.keeping
    )


def test_the_only_method_of_a_division_is_compared_with_plain_fine_tuning(board: Callable[..., Any]) -> None:
    rows = board(sft=matrix(0.1), replay=matrix(0.9))
    assert [verdict.name for verdict in verdicts(rows)] == ["prior-data-free", "prior demonstrations"]
    assert verdicts(rows)[1].keeping == (
        "It learns 1.00, not told apart from sft's 1.00, and keeps 0.90, sft 0.10, at a cost that "
        "was not measured."
    )
