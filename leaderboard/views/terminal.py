"""The leaderboard for the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.measure import Measurement
from rich.table import Table as TextTable
from rich.text import Text

from clbench.base.text import listed
from clbench.scoring.intervals import NO_ESTIMATE, Estimate
from clbench.scoring.metric import TIE
from clbench.scoring.metrics import METRICS
from clbench.spec.policies import DEFAULT_POLICY

from ..board.grid import Grid, GridRow, grids
from ..board.summary import RANKED_BY, RowSummary, Summary, divisions_of, letters_of, tables_of
from ..board.tiers import TIERS
from .format import (
    MISSING,
    Column,
    agreement_text,
    aligned,
    column_title,
    fitting,
    machine_text,
    number_text,
    scaled,
    start_text,
    table_title,
    title_of,
    unpaired_text,
)

LEGEND = (
    "Rows of a division that share a letter are not told apart. "
    "± is half the width of a 95 % confidence interval; it does not cover what all seeds share: "
    "demonstrations, scenes and questions. Higher is better, except for {lower}. {tried}"
    "Bold: the best value of a division. "
    "Cost: relative cost, the time of all optimiser steps divided by sft's. Tier: {tiers}.\n"
)
"""Legend below the tables."""

TRIED = "Tried: settings that tuning tried. "
"""Part of the legend for scenarios whose stages end when the target is learned."""


DROPPED_FIRST = (
    "tier",
    "tried",
    "bytes kept",
    "forward transfer",
    "question retention",
    "forgetting",
    "cost",
    "kept skills",
    "seeds",
    "retention",
    "learned",
    "adaptation",
    "kept",
    "gain",
)
"""Columns in the order in which a narrow terminal loses them; what stays longest matters most."""

_Line: TypeAlias = RowSummary | GridRow[RowSummary]

WIDEST_NAME = 20
"""Characters of a method's name that a table keeps on one line if there is no room for more."""


@dataclass(frozen=True)
class _Head:
    """A column after the method's name."""

    title: str
    cell: Callable[[Any], str]
    """Returns the text in a row."""
    value: Callable[[Any], float | None] = lambda _: None
    """Returns the number in a row; the best number of a division is bold."""
    higher_is_better: bool | None = None
    stays: bool = False
    """Whether a narrow terminal keeps it."""


def terminal(table: Summary, width: int = 108, sort: str | None = None) -> RenderableType:
    """Return the table for a terminal.

    Args:
        table: The table.
        width: Width of the terminal in characters; columns that do not fit are named below each table.
        sort: Name of the metric that the rows are sorted by, whose column is always shown; None for the
            board's own order.
    """
    # Text and not str: rich would obey markup in a stranger's words.
    parts: list[RenderableType] = []
    tables = tables_of(table.rows)
    for scenario, rows in tables.items():
        parts += _fitted(scenario, rows, _heads(rows, sort), width)
        sentences = (
            start_text(table.starts.get(scenario)),
            machine_text(table.machines.get(scenario)),
            unpaired_text(table.unpaired.get(scenario)),
            agreement_text(table.agreements.get(scenario)),
        )
        parts += [Text(sentence) for sentence in sentences if sentence]
        parts.append(Text())
    for grid in grids(tables, least=2):
        parts += [*_across(grid, width), Text()]
    if parts:
        columns = [one for rows in tables.values() for one in _columns(rows, sort)]
        heads = [one for one in columns if one.metric.higher_is_better is False]
        names = listed([*dict.fromkeys(one.title for one in heads), "cost", "bytes kept"])
        tried = TRIED if any(row.to_criterion for row in table.rows) else ""
        tiers = ", ".join(f"{number} {tier}" for number, tier in enumerate(TIERS))
        parts.append(Text(LEGEND.format(lower=names, tried=tried, tiers=tiers)))
    if table.not_shown:
        parts.append(Text("Not shown", style="bold"))
        parts += [Text(f"  {entry}", overflow="fold") for entry in table.not_shown]
    return Group(*parts)


def _across(grid: Grid[RowSummary], width: int) -> list[RenderableType]:
    """Return the table of methods against scenarios; a narrow terminal loses the last scenarios first."""
    policy = "" if grid.policy == DEFAULT_POLICY else f", {title_of(grid.policy)}"
    heads = _grid_heads(grid.scenarios)
    dropped_first = [head.title for head in reversed(heads)]
    return _fitted(f"All scenarios{policy}: {title_of(RANKED_BY)}", grid.methods, heads, width, dropped_first)


def _fitted(
    title: str,
    rows: Sequence[_Line],
    heads: Sequence[_Head],
    width: int,
    dropped_first: Sequence[str] = DROPPED_FIRST,
) -> list[RenderableType]:
    """Return a table without the columns that do not fit, and a line that names them."""
    kept, dropped = list(heads), []
    for name in dropped_first:
        if _width(_table(title, rows, kept, WIDEST_NAME)) <= width:
            break
        dropped += [head.title for head in kept if head.title == name and not head.stays]
        kept = [head for head in kept if head.title != name or head.stays]
    line = f"Not shown in {width} characters: {', '.join(dropped)}. The page and --json show every column."
    return [_table(title, rows, kept), *([Text(line, style="italic")] if dropped else [])]


def _width(table: TextTable) -> int:
    console = Console(width=1000)
    return Measurement.get(console, console.options, table).maximum


def _is_best(value: float | None, best: float | None) -> bool:
    return value is not None and best is not None and abs(value - best) < TIE


def _table(
    title: str,
    rows: Sequence[_Line],
    heads: Sequence[_Head],
    widest_name: int | None = None,
) -> TextTable:
    """Return a table with a section for each division."""
    table = TextTable(
        title=Text(title, style="bold"), box=SIMPLE_HEAD, padding=0, title_justify="left", show_edge=False
    )
    table.add_column("", no_wrap=True)  # letters of the groups: the legend explains them
    table.add_column("method", overflow="fold", min_width=16, max_width=widest_name)
    for head in heads:
        # One word a line: a header must not make its column wider than the numbers.
        table.add_column(head.title.replace(" ", "\n"), justify="right", no_wrap=True)
    for division, members in divisions_of(rows).items():
        table.add_section()
        table.add_row("", Text(division, style="italic"))
        best = [_best(head, members) for head in heads]
        for row in members:
            cells = [
                Text(head.cell(row), style="bold" if _is_best(head.value(row), top) else "")
                for head, top in zip(heads, best, strict=True)
            ]
            table.add_row(Text(_letters(row, members)), Text(row.method), *cells)
    return table


def _best(head: _Head, rows: Sequence[Any]) -> float | None:
    """Return the best number of a division in a column, None if there is nothing to compare."""
    values = [value for value in map(head.value, rows) if value is not None]
    if head.higher_is_better is None or len(values) < 2:
        return None
    return max(values) if head.higher_is_better else min(values)


def _letters(row: _Line, rows: Sequence[Any]) -> str:
    return aligned(letters_of(row, rows), rows) if isinstance(row, RowSummary) else ""


def _heads(rows: list[RowSummary], sort: str | None) -> list[_Head]:
    """Return the columns of the table of one scenario."""
    tried = [_Head("tried", lambda row: number_text(row.tried, "d"))] if rows[0].to_criterion else []
    return [
        _Head("seeds", lambda row: str(len(row.seeds))),
        *_metric_heads(rows, sort),
        *tried,
        _Head("cost", lambda row: number_text(row.costs["relative_cost"], ".2f")),
        _Head("bytes kept", _size),
        _Head("tier", lambda row: str(TIERS.index(row.tier))),
    ]


def _grid_heads(scenarios: Sequence[str]) -> list[_Head]:
    """Return the columns of the table of methods against scenarios."""
    column = Column(METRICS[RANKED_BY], title_of(RANKED_BY))

    def head(place: int) -> _Head:
        def estimate(line: GridRow[RowSummary]) -> Estimate:
            row = line.rows[place]
            return row.estimates[RANKED_BY] if row else NO_ESTIMATE

        return _Head(
            # a word a line, as in other heads: Libero, Spatial-v1
            re.sub(r"(?<=[a-z])(?=[A-Z])", " ", table_title(scenarios[place])),
            lambda line: _compact(estimate(line), column),
            lambda line: estimate(line).value,
            higher_is_better=True,
        )

    return [head(place) for place in range(len(scenarios))]


def _columns(rows: Sequence[RowSummary], sort: str | None) -> list[Column]:
    """Return the columns that fit, and the one by which the rows are sorted."""
    columns = list(fitting(rows))
    if sort is not None and sort not in {column.metric.name for column in columns}:
        columns.append(Column(METRICS[sort], column_title(sort, rows[0].to_criterion)))
    return columns


def _metric_heads(rows: Sequence[RowSummary], sort: str | None) -> list[_Head]:
    """Return the table's columns for the metrics of `_columns`."""

    def head(column: Column) -> _Head:
        name = column.metric.name
        return _Head(
            column.title,
            lambda row: _compact(row.estimates[name], column),
            lambda row: row.estimates[name].value,
            column.metric.higher_is_better,
            stays=name == sort,
        )

    return [head(column) for column in _columns(rows, sort)]


def _size(row: RowSummary) -> str:
    kept = row.costs["bytes_kept"]
    return MISSING if kept is None else "".join(scaled(kept))


def _compact(estimate: Estimate, column: Column) -> str:
    value = number_text(estimate.value, column.form)
    if estimate.low is None or estimate.high is None:
        return value
    half = number_text((estimate.high - estimate.low) / 2, column.form.removeprefix("+"))
    return f"{value}±{half.removeprefix('0') or '0'}"
