"""The heat map: methods against scenarios, one table for each policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from clbench.scoring.metrics import METRICS

from ...board.grid import GridRow, grids
from ...board.rows import Row
from ...board.summary import DIVISIONS, RANKED_BY
from ..charts.vega import finite
from ..format import Column, column_title
from .numbers import MISSING, Number, number

COLUMNS = tuple(
    Column(METRICS[name], column_title(name, to_criterion=True)) for name in (RANKED_BY, "adaptation", "kept")
)
"""Metrics of the table."""

NO_ROW = Number(MISSING, note="no row")
"""Cell of a scenario without a row of the method."""


@dataclass(frozen=True)
class HeatRow:
    """A method in all scenarios."""

    method: str
    division_number: int
    """Place of its division in `DIVISIONS`."""
    cells: tuple[tuple[Number, float | None], ...]
    """Number and value of each metric in each scenario."""


@dataclass(frozen=True)
class HeatMap:
    """The table of one policy."""

    policy: str
    scenarios: tuple[str, ...]
    """Names of the tables of scenarios with two or more competing methods."""
    rows: tuple[HeatRow, ...]
    """Methods by division, those with the most scenarios first."""


def heat_maps(tables: Mapping[str, Sequence[Row]]) -> list[HeatMap]:
    """Return the tables of the policies, the default one's first.

    Args:
        tables: Rows of each scenario and policy.
    """
    return [HeatMap(one.policy, one.scenarios, tuple(map(_row, one.methods))) for one in grids(tables)]


def _row(one: GridRow[Row]) -> HeatRow:
    cells = tuple(_cell(row, column) for column in COLUMNS for row in one.rows)
    return HeatRow(one.method, DIVISIONS.index(one.division), cells)


def _cell(row: Row | None, column: Column) -> tuple[Number, float | None]:
    if row is None:
        return NO_ROW, None
    one = row.estimates[column.metric.name]
    return number(one, column), finite(one.value)
