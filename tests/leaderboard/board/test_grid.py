"""Methods against scenarios: a grid for each kind of policy, of scenarios with several methods."""

from typing import Any

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import NO_ESTIMATE, Estimate
from clbench.scoring.metrics import METRICS

RowSummary = resolve("clbench.leaderboard.board.summary:RowSummary")
grids = resolve("clbench.leaderboard.board.grid:grids")
tables_of = resolve("clbench.leaderboard.board.summary:tables_of")
ONE, TWO, THREE = (f"clbench/{name}-v0" for name in ("One", "Two", "Three"))


def _row(scenario: str, method: str, final: float | None = 0.5, division: str = "prior-data-free") -> Any:
    """Return a row whose metrics all have the same value."""
    one = NO_ESTIMATE if final is None else Estimate(final, final - 0.1, final + 0.1)
    return RowSummary(
        scenario=scenario,
        method=method,
        division=division,
        letters="a",
        tier="self-reported",
        seeds=(0,),
        to_criterion=True,
        estimates=dict.fromkeys(METRICS, one),
        costs={},
        order_sensitivity=None,
    )


def _grids(*rows: Any) -> Any:
    return grids(tables_of(rows))


def test_methods_come_by_division_then_scenarios_then_falling_final_average() -> None:
    finals = {"few": (None, 0.9), "worse": (0.4, 0.9), "better": (0.6, 0.1), "unknown": (None, None)}
    rows = [_row(ONE, name, final) for name, (final, _) in finals.items() if name != "few"]
    rows += [_row(TWO, name, final) for name, (_, final) in finals.items()]
    rows += [_row(name, "bound", 1.0, division="reference") for name in (ONE, TWO)]
    rows += [_row(name, "replay", 0.2, division="prior demonstrations") for name in (ONE, TWO)]
    (grid,) = _grids(*rows)
    assert [one.method for one in grid.methods] == ["better", "worse", "unknown", "few", "replay", "bound"]
    few = grid.methods[3]
    assert few.rows[0] is None
    assert few.rows[1].estimates["kept"].value == 0.9


def test_a_scenario_without_two_competing_methods_has_no_column() -> None:
    rows = [_row(name, method) for name in (ONE, TWO) for method in ("sft", "lora")]
    alone = [_row(THREE, "sft"), _row(THREE, "frozen", division="reference")]
    (grid,) = _grids(*alone, *rows)
    assert grid.scenarios == (ONE, TWO)
    assert [one.method for one in grid.methods] == ["lora", "sft"]


def test_policies_never_share_a_grid() -> None:
    masked = f"{ONE}+discrete_diffusion"
    found = _grids(*(_row(table, method) for table in (masked, TWO, ONE) for method in ("sft", "lora")))
    assert [(one.policy, one.scenarios) for one in found] == [
        ("flow", (TWO, ONE)),
        ("discrete_diffusion", (masked,)),
    ]


def test_a_method_of_two_divisions_has_a_line_in_each() -> None:
    rows = [_row(ONE, "mine"), _row(TWO, "mine", division="prior demonstrations")]
    rows += [_row(name, "sft") for name in (ONE, TWO)]
    (grid,) = _grids(*rows)
    assert [(one.method, one.division) for one in grid.methods] == [
        ("sft", "prior-data-free"),
        ("mine", "prior-data-free"),
        ("mine", "prior demonstrations"),
    ]
