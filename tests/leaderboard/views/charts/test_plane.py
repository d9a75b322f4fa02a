"""The plane of two quantities: right and up are better, whatever the reader chooses."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import Estimate

Plane = resolve("clbench.leaderboard.views.charts.plane:Plane")
PLANE = "clbench.leaderboard.views.charts.plane"
AXES = "clbench.leaderboard.views.charts.axes"
learned, cost, bytes_kept = resolve(f"{AXES}:ACROSS")
kept, skills, targets = resolve(f"{AXES}:UP")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
REFERENCE = {"demonstrations": "never", "questions": "never", "reference": True}


@pytest.fixture
def rows(add: Callable[..., Path], matrix: Any, tmp_path: Path) -> Any:
    """Return the rows of two methods and of a reference that learns nothing."""
    for seed in range(2):
        add("sft", seed, edit=lambda record: setattr(record.costs, "bytes_kept", 0))
        add("heavy", seed, matrix * 0.9, edit=lambda record: setattr(record.costs, "bytes_kept", 5_000_000))
        add("frozen", seed, matrix * 0.0, uses=REFERENCE)
    return compute_board(tmp_path / "leaderboard" / "records").rows


def test_less_data_is_further_right(rows: Any) -> None:
    axis = Plane(rows, bytes_kept, kept).across
    assert 0 < axis.share(5_000_000) < axis.share(2_000) < axis.share(0) < 1
    assert axis.share(axis.worst) == pytest.approx(0)
    assert axis.scale["reverse"]


def test_a_cost_that_rounds_to_zero_has_its_place(rows: Any) -> None:
    cheap = dataclasses.replace(rows[0], costs={**rows[0].costs, "relative_cost": 0.0004})
    (point,) = Plane([cheap], cost, kept).points
    assert point["x"] == 0.0004


def test_more_success_is_further_right(rows: Any) -> None:
    axis = Plane(rows, learned, kept).across
    assert axis.share(0.5) < axis.share(0.9)
    assert axis.share(axis.worst) == pytest.approx(0)


def test_a_row_outside_the_plane_is_named_with_its_values(rows: Any) -> None:
    plane = Plane(rows, learned, kept)
    assert [point["method"] for point in plane.points] == ["sft", "heavy"]
    assert plane.note.startswith("Not in the chart: frozen (learned 0.00 [")
    picture = resolve(f"{PLANE}:plane")(rows, resolve(f"{PLANE}:WIDE"))
    assert Plane(rows, learned, skills).note in " ".join(picture["title"]["subtitle"])


def test_a_row_without_a_quantity_is_named_as_such(rows: Any) -> None:
    assert "heavy (no relative cost, kept skills 0." in Plane(rows, cost, skills).note


def test_a_scenario_without_a_quantity_has_no_point_and_says_why(rows: Any) -> None:
    plane = Plane([row for row in rows if row.method == "heavy"], cost, targets)
    assert not plane.points
    assert "no relative cost" in plane.note


@pytest.mark.parametrize("costs", [(0.0, 0.0), (0.0, 0.5)])
def test_a_method_without_steps_has_no_place_among_logarithmic_costs(rows: Any, costs: Any) -> None:
    competing = [row for row in rows if row.division != "reference"]
    priced = [
        dataclasses.replace(row, costs={**row.costs, "relative_cost": one})
        for row, one in zip(competing, costs, strict=True)
    ]
    plane = Plane(priced, cost, kept)
    assert [point["method"] for point in plane.points] == [
        row.method for row, one in zip(priced, costs, strict=True) if one
    ]


def test_every_place_of_the_template_is_filled(rows: Any) -> None:
    size = resolve(f"{PLANE}:WIDE")
    drawn = Plane(rows, learned, kept)
    template = resolve(f"{PLANE}:template")(size)
    assert '"@' in json.dumps(template)
    assert '"@' not in json.dumps(resolve(f"{PLANE}:filled")(template, drawn.places | drawn.labels(size)))


def test_one_method_of_a_division_has_no_front(rows: Any) -> None:
    assert Plane(rows, learned, kept).corners
    assert not Plane([row for row in rows if row.method != "heavy"], learned, kept).corners


def test_the_front_has_the_methods_that_no_cheaper_one_matches(rows: Any) -> None:
    competing = [row for row in rows if row.division != "reference"]
    priced = [
        dataclasses.replace(
            competing[0],
            method=name,
            costs={**competing[0].costs, "relative_cost": price},
            estimates={**competing[0].estimates, "kept": Estimate(success, None, None)},
        )
        for name, price, success in (("cheap", 1.0, 0.5), ("good", 4.0, 0.9), ("worse", 8.0, 0.7))
    ]
    corners = {(corner["x"], corner["y"]) for corner in Plane(priced, cost, kept).corners}
    assert {(1.0, 0.5), (4.0, 0.9)} < corners
    assert (8.0, 0.7) not in corners
