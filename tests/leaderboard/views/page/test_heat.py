"""Methods against scenarios: a table for each kind of policy, of scenarios with several methods."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve

heat_maps = resolve("clbench.leaderboard.views.page.heat:heat_maps")
tables_of = resolve("clbench.leaderboard.board.summary:tables_of")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
REFERENCE = {"demonstrations": "never", "questions": "never", "reference": True}


@pytest.fixture
def maps(add: Callable[..., Path], tmp_path: Path) -> Any:
    """Return the tables of two scenarios with several methods, and one with a single method."""
    for scenario, methods in (("Two-v0", ("sft", "lora")), ("Three-v0", ("sft", "lora", "ewc"))):
        for method in methods:
            add(method, 0, scenario=f"clbench/{scenario}")
    add("sft", 0, scenario="clbench/One-v0")
    add("frozen", 0, scenario="clbench/One-v0", uses=REFERENCE)
    table = compute_board(tmp_path / "leaderboard" / "records")
    rows = tables_of(table.rows)
    return heat_maps(rows | {"clbench/Two-v0+discrete_diffusion": rows["clbench/Two-v0"]})


def test_a_scenario_with_one_method_has_no_column(maps: Any) -> None:
    assert maps[0].scenarios == ("clbench/Three-v0", "clbench/Two-v0")


def test_policies_never_share_a_table(maps: Any) -> None:
    assert [one.policy for one in maps] == ["flow", "discrete_diffusion"]
    assert maps[1].scenarios == ("clbench/Two-v0+discrete_diffusion",)


def test_a_method_without_a_row_has_a_dash_that_says_so(maps: Any) -> None:
    cells = {row.method: row.cells for row in maps[0].rows}
    assert list(cells) == ["lora", "sft", "ewc"]
    values = [value for _, value in cells["ewc"]]
    assert [value is None for value in values] == [False, True] * 3
    assert cells["ewc"][1][0].note == "no row"
