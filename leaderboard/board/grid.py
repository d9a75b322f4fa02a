"""Methods against scenarios: one grid for each policy, since policies do not mix."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic

from clbench.records.paths import table_parts
from clbench.spec.policies import DEFAULT_POLICY

from .summary import DIVISIONS, RANKED_BY, OneRow, competing


@dataclass(frozen=True)
class GridRow(Generic[OneRow]):
    """A method in all scenarios of a grid."""

    method: str
    """Name or "module:Class"."""
    division: str
    """One of `DIVISIONS`."""
    rows: tuple[OneRow | None, ...]
    """Its row in each scenario, None where it has none."""


@dataclass(frozen=True)
class Grid(Generic[OneRow]):
    """The methods of one policy in all scenarios."""

    policy: str
    """Name of the policy."""
    scenarios: tuple[str, ...]
    """Names of the tables of scenarios with two or more competing methods, in the order of the board."""
    methods: tuple[GridRow[OneRow], ...]
    """Methods by division, those with the most scenarios first."""


def grids(tables: Mapping[str, Sequence[OneRow]], least: int = 1) -> list[Grid[OneRow]]:
    """Return the grids of the policies, the default one's first.

    Args:
        tables: Rows of each scenario and policy.
        least: Fewest scenarios of a grid.
    """
    policies = sorted(
        {table_parts(name)[1] for name in tables}, key=lambda name: (name != DEFAULT_POLICY, name)
    )
    found = []
    for policy in policies:
        chosen = {
            name: rows
            for name, rows in tables.items()
            if table_parts(name)[1] == policy and len(competing(rows)) > 1
        }
        if len(chosen) >= least:
            found.append(Grid(policy, tuple(chosen), tuple(_methods(chosen.values()))))
    return found


def _methods(tables: Iterable[Sequence[OneRow]]) -> Iterator[GridRow[OneRow]]:
    by_method = [{(row.division, row.method): row for row in rows} for rows in tables]

    def place(key: tuple[str, str]) -> tuple[int, int, float, str]:
        rows = [table[key] for table in by_method if key in table]
        return DIVISIONS.index(key[0]), -len(rows), -(rows[0].estimates[RANKED_BY].value or 0.0), key[1]

    for division, method in sorted({key for table in by_method for key in table}, key=place):
        rows = tuple(table.get((division, method)) for table in by_method)
        yield GridRow(method, division, rows)
