"""The leaderboard for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table as TextTable
from rich.text import Text

from clbench.scoring.intervals import Estimate

from ..board.overall import OverallRow, overall
from ..board.rows import Row, Table
from ..board.tiers import TIERS
from .format import MISSING, Column, Rows, agreement_text, aligned, fitting, number_text, scaled

LEGEND = (
    "Rows of a division that share a letter are not told apart. "
    "± is half the width of a 95 % confidence interval; it does not cover what all seeds share: "
    "demonstrations, scenes and questions. "
    "Higher is better{lower}. {tried}Cost: training time relative to sft. Tier: {tiers}.\n"
)
"""Legend below the tables."""

TRIED = "Tried: settings that tuning tried. "
"""Its part on scenarios whose stages end when the target is learned."""


def terminal(table: Table) -> RenderableType:
    """Return the table for a terminal of 108 columns."""
    # Text and not str: rich would obey markup in a stranger's words.
    parts: list[RenderableType] = []
    tables: list[Rows] = []
    for scenario, members in groupby(table.rows, key=lambda row: row.scenario):
        rows = list(members)
        tables.append(rows)
        sentence = agreement_text(rows)
        parts += [_scenario(scenario, rows), *([Text(sentence)] if sentence else []), Text()]
    over_scenarios = overall(table.rows)
    if over_scenarios:
        parts += [_all_scenarios(over_scenarios), Text()]
    if parts:
        heads = [one for rows in tables for one in fitting(rows) if one.metric.higher_is_better is False]
        names = ", ".join(dict.fromkeys(one.title for one in heads))
        lower = f", except for {names}" if names else ""
        tried = TRIED if any(row.to_criterion for row in table.rows) else ""
        tiers = ", ".join(f"{number} {tier}" for number, tier in enumerate(TIERS))
        parts.append(Text(LEGEND.format(lower=lower, tried=tried, tiers=tiers)))
    if table.not_shown:
        parts.append(Text("Not shown", style="bold"))
        parts += [Text(f"  {entry.path}: {entry.reason}", overflow="fold") for entry in table.not_shown]
    return Group(*parts)


def _scenario(scenario: str, rows: list[Row]) -> TextTable:
    """Return the table of one scenario, with a section for each division."""
    table = TextTable(
        title=Text(scenario, style="bold"), box=SIMPLE_HEAD, padding=0, title_justify="left", show_edge=False
    )
    table.add_column("", no_wrap=True)  # letters of the groups: the legend explains them
    table.add_column("method", overflow="fold", min_width=16)
    columns, to_criterion = fitting(rows), rows[0].to_criterion
    tried = ("tried",) if to_criterion else ()
    for name in ("seeds", *(one.title for one in columns), *tried, "cost", "bytes kept", "tier"):
        # One word a line: a header must not make its column wider than the numbers.
        table.add_column(name.replace(" ", "\n"), justify="right", no_wrap=True)
    for division, members in groupby(rows, key=lambda row: row.division):
        table.add_section()
        table.add_row("", Text(division, style="italic"))
        division_rows = list(members)
        for row in division_rows:
            cells = [aligned(row.groups, division_rows), row.method, str(len(row.seeds))]
            cells += [_compact(row.estimates[one.metric.name], one) for one in columns]
            cells += [number_text(row.tried, "d")] if to_criterion else []
            kept = row.costs["bytes_kept"]
            size = MISSING if kept is None else "".join(scaled(kept))
            cells += [number_text(row.costs["relative_cost"], ".1f"), size]
            table.add_row(*map(Text, cells), str(TIERS.index(row.tier)))
    return table


def _all_scenarios(rows: Sequence[OverallRow]) -> TextTable:
    """Return the table over scenarios, with a section for each division."""
    title = Text("All scenarios", style="bold")
    table = TextTable(title=title, show_edge=False, box=SIMPLE_HEAD, padding=0, title_justify="left")
    table.add_column("method", overflow="fold", min_width=20)
    columns = fitting(rows)
    for name in ("groups", *(one.title for one in columns)):
        table.add_column(name.replace(" ", "\n"), justify="right")
    for division, members in groupby(rows, key=lambda row: row.division):
        table.add_section()
        table.add_row(Text(division, style="italic"))
        for row in members:
            groups = ",".join(letters or MISSING for letters in row.groups)
            cells = [_compact(row.estimates[one.metric.name], one) for one in columns]
            table.add_row(*map(Text, [row.method, groups, *cells]))
    return table


def _compact(estimate: Estimate, column: Column) -> str:
    value = number_text(estimate.value, column.form)
    if estimate.low is None or estimate.high is None:
        return value
    half = number_text((estimate.high - estimate.low) / 2, column.form)
    return f"{value}±{half.removeprefix('0') or '0'}"
