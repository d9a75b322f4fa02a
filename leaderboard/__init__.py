"""The leaderboard: tables and pages from records, without a network."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas

    from .board.summary import Summary
    from .views.page.plot import Plot

__all__ = ["load", "plot"]


def load(records: Path | str = Path("leaderboard/records")) -> pandas.DataFrame:
    """Return the leaderboard as a table with one row per scenario and method, in the order of the board.

    Columns: `scenario`, `method`, `division`, `groups` (letters; two rows of a division share one if they
    are not told apart), `tier`, `seeds` (their number); for every metric its value and the ends of its 95 %
    confidence interval, for example `retention`, `retention_low`, `retention_high`; then `relative_cost`
    (training time relative to sft), `steps`, `bytes_kept`, `parameters`, `parameters_added` and
    `environment_steps` (of agents that learned online), each a mean over seeds; `order_sensitivity` (range
    of the final average over three or more orders of the targets); and `settings_tried` (number of settings
    that tuning tried). Missing values are NaN.
    `clbench leaderboard` lists the records that make no row, with the reason.

    Args:
        records: Folder of the records.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    from .board.rows import read_table

    return frame_of(read_table(Path(records)))


def frame_of(board: Summary) -> pandas.DataFrame:
    """Return a board as a table, with the columns of `load`."""
    import pandas

    from .board.summary import column_names, values_of

    rows = [values_of(row) for row in board.rows]
    frame = pandas.DataFrame(rows, columns=column_names(), dtype=object)
    kinds = {"seeds": "int64", **dict.fromkeys(("scenario", "method", "division", "groups", "tier"), "str")}
    return frame.astype({name: kinds.get(name, "float64") for name in column_names()})


def plot(
    records: Path | str = Path("leaderboard/records"), scenario: str | None = None, *, dark: bool = False
) -> Plot:
    """Return a chart of the methods of a scenario: kept skills against learned targets, with intervals.

    Notebooks show it, and its `save` writes an SVG, PNG or PDF file.

    Args:
        records: Folder of the records.
        scenario: Gymnasium id of the scenario (default: the one with most rows).
        dark: Whether to use the colours for a dark page.

    Raises:
        FileNotFoundError: The folder does not exist.
        InputError: No record makes a row.
        UnknownNameError: The scenario has no row.
    """
    from clbench.base.entry_points import unknown
    from clbench.base.errors import InputError

    from .board.rows import read_table
    from .views.page.charts import FONT, WIDE, plane
    from .views.page.plot import themed

    rows = read_table(Path(records)).rows
    counts = Counter(row.scenario for row in rows)
    if not counts:
        raise InputError(f"No record in {records} makes a row; `clbench leaderboard` says why.")
    chosen = scenario or max(counts, key=counts.__getitem__)
    if chosen not in counts:
        raise unknown("scenario with a row", chosen, counts)
    return themed(plane([row for row in rows if row.scenario == chosen], WIDE, font=FONT), dark)
