"""Charts of records: `clbench.plot`. Notebooks show them, and `save` writes an SVG, PNG or PDF file.

`matrix` and `curves` show the runs of one method, `plane` and `frontier` all methods on a scenario. They are
the charts of the leaderboard's page.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.records.paths import RECORDS

if TYPE_CHECKING:
    from clbench.records.record import Record

    from .views.charts.picture import Plot

__all__ = ["curves", "frontier", "matrix", "plane"]

# The charts load SciPy and a converter of pictures: they are imported when they are drawn.


def matrix(runs: Record | Iterable[Record] | Path | str, *, dark: bool = False) -> Plot:
    """Return a chart of the success after each stage (rows) on each task (columns), averaged over runs.

    A frame marks the task that a stage learned. Targets have numbers if the runs learned them in different
    orders.

    Args:
        runs: A record, several records of one method, or the path of a record or of a folder of records.
        dark: Whether to use the colours for a dark page.

    Raises:
        InputError: There is no record, or the records are of several methods or of different scenarios.
        RecordError: A file is not a record, or its run failed.
    """
    from .views.charts.picture import themed
    from .views.charts.runs import Runs, matrix_of

    return themed(matrix_of(Runs.of(_records(runs))), dark)


def curves(
    runs: Record | Iterable[Record] | Path | str,
    sft: Record | Iterable[Record] | Path | str | None = None,
    *,
    dark: bool = False,
) -> Plot:
    """Return a chart of the success along the stages, on the old skills and each target, with intervals.

    Args:
        runs: A record, several records of one method, or the path of a record or of a folder of records.
        sft: The same for plain fine-tuning, to compare the old skills with; None to leave it out.
        dark: Whether to use the colours for a dark page.

    Raises:
        InputError: There is no record, the records are of several methods or of different scenarios, or
            `sft` has runs of another method.
        RecordError: A file is not a record, or its run failed.
    """
    from .views.charts.picture import themed
    from .views.charts.runs import Runs, curves_of

    beside = None if sft is None else Runs.of(_records(sft))
    return themed(curves_of(Runs.of(_records(runs)), beside), dark)


def plane(records: Path | str = RECORDS, scenario: str | None = None, *, dark: bool = False) -> Plot:
    """Return a chart of the methods of a scenario: kept skills against learned targets, with intervals.

    The line below the title names the methods that are far from the others, or have no such values.

    Args:
        records: Folder of the records.
        scenario: Gymnasium id of the scenario (default: the one with most rows).
        dark: Whether to use the colours for a dark page.

    Raises:
        NoRecordsError: The folder does not exist.
        InputError: No record makes a row, or no row has both values.
        UnknownNameError: The scenario has no row.
    """
    from .publishing import read_board
    from .views.charts.picture import themed
    from .views.charts.plane import WIDE
    from .views.charts.plane import plane as chart

    rows = read_board(Path(records)).rows
    names = [row.scenario for row in rows]
    chosen = _chosen(scenario, {name: names.count(name) for name in names}, "row", records)
    drawn = chart([row for row in rows if row.scenario == chosen], WIDE, title=chosen)
    if not drawn["datasets"]["points"]:
        raise InputError(f"No row of {chosen} has both kept skills and learned targets.")
    return themed(drawn, dark)


def frontier(records: Path | str = RECORDS, scenario: str | None = None, *, dark: bool = False) -> Plot:
    """Return a chart of what the methods of a scenario learn and keep at each learning rate of the ladder.

    The records of the ladder are in the folder `ladder` next to the folder of the records. Those that cannot
    be compared with the rows of the board are left out.

    Args:
        records: Folder of the records.
        scenario: Gymnasium id of the scenario (default: the one with most methods).
        dark: Whether to use the colours for a dark page.

    Raises:
        InputError: There is no ladder.
        UnknownNameError: The scenario has none.
    """
    from .board.frontier import frontiers_of, ladder_of, read_ladder
    from .board.rows import runs_of_rows
    from .views.charts.frontier import WIDE
    from .views.charts.frontier import frontier as chart
    from .views.charts.picture import themed
    from .views.charts.vega import FONT, heading

    folder = ladder_of(Path(records))
    if not folder.is_dir():
        raise InputError(
            f"There is no ladder at {folder}. `make ladder` runs it in a clone, or: clbench run SCENARIO "
            f"METHODS --set.step_factor 0.3 --records {folder}"
        )
    board, _ = runs_of_rows(Path(records))
    found = frontiers_of(read_ladder(folder, board)[0])
    chosen = _chosen(scenario, {name: len(curves) for name, curves in found.items()}, "curve", folder)
    return themed({**chart(found[chosen], WIDE, FONT), "title": heading(chosen)}, dark)


def _records(runs: Record | Iterable[Record] | Path | str) -> list[Record]:
    from clbench.records.reader import read_record
    from clbench.records.record import Record

    if isinstance(runs, Record):
        return [runs]
    if not isinstance(runs, (str, Path)):
        return list(runs)
    path = Path(runs)
    return [read_record(one) for one in (sorted(path.rglob("*.json")) if path.is_dir() else [path])]


def _chosen(scenario: str | None, counts: Mapping[str, int], what: str, folder: Path | str) -> str:
    """Return the scenario that was asked for, or else the one with the highest count."""
    if not counts:
        raise InputError(f"No record in {folder} makes a {what}; `clbench leaderboard` says why.")
    chosen = scenario or max(counts, key=counts.__getitem__)
    if chosen not in counts:
        raise unknown(f"scenario with a {what}", chosen, counts)
    return chosen


def __dir__() -> list[str]:
    return __all__
