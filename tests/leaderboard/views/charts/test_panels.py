"""The frontier: a panel for each method, with plain fine-tuning in it."""

from itertools import pairwise
from typing import Any

import pytest

from clbench.base.entry_points import resolve

FRONTIER = "clbench.leaderboard.views.charts.frontier"
frontier = resolve(f"{FRONTIER}:frontier")
WIDE, NARROW = resolve(f"{FRONTIER}:WIDE"), resolve(f"{FRONTIER}:NARROW")
on_paper = resolve("clbench.leaderboard.views.charts.picture:on_paper")
Curve, Rung = (resolve(f"clbench.leaderboard.board.frontier:{name}") for name in ("Curve", "Rung"))
Estimate = resolve("clbench.scoring.intervals:Estimate")

WITHOUT, WITH = "prior-data-free", "prior demonstrations"


def curve(method: str, division: str, *marks: tuple[float | None, float | None]) -> Any:
    """Return a curve with marks (learned, kept) at falling learning rates."""
    rungs = [
        Rung(0.3**number, Estimate(learned, None, None), Estimate(kept, 0.1, 0.9), (0,))
        for number, (learned, kept) in enumerate(marks)
    ]
    return Curve(method, division, tuple(rungs))


@pytest.fixture
def curves() -> list[Any]:
    """Return the curves of plain fine-tuning, of three methods like it and of one that keeps far more."""
    return [
        curve("sft", WITHOUT, (0.92, 0.37), (0.86, 0.5)),
        curve("lora", WITHOUT, (0.89, 0.39), (0.86, 0.52)),
        curve("finch", WITHOUT, (0.91, 0.46)),
        curve("aegis", "prior questions", (0.93, 0.38), (0.84, 0.51)),
        curve("replay", WITH, (0.9, 0.96), (0.69, 0.9)),
    ]


def names(panel: Any) -> list[str]:
    """Return the methods of the lines of a panel, the lowest first."""
    return [
        layer["data"]["values"][0]["method"] for layer in panel["layer"] if layer["mark"]["type"] == "line"
    ]


def domains(panel: Any) -> list[list[float]]:
    line = next(layer for layer in panel["layer"] if layer["mark"]["type"] == "line")
    return [line["encoding"][name]["scale"]["domain"] for name in "xy"]


def test_every_method_has_a_panel_in_which_plain_fine_tuning_is_drawn_last(curves: list[Any]) -> None:
    spec = frontier(curves, WIDE)
    assert [[names(panel) for panel in group["concat"]] for group in spec["vconcat"]] == [
        [["lora", "sft"], ["finch", "sft"], ["aegis", "sft"]],
        [["replay", "sft"]],
    ]
    svg = on_paper(spec).svg()
    for text in ("lora", "sft, in every panel", "Without prior demonstrations", "learning rate"):
        assert f">{text}</text>" in svg


def test_methods_with_demonstrations_do_not_stretch_the_axes_of_the_others(curves: list[Any]) -> None:
    out, having = frontier(curves, WIDE)["vconcat"]
    assert [domains(panel) for panel in out["concat"]] == [[[0.8, 0.95], [0.35, 0.55]]] * 3
    assert domains(having["concat"][0]) == [[0.65, 0.95], [0.35, 1.0]]
    assert having["title"]["text"] == "With prior demonstrations, other axes"
    (alone,) = frontier([curves[0], curves[-1]], WIDE)["vconcat"]
    assert alone["title"]["text"] == "With prior demonstrations"


def test_equal_values_have_an_axis_that_is_not_short(curves: list[Any]) -> None:
    for value in (0.0, 0.5, 1.0):
        (group,) = frontier([curve("sft", WITHOUT, (value, value))], NARROW)["vconcat"]
        (panel,) = group["concat"]
        assert names(panel) == ["sft"]
        for low, high in domains(panel):
            assert 0 <= low <= value <= high <= 1
            assert high - low == pytest.approx(0.15)


def test_names_of_axes_stand_at_the_edge_alone(curves: list[Any]) -> None:
    group, _ = frontier(curves, NARROW)["vconcat"]
    first, second, third = (panel["layer"][1]["encoding"] for panel in group["concat"])
    assert [one["x"]["title"] for one in (first, second, third)] == ["", "learned", "learned"]
    assert [one["y"]["title"] for one in (first, second, third)] == ["kept", "", "kept"]
    for one in (first, second, third):
        for name in "xy":
            values, (low, high) = one[name]["axis"]["values"], one[name]["scale"]["domain"]
            assert low <= values[0] < values[-1] <= high
            steps = [round(after - before, 9) for before, after in pairwise(values)]
            assert len(set(steps)) == 1


def test_a_mark_without_a_value_and_a_curve_without_a_mark_are_left_out(curves: list[Any]) -> None:
    empty = curve("empty", WITHOUT, (None, 0.5), (0.5, None))
    (group,) = frontier([curves[0], empty, curve("l2", WITHOUT, (0.9, 0.4), (None, 0.5))], WIDE)["vconcat"]
    (panel,) = group["concat"]
    assert names(panel) == ["l2", "sft"]
    assert len(panel["layer"][0]["data"]["values"]) == 1
    assert on_paper(frontier([empty], WIDE)).svg().startswith("<svg")
