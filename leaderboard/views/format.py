"""How numbers, intervals and names are written, and which metrics the tables have.

The same rows give the same bytes: no date, no absolute path, fixed digits.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS

from ..board.overall import OverallRow
from ..board.rows import Row, standing_of
from ..board.runs import DIVISIONS

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
"""Metrics in the Markdown tables; the CSV file has all."""

RARE = ("perturbed_retention",)
"""Metrics of `SHOWN` that need runs of a special kind: a table has them if one of its rows does."""

FITTING = tuple(metric for metric in SHOWN if metric.name not in (*RARE, "forward_transfer", "zero_shot"))
"""Metrics in the terminal: as many as fit into 108 columns."""

SHORT_TITLES = {"retention_at_matched_adaptation": "matched retention"}
"""Titles of metrics whose names are too long for the head of a column."""

MISSING = "-"
"""Text for a value that could not be computed."""

Rows: TypeAlias = Sequence[Row] | Sequence[OverallRow]


def shown(rows: Rows) -> tuple[Metric, ...]:
    """Return the metrics in a table of `rows`: `SHOWN`, but metrics of `RARE` only if a row has a value."""
    found = {name for name in RARE if any(row.estimates[name].value is not None for row in rows)}
    return tuple(metric for metric in SHOWN if metric.name not in RARE or metric.name in found)


def title_of(name: str) -> str:
    """Return the title of a metric or a cost."""
    return SHORT_TITLES.get(name, name.replace("_", " "))


def number_text(value: float | None, form: str, missing: str = MISSING) -> str:
    """Return `value` in the format `form`. Rounded twice, so that the last bit of a sum does not show."""
    if value is None:
        return missing
    text = format(round(value, 9), form)
    return text if text.strip("-0.") else text.lstrip("-")


def format_interval(estimate: Estimate, form: str = ".2f") -> str:
    """Return a value with its interval, if it has one: "0.14 [0.08, 0.22]"."""
    value, low, high = (number_text(one, form) for one in (estimate.value, estimate.low, estimate.high))
    return value if estimate.low is None else f"{value} [{low}, {high}]"


def aligned(groups: str | None, rows: Iterable[Row]) -> str:
    """Return the letters of a row, each in the column of its group: "a", "ab" and " b" below each other.

    Args:
        groups: Letters of the row.
        rows: All rows of its scenario and division.
    """
    letters = sorted({letter for row in rows for letter in row.groups or ""})
    return "".join(letter if letter in groups else " " for letter in letters) if groups else ""


def standing_text(row: Row, rows: Iterable[Row], named: int | None = None) -> str:
    """Return the place of a row in its division, and the methods that are not told apart from it.

    Args:
        row: The row.
        rows: All rows of its scenario.
        named: Number of methods that are named; further ones are only counted.
    """
    standing = standing_of(row, rows)
    if standing is None:
        return "a reference does not compete" if row.division == DIVISIONS[-1] else "no final average"
    shown = list(standing.alike[:named])
    if len(standing.alike) > len(shown):
        shown.append(f"{len(standing.alike) - len(shown)} more")
    text = f"place {standing.place} of {standing.count}"
    if standing.alike:
        return f"{text}; not told apart from {', '.join(shown)}"
    return f"{text}; told apart from all others" if standing.count > 1 else text


def counted(count: int, noun: str) -> str:
    """Return a number of things: "1 seed", "2 seeds"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def scaled(count: float) -> tuple[str, str]:
    """Return a number in three digits and the prefix of its unit: 1234.0 is ("1.23", "k")."""
    units = ("", "k", "M", "G", "T")
    digits = [float(f"{count / 1000**power:.3g}") for power in range(len(units))]
    # The rounded number decides: 999.9 k is 1 M.
    power = next((power for power, value in enumerate(digits) if value < 1000), len(units) - 1)
    return f"{digits[power]:g}" if power else number_text(count, ".0f"), units[power]


def write_if_changed(path: Path, text: str) -> None:
    """Write `text` to `path` in one step, unless the file has this text already."""
    content = text.encode("utf-8")
    if path.is_file() and path.read_bytes() == content:
        return
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    partial.write_bytes(content)
    os.replace(partial, path)
