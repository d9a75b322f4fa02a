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
    whole = column in ("seeds", "settings_tried", *COSTS)
    return value if isinstance(value, str) else number_text(value, ".0f" if whole else ".4f", "")
