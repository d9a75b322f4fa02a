"""The forms that the leaderboard is drawn in: terminal, Markdown and CSV.

The same rows give the same bytes: no date, no absolute path, fixed digits.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table as Grid
from rich.text import Text

from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS

from ..board.costs import COSTS
from ..board.overall import OverallRow, overall
from ..board.rows import Row, Table, column_names, values_of
from ..board.runs import printable
from ..board.tiers import TIERS

SHOWN = tuple(
    METRICS[name]
    for name in (
        "final_average",
        "adaptation",
        "retention",
        "perturbed_retention",
        "retention_at_matched_adaptation",
        "forgetting",
        "forward_transfer",
        "question_retention",
        "zero_shot",
    )
)
"""Metrics in Markdown; the CSV file has all."""

RARE = ("perturbed_retention",)
"""Those of them that take runs of a special kind: a table has them if one of its rows does."""

FITTING = tuple(metric for metric in SHOWN if metric.name not in (*RARE, "forward_transfer", "zero_shot"))
"""Metrics in the terminal, as many as fit 108 columns."""

SHORT_TITLES = {"retention_at_matched_adaptation": "matched retention"}
"""Titles of metrics whose name is too long for the head of a column."""

Rows: TypeAlias = Sequence[Row] | Sequence[OverallRow]

LEGEND = (
    "Rows of a division that cannot be told apart share a rank. ± is half the width of a 95 % interval. "
    "Higher is better, but for {lower}. Cost: training time, sft's is 1. Tier: {tiers}.\n"
)
"""What a reader of the terminal must know."""

MISSING = "-"
"""What stands for a value that could not be computed."""


def shown(rows: Rows) -> tuple[Metric, ...]:
    """Return the metrics in a table of `rows`: `SHOWN`, of `RARE` only what one of them has."""
    found = {name for name in RARE if any(row.estimates[name].value is not None for row in rows)}
    return tuple(metric for metric in SHOWN if metric.name not in RARE or metric.name in found)


def write_if_changed(path: Path, text: str) -> None:
    """Write `text` to `path` in one step, unless it is there already."""
    content = text.encode("utf-8")
    if path.is_file() and path.read_bytes() == content:
        return
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_bytes(content)
    os.replace(partial, path)


def number_text(value: float | None, form: str, missing: str = MISSING) -> str:
    """Return `value` in the format `form`. Rounded twice, so that the last bit of a sum does not show."""
    if value is None:
        return missing
    text = format(round(value, 9), form)
    return text if text.strip("-0.") else text.lstrip("-")


def scaled(count: float) -> tuple[str, str]:
    """Return a number in three digits and the prefix of its unit: 1234.0 is ("1.23", "k")."""
    units = ("", "k", "M", "G", "T")
    digits = [float(f"{count / 1000**power:.3g}") for power in range(len(units))]
    # asked of the rounded number: 999.9 k is 1 M
    power = next((power for power, value in enumerate(digits) if value < 1000), len(units) - 1)
    return f"{digits[power]:g}" if power else number_text(count, ".0f"), units[power]


# ---- CSV ---------------------------------------------------------------------------------------------------


def csv_text(table: Table) -> str:
    """Return the table with every metric as CSV; what is missing is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = column_names()
    writer.writerow(columns)
    for row in table.rows:
        pairs = zip(columns, values_of(row), strict=True)
        writer.writerow([_field(column, value) for column, value in pairs])
    return stream.getvalue()


def _field(column: str, value: str | float | None) -> str:
    whole = column in ("rank", "seeds", *COSTS)
    return value if isinstance(value, str) else number_text(value, ".0f" if whole else ".4f", "")


# ---- Markdown ----------------------------------------------------------------------------------------------


def markdown(table: Table) -> str:
    """Return the table as a page of Markdown."""
    head = [
        "# Leaderboard",
        "",
        "Made by `clbench leaderboard` from the records alone; `leaderboard.csv` has every metric. "
        "Values are means over seeds with 95 % intervals over seeds, with one seed over episodes. Rows of a "
        "division that cannot be told apart share a rank: docs/guide/statistics.md. "
        f"`{MISSING}` stands for what could not be computed.",
    ]
    scenarios = groupby(table.rows, key=lambda row: row.scenario)
    parts = [line for scenario, rows in scenarios for line in _scenario(table, scenario, list(rows))]
    return "\n".join([*head, *_overall(table), *parts, *_legend(table.rows), *_not_shown(table)]) + "\n"


def _overall(table: Table) -> list[str]:
    """Return the table over scenarios, nothing if there is only one."""
    rows = overall(table.rows)
    if not rows:
        return []
    metrics = shown(rows)
    head = ["method", "division", "ranks", *(title_of(metric.name) for metric in metrics)]
    names = ", ".join(escaped(name) for name in sorted(table.scenarios))
    return [
        "",
        "## All scenarios",
        "",
        f"Means over {names} of the methods that have a row in each; ranks in this order.",
        "",
        table_line(head),
        table_line(["---", "---", *["--:"] * (len(head) - 2)]),
        *(table_line([escaped(row.method), row.division, *_overall_cells(row, metrics)]) for row in rows),
    ]


def _overall_cells(row: OverallRow, metrics: Sequence[Metric]) -> list[str]:
    ranks = ", ".join(number_text(rank, ".0f") for rank in row.ranks)
    return [ranks, *(interval(row.estimates[metric.name]) for metric in metrics)]


def _scenario(table: Table, scenario: str, rows: list[Row]) -> list[str]:
    """Return the heading, the tasks and the table of a scenario."""
    names = {
        group: ", ".join(map(escaped, table.scenarios[scenario][group])) or "none"
        for group in ("retained", "target", "held_out")
    }
    metrics = shown(rows)
    columns = ["rank", "method", "division", "tier", "seeds", *(title_of(metric.name) for metric in metrics)]
    columns += ["relative cost", "bytes kept", "parameters added"]
    return [
        "",
        f"## {escaped(scenario)}",
        "",
        f"Retained skills: {names['retained']}. Targets in order: {names['target']}. "
        f"Held-out tasks: {names['held_out']}.",
        "",
        table_line(columns),
        table_line(["--:", "---", "---", "---", *["--:"] * (len(columns) - 4)]),
        *(table_line(_cells(row, metrics)) for row in rows),
    ]


def _cells(row: Row, metrics: Sequence[Metric]) -> list[str]:
    return [
        number_text(row.rank, ".0f"),
        escaped(row.method),
        row.division,
        row.tier,
        str(len(row.seeds)),
        *(interval(row.estimates[metric.name]) for metric in metrics),
        number_text(row.costs["relative_cost"], ".2f"),
        *(number_text(row.costs[name], ",.0f") for name in ("bytes_kept", "parameters_added")),
    ]


def table_line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def interval(estimate: Estimate, form: str = ".2f") -> str:
    """Return a value with its interval, if it has one."""
    value, low, high = (number_text(one, form) for one in (estimate.value, estimate.low, estimate.high))
    return value if estimate.low is None else f"{value} [{low}, {high}]"


def _legend(rows: Sequence[Row]) -> list[str]:
    """Return what the columns mean."""
    lines = [
        "",
        "## Metrics",
        "",
        escaped(
            "R[l][s] is the success rate on task s at the end of stage l. Stage 0 is the pretrained policy, "
            "target k is learned in stage k, K is the last stage."
        ),
        "",
    ]
    for metric in shown(rows):
        better = {True: "higher is better", False: "lower is better", None: "neither high nor low is better"}
        low, high = ("unbounded" if math.isinf(end) else f"{end:g}" for end in (metric.low, metric.high))
        lines.append(
            f"- **{title_of(metric.name)}** ({better[metric.higher_is_better]}; from {low} to {high}; "
            f"version {metric.version}): {escaped(metric.description)} Computed as "
            f"{escaped(metric.formula)}. Source: {escaped(metric.source)}."
        )
    return lines


def _not_shown(table: Table) -> list[str]:
    if not table.not_shown:
        return []
    entries = [f"- {escaped(entry.path)}: {escaped(entry.reason)}" for entry in table.not_shown]
    return ["", "## Not shown", "", *entries]


def title_of(name: str) -> str:
    return SHORT_TITLES.get(name, name.replace("_", " "))


def escaped(text: str) -> str:
    """Return `text`, which a stranger may have written, so that Markdown shows it as it is.

    Backslashes go before all that can open markup, HTML, a mention or a table cell, and into web addresses.
    """
    return re.sub(
        r"([\\`*_{}\[\]<>|~&@#]|(?<=:)/(?=/)|(?<=www)\.)", r"\\\1", printable(text), flags=re.IGNORECASE
    )


# ---- terminal ----------------------------------------------------------------------------------------------


def terminal(table: Table) -> RenderableType:
    """Return the table for a terminal of 108 columns."""
    # Text and not str: rich would obey markup in a stranger's words.
    parts: list[RenderableType] = []
    for scenario, rows in groupby(table.rows, key=lambda row: row.scenario):
        parts.append(_grid(scenario, list(rows)))
    over_scenarios = overall(table.rows)
    if over_scenarios:
        parts.append(_overall_grid(over_scenarios))
    if parts:
        lower = ", ".join(title_of(metric.name) for metric in FITTING if metric.higher_is_better is False)
        tiers = ", ".join(f"{number} {tier}" for number, tier in enumerate(TIERS))
        parts.append(Text(LEGEND.format(lower=lower, tiers=tiers)))
    if table.not_shown:
        parts.append(Text("Not shown", style="bold"))
        parts += [Text(f"  {entry.path}: {entry.reason}", overflow="fold") for entry in table.not_shown]
    return Group(*parts)


def _grid(scenario: str, rows: list[Row]) -> Grid:
    """Return the table of one scenario, with a section for each division."""
    grid = Grid(title=Text(scenario, style="bold"), box=SIMPLE_HEAD, padding=0, title_justify="left")
    grid.add_column("", justify="right", min_width=2)
    grid.add_column("method", overflow="fold", min_width=20)
    for name in ("seeds", *(title_of(metric.name) for metric in FITTING), "cost", "bytes kept", "tier"):
        # One word a line: a header must not make its column wider than the numbers.
        grid.add_column(name.replace(" ", "\n"), justify="right")
    for division, members in groupby(rows, key=lambda row: row.division):
        grid.add_section()
        grid.add_row("", Text(division, style="italic"))
        for row in members:
            cells = [number_text(row.rank, ".0f", ""), row.method, str(len(row.seeds))]
            cells += [_compact(row.estimates[metric.name]) for metric in FITTING]
            kept = row.costs["bytes_kept"]
            size = MISSING if kept is None else "".join(scaled(kept))
            cells += [number_text(row.costs["relative_cost"], ".1f"), size]
            grid.add_row(*map(Text, cells), str(TIERS.index(row.tier)))
    return grid


def _overall_grid(rows: Sequence[OverallRow]) -> Grid:
    """Return the table over scenarios, with a section for each division."""
    grid = Grid(title=Text("All scenarios", style="bold"), box=SIMPLE_HEAD, padding=0, title_justify="left")
    grid.add_column("method", overflow="fold", min_width=20)
    for name in ("ranks", *(title_of(metric.name) for metric in FITTING)):
        grid.add_column(name.replace(" ", "\n"), justify="right")
    for division, members in groupby(rows, key=lambda row: row.division):
        grid.add_section()
        grid.add_row(Text(division, style="italic"))
        for row in members:
            ranks = ",".join(number_text(rank, ".0f") for rank in row.ranks)
            cells = [_compact(row.estimates[metric.name]) for metric in FITTING]
            grid.add_row(*map(Text, [row.method, ranks, *cells]))
    return grid


def _compact(estimate: Estimate) -> str:
    value = number_text(estimate.value, ".2f")
    if estimate.low is None or estimate.high is None:
        return value
    half = number_text((estimate.high - estimate.low) / 2, ".2f")
    return f"{value}±{half.removeprefix('0')}"
