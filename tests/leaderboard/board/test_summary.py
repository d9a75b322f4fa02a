"""The numbers of the board as JSON, from which the terminal shows a board without reading its records."""

import json
from typing import Any

import pytest

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import Estimate

in_order_of, letters_of = (
    resolve(f"clbench.leaderboard.board.summary:{name}") for name in ("in_order_of", "letters_of")
)
RowSummary = resolve("clbench.leaderboard.board.summary:RowSummary")
Summary = resolve("clbench.leaderboard.board.summary:Summary")


def _row(method: str, estimates: dict[str, Estimate], seeds: tuple[int, ...] = (0, 1), **fields: Any) -> Any:
    """Return a row of a scenario."""
    given = {
        "scenario": "clbench/Toy-v0",
        "method": method,
        "division": "prior-data-free",
        "letters": "a",
        "tier": "replayed",
        "seeds": seeds,
        "to_criterion": True,
        "estimates": estimates,
        "costs": {"steps": 3.0},
        "order_sensitivity": None,
        "tried": 7,
    }
    return RowSummary(**{**given, **fields})


@pytest.mark.parametrize("seeds", [(3,), (0, 1, 2, 3)], ids=["one seed", "four seeds"])
def test_a_summary_is_the_same_after_json_and_what_one_seed_shows_stays_uncertain(
    seeds: tuple[int, ...],
) -> None:
    row = _row("sft", {"gain": Estimate(0.2, 0.1, 0.3, of_seeds=len(seeds) > 1)}, seeds)
    before = Summary(
        rows=(row,),
        starts={"clbench/Toy-v0": 1.0},
        unpaired={"clbench/Toy-v0": {"sft": [3]}},
        machines={"clbench/Toy-v0": "arm64"},
    )
    after = Summary.from_json(json.loads(json.dumps(before.to_json())))
    assert after == before
    assert after.rows[0].estimates["gain"].is_above(0.0) == (len(seeds) > 1)


@pytest.mark.parametrize(
    ("metric", "order"),
    [("retention", ["high", "low", "missing"]), ("forgetting", ["low", "high", "missing"])],
)
def test_rows_in_the_order_of_a_metric_have_the_best_first_and_missing_values_last(
    metric: str, order: list[str]
) -> None:
    values = {"missing": None, "low": -0.1, "high": 0.2}
    rows = [_row(name, {metric: Estimate(value, None, None)}) for name, value in values.items()]
    assert [row.method for row in in_order_of(rows, metric)] == order
    reference = _row("joint", {metric: Estimate(0.1, None, None)}, division="reference")
    assert [row.method for row in in_order_of([reference, *rows], metric)] == ["joint", *order]


def test_a_row_without_another_of_its_division_shows_no_letter() -> None:
    first, second = (_row(name, {}) for name in ("sft", "lora"))
    alone, reference = _row("replay", {}, division="prior demonstrations"), _row("joint", {}, letters=None)
    rows = [first, second, alone, reference]
    assert [letters_of(row, rows) for row in rows] == ["a", "a", "", ""]
