"""The place of a row and its letters, in words and below each other."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve

aligned = resolve("clbench.leaderboard.views.format:aligned")
standing_text = resolve("clbench.leaderboard.views.format:standing_text")
read_table = resolve("clbench.leaderboard.board.rows:read_table")


@pytest.fixture
def rows(add: Callable[..., Path], matrix: Any, tmp_path: Path) -> dict[str, Any]:
    """Return the rows of five methods by name, with given groups, and of a reference."""
    for number, method in enumerate(("best", "good", "twin", "middle", "worst")):
        add(method, 0, matrix * (1.0, 0.8, 0.8, 0.5, 0.1)[number])
    add("ideal", 0, uses={"demonstrations": "never", "questions": "never", "reference": True})
    table = read_table(tmp_path / "leaderboard" / "records")
    letters = {"best": "a", "good": "b", "twin": "bc", "middle": "bcd", "worst": "d", "ideal": None}
    return {row.method: dataclasses.replace(row, groups=letters[row.method]) for row in table.rows}


def test_a_place_counts_the_better_rows_and_names_those_that_are_not_told_apart(rows: dict[str, Any]) -> None:
    board = list(rows.values())
    assert standing_text(rows["best"], board) == "place 1 of 5; told apart from all others"
    assert standing_text(rows["good"], board) == "place 2 of 5; not told apart from twin, middle"
    assert standing_text(rows["twin"], board) == "place 2 of 5; not told apart from good, middle"
    assert standing_text(rows["middle"], board, 2) == "place 4 of 5; not told apart from good, twin, 1 more"
    assert standing_text(rows["worst"], board, 2) == "place 5 of 5; not told apart from middle"


def test_a_row_that_does_not_compete_has_no_place(rows: dict[str, Any]) -> None:
    board = list(rows.values())
    assert standing_text(rows["ideal"], board) == "a reference does not compete"
    lost = dataclasses.replace(rows["worst"], groups=None)
    assert standing_text(lost, board) == "no final average"
    assert standing_text(rows["best"], [rows["best"], rows["ideal"]]) == "place 1 of 1"


def test_letters_are_below_each_other_if_their_groups_are_the_same(rows: dict[str, Any]) -> None:
    board = list(rows.values())
    letters = [aligned(row.groups, board) for row in rows.values()]
    assert letters == ["a   ", " b  ", " bc ", " bcd", "   d", ""]
