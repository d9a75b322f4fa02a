"""Methods against scenarios: one table for each policy, since policies do not mix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from clbench.records.paths import table_parts
from clbench.scoring.metrics import METRICS
from clbench.spec.policies import DEFAULT_POLICY

from ...board.rows import Row
from ...board.summary import DIVISIONS, RANKED_BY, competing
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
    policies = sorted(
        {table_parts(name)[1] for name in tables}, key=lambda name: (name != DEFAULT_POLICY, name)
    )
    found = []
    for policy in policies:
        chosen = {
            name: {row.method: row for row in rows}
            for name, rows in tables.items()
            if table_parts(name)[1] == policy and len(competing(rows)) > 1
        }
        if chosen:
            found.append(HeatMap(policy, tuple(chosen), tuple(_rows(chosen))))
    return found


def _rows(tables: Mapping[str, Mapping[str, Row]]) -> Iterable[HeatRow]:
    numbers = {
        method: DIVISIONS.index(row.division) for rows in tables.values() for method, row in rows.items()
    }

    def place(method: str) -> tuple[int, int, float, str]:
        rows = [rows[method] for rows in tables.values() if method in rows]
        return numbers[method], -len(rows), -(rows[0].estimates[RANKED_BY].value or 0.0), method

    for method in sorted(numbers, key=place):
        cells = [_cell(rows.get(method), column) for column in COLUMNS for rows in tables.values()]
        yield HeatRow(method, numbers[method], tuple(cells))


def _cell(row: Row | None, column: Column) -> tuple[Number, float | None]:
    if row is None:
        return NO_ROW, None
    one = row.estimates[column.metric.name]
    return number(one, column), finite(one.value)
