"""The board as a pandas table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from clbench.records.paths import RECORDS

if TYPE_CHECKING:
    import pandas

    from .board.summary import Summary


def load_board(records: Path | str = RECORDS) -> pandas.DataFrame:
    """Return the leaderboard as a table with one row per scenario and method, in the order of the board.

    Columns: `scenario` (its id; for a policy other than the default one it ends in the policy's name, such as
    "clbench/Fetch-v1+discrete_diffusion", because only rows of one policy are compared), `method`,
    `division`, `letters` (two rows of a division share one if they are not told apart in final average),
    `tier`, `seeds` (their number); for every metric its value and the ends of its 95 % confidence interval,
    for example `retention`, `retention_low`, `retention_high`; then `relative_cost` (time of all optimiser
    steps relative to sft), `steps`, `bytes_kept`, `parameters`, `parameters_added` and `environment_steps`
    (of agents that learned online), each a mean over seeds; `order_sensitivity` (range of the final average
    over three or more orders of the targets); and `settings_tried` (number of settings that tuning tried).
    Missing values are NaN. `clbench leaderboard` lists the records that make no row, with the reason.

    Args:
        records: Folder of the records.

    Raises:
        NoRecordsError: The folder does not exist.
    """
    from .publishing import read_board

    return frame_of(read_board(Path(records)))


def frame_of(board: Summary) -> pandas.DataFrame:
    """Return a board as a table, with the columns of `load_board`."""
    import pandas

    from .board.summary import column_names, values_of

    rows = [values_of(row) for row in board.rows]
    frame = pandas.DataFrame(rows, columns=column_names(), dtype=object)
    kinds = {"seeds": "int64", **dict.fromkeys(("scenario", "method", "division", "letters", "tier"), "str")}
    # a copy is in one piece: otherwise pandas warns when a column is added
    return frame.astype({name: kinds.get(name, "float64") for name in column_names()}).copy()
