"""The leaderboard as CSV."""

from __future__ import annotations

import csv
import io

from ..board.summary import COSTS, Summary, column_names, values_of
from .format import number_text


def csv_text(table: Summary) -> str:
    """Return the table with every metric as CSV; missing values are empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    columns = column_names()
    writer.writerow(columns)
    for row in table.rows:
        pairs = zip(columns, values_of(row), strict=True)
        writer.writerow([_field(column, value) for column, value in pairs])
    return stream.getvalue()


def _field(column: str, value: str | float | None) -> str:
    if isinstance(value, str):
        return value
    counts = isinstance(value, int) or column in COSTS  # or means of counts
    whole = counts and value is not None and float(value).is_integer()
    return number_text(value, ".0f" if whole else ".4f", "")
