"""A report in words: what was assumed, the best method first, and why a value has no interval."""

import io
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from clbench.metrics import Report, from_matrix
from clbench.metrics.view import as_values, text

MINE = [[0.8, 0.1], [0.6, 0.9]]
LESS = [[0.7, 0.1], [0.2, 0.8]]


def lines(report: Report) -> list[str]:
    """Return the lines that a wide terminal shows."""
    console = Console(file=io.StringIO(), width=300)
    console.print(text(report))
    assert isinstance(console.file, io.StringIO)
    return [line.strip() for line in console.file.getvalue().splitlines()]


@pytest.mark.parametrize(
    ("factor", "unit", "words"),
    [
        (1, None, "shares, since none is above 1"),
        (100, None, "per cent, since the greatest is 90"),
        (100, "percent", "per cent, since you said so"),
        (1, "share", "shares, since you said so"),
    ],
)
def test_the_unit_and_its_reason_are_said(factor: float, unit: str | None, words: str) -> None:
    report = from_matrix(np.array(MINE) * factor, unit=unit)  # type: ignore[arg-type] # a parameter is a text
    assert f"Rates: read as {words}; shown as shares." in lines(report)


def test_the_best_method_comes_first_whichever_end_is_better() -> None:
    shown = lines(from_matrix({"less": LESS, "mine": MINE}))
    for heading, values in (
        ("adaptation: higher is better", "mine 0.850   less 0.750"),
        ("forgetting: lower is better", "mine 0.200   less 0.500"),
    ):
        assert shown[shown.index(heading) + 1] == values


def test_a_method_without_a_value_comes_last_and_its_reason_is_listed() -> None:
    holed = [[np.nan, 0.1], [0.6, 0.9]]
    shown = lines(from_matrix({"holed": holed, "less": LESS, "mine": MINE}))
    place = next(number for number, line in enumerate(shown) if line.startswith("forgetting: "))
    assert shown[place + 1] == "mine 0.200   less 0.500   holed -"
    reason = shown.index("The table lacks stage 1, task 1.", shown.index("No value"))
    assert "forgetting (holed)" in shown[reason + 1].split(", ")


def test_an_interval_is_shown_from_its_lower_to_its_upper_end() -> None:
    report = from_matrix([MINE, LESS])
    value = report["adaptation"]
    assert value.low is not None
    assert value.high is not None
    assert value.low < 0.8 < value.high
    ends = f"[{value.low:.3f}, {value.high:.3f}]"
    assert f"adaptation: 0.800 {ends}, higher is better" in lines(report)


def test_a_value_without_an_interval_beside_others_says_why() -> None:
    seeds: list[Any] = [MINE, np.array(MINE) - 0.1]
    shown = lines(from_matrix({"two": seeds, "one": MINE, "alike": [MINE, MINE]}))
    values = shown[next(n for n, line in enumerate(shown) if line.startswith("adaptation: ")) + 1]
    assert "one 0.850 (one seed)" in values
    assert "alike 0.850 (seeds agree)" in values
    assert "two 0.800 [" in values
    assert "Seeds: 1 to 2. Values are means over seeds, with 95 % intervals." in shown
    alone = lines(from_matrix({"one": MINE, "other": LESS}))
    assert not any("seed)" in line or line.startswith("Seeds: ") for line in alone)


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        (1, "With one seed a difference may be noise: there are no intervals."),
        (2, "With 2 seeds a difference may be noise: look at the intervals."),
    ],
)
def test_a_flip_in_the_order_of_methods_may_be_noise(seeds: int, words: str) -> None:
    early = [[0.8, 0.0, 0.0], [0.2, 0.8, 0.0], [0.4, 0.6, 0.8]]
    late = [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.3, 0.6, 0.8]]
    shown = lines(from_matrix({"early": [early] * seeds, "late": [late] * seeds}))
    assert shown[shown.index("Where the order of methods flips") + 1] == words
    assert "forgetting: early or late?" in shown


def test_the_groups_of_the_tasks_are_values_for_json() -> None:
    matrix = [[1.0, 0.1, 0.0, 0.3], [0.8, 0.6, 0.2, 0.2], [0.7, 0.8, 0.9, 0.4]]
    found = as_values(from_matrix(matrix, retained="task 1", held_out="task 4"))
    assert (found["retained"], found["target"], found["held_out"]) == (
        ["task 1"],
        ["task 2", "task 3"],
        ["task 4"],
    )
    assert (found["unit"], found["unit_was_given"], found["seeds"]) == ("share", False, {"": [""]})


def test_the_values_for_json_have_every_method_and_flip_and_the_targets_as_learned() -> None:
    early = [[0.8, 0.0, 0.0], [0.2, 0.8, 0.0], [0.4, 0.6, 0.8]]
    late = [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.3, 0.6, 0.8]]
    holed = [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.8, np.nan, 0.0]]
    report = from_matrix({"early": early, "late": late, "holed": holed}, tasks=["push", "lift", "drop"])
    found = as_values(report)
    assert found["target"] == ["push", "lift", "drop"]
    (adaptation,) = (one for one in found["metrics"] if one["name"] == "adaptation")
    assert {name: value["value"] for name, value in adaptation["values"].items()} == pytest.approx(
        {"early": 0.8, "late": 0.8, "holed": (0.8 + 0.8 + 0.0) / 3}
    )
    (forgetting,) = (one for one in found["metrics"] if one["name"] == "forgetting")
    assert forgetting["values"]["holed"] == {
        "value": None,
        "low": None,
        "high": None,
        "reason": "The table lacks stage 3, lift.",
    }
    assert [(one["family"], one["first"], one["second"]) for one in found["flips"]] == [
        (flip.family, flip.first, flip.second) for flip in report.flips
    ]
    assert len(found["flips"]) > 1
