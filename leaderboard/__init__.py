"""The leaderboard: a table drawn from records, by one command, without a network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from .board.rows import column_names, read_table, values_of

if TYPE_CHECKING:
    import pandas

__all__ = ["load"]


def load(records: Path | str = Path("leaderboard/records")) -> pandas.DataFrame:
    """Return the leaderboard as a table, one row for each scenario and method, sorted as it is shown.

    The columns are `scenario`, `method`, `division`, `rank` (the place in the division, shared by what cannot
    be told apart), `tier`, `seeds` (how many); for every metric its value and the ends of its 95 % interval,
    as `retention`, `retention_low`, `retention_high`; then `relative_cost` (training time, sft's is 1),
    `steps`, `bytes_kept`, `parameters`, `parameters_added` and `environment_steps` (of agents that learned
    online), each a mean over seeds; and `order_sensitivity` (range of the final average over three or more
    orders of the targets). What is missing is NaN. `clbench leaderboard` lists the records that make no row,
    and why.

    Args:
        records: Folder of the records.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    import pandas

    rows = [values_of(row) for row in read_table(Path(records)).rows]
    frame = pandas.DataFrame(rows, columns=column_names(), dtype=object)
    kinds = {"scenario": "str", "method": "str", "division": "str", "tier": "str", "seeds": "int64"}
    return frame.astype({name: kinds.get(name, "float64") for name in column_names()})
