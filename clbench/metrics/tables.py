"""CSV files of success rates, in a long or a wide layout; docs/guide/your_numbers.md describes both.

    method,seed,stage,task,success      method,seed,stage,reach,push
    sft,0,1,reach,0.9                   sft,0,1,0.9,
    sft,0,2,reach,0.4                   sft,0,2,0.4,0.8
    sft,0,2,push,0.8

The columns method and seed may be missing. An empty cell or "-" is a missing rate. Lines that begin with #
are notes. A table without a task column is wide.
"""

from __future__ import annotations

import csv
import difflib
import os
from collections.abc import Sequence
from pathlib import Path

from clbench.base.errors import InputError
from clbench.base.text import did_you_mean, quoted
from clbench.metrics.matrices import Cell, Names, Unit, layout_of, matrices_of
from clbench.metrics.report import Report, measure

EXAMPLES = Path(__file__).parent / "examples"
"""Folder of the tables that come with clbench."""

KEYS = ("method", "seed", "stage")
"""Columns that say where a row belongs; all but the last may be missing."""
RATES = ("task", "success")
"""The other columns of a long table."""
MISSING = ("", "-", "nan")
"""Texts of a cell without a rate, in small letters."""
OTHER_MARKS = {";": "semicolons", "\t": "tabs"}
"""What other programs put between the cells."""


def is_table(name: str) -> bool:
    """Return whether a name is meant as a table: it is a path, ends like a table's, or names a file."""
    ends = name.lower().endswith((".csv", ".tsv", ".txt"))
    return ends or os.sep in name or os.path.isfile(name)  # False for a name that is too long


def find(name: Path | str) -> Path:
    """Return the file of a table: the one at this path, or else the example with this name.

    Raises:
        InputError: There is neither; the message names the nearest file.
    """
    path = Path(name)
    if os.path.isfile(path):
        return path
    if os.path.isdir(path):
        raise InputError(f"{quoted(str(path))} is a folder, not a file.")
    if path.name == str(path) and os.path.isfile(EXAMPLES / path):
        return EXAMPLES / path
    examples = sorted(one.name for one in EXAMPLES.glob("*.csv"))
    folder = path.parent
    beside = folder.glob("*.csv") if os.path.isdir(folder) else ()
    near = sorted(one.name for one in beside if os.path.isfile(one))
    guess = difflib.get_close_matches(path.name, near, n=1)
    hint = f" Did you mean {str(folder / guess[0])!r}?" if guess else did_you_mean(str(path), examples)
    raise InputError(f"There is no file {quoted(str(path))}.{hint}")


def notes(path: Path) -> list[str]:
    """Return the notes of a table, such as its source: its lines that begin with #."""
    lines = _text(path).splitlines()
    return [line.lstrip("# ").rstrip() for line in lines if line.startswith("#")]


def from_csv(
    path: Path | str,
    *,
    retained: Names = (),
    target: Names | None = None,
    held_out: Names = (),
    unit: Unit | None = None,
) -> Report:
    """Return every metric that the success rates in a CSV file allow.

    Args:
        path: The file, or the name of an example that comes with clbench, such as "robocasa365.csv".
        retained: As for `from_matrix`, as are the arguments below.
        target: By default, the targets are in the order of the columns or, in a long table, in the order in
            which they first appear.
        held_out: Names of the tasks that are never trained.
        unit: "share" or "percent".

    Raises:
        InputError: The file is missing or is no such table; the message names the line and the cell.
        UnknownNameError: There is no such task.
    """
    path = find(path)
    cells, tasks = _read(path)
    layout = layout_of(tasks, retained, target, held_out)
    return measure(matrices_of(cells, layout, unit, f"{path.name}: "))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path.name}: expected a text file in UTF-8.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None


def _read(path: Path) -> tuple[dict[Cell, float], list[str]]:
    """Return the cells of a table, and its tasks in their order."""
    content = enumerate(_text(path).splitlines(), 1)
    numbered = [(number, line) for number, line in content if line.strip() and not line.startswith("#")]
    rows = csv.reader([line for _, line in numbered], strict=True)
    try:
        lines = [
            (number, [field.strip() for field in row])
            for (number, _), row in zip(numbered, rows, strict=True)
        ]
    except (csv.Error, ValueError) as error:
        # a quotation that goes on below leaves fewer rows than lines
        reason = "a quotation mark is not closed on its line" if isinstance(error, ValueError) else error
        raise InputError(f"{path.name}: not a CSV file: {reason}.") from None
    if len(lines) < 2:
        raise InputError(f"{path.name}: expected a line with the names of the columns, and rows below it.")
    (_, header), *body = lines
    long = _check_header(header, path.name)
    cells: dict[Cell, float] = {}
    seen: dict[Cell, int] = {}
    for number, fields in body:
        where = f"{path.name}, line {number}"
        if len(fields) != len(header):
            raise InputError(f"{where}: expected {len(header)} cells, found {len(fields)}.")
        for cell, text in _cells(dict(zip(header, fields, strict=True)), long, where):
            if cell in seen:
                raise InputError(f"{where}: {cell} was already given on line {seen[cell]}.")
            seen[cell], cells[cell] = number, _rate(text, f"{where}, {cell}")
    tasks = list(dict.fromkeys(cell.task for cell in cells))
    return cells, tasks


def _check_header(header: Sequence[str], name: str) -> bool:
    """Return whether a table is long; refuse columns that make it neither long nor wide."""
    for mark, marks in OTHER_MARKS.items():
        if "stage" not in header and mark in "".join(header):
            raise InputError(f"{name}: expected commas between the cells, found {marks}.")
    for column in header:
        if not column or column.startswith("Unnamed: "):
            raise InputError(f"{name}: a column has no name; if it is pandas' index, write with index=False.")
        if header.count(column) > 1:
            raise InputError(f"{name}: there are two columns {quoted(column)}.")
        if column not in (*KEYS, *RATES) and column.lower() in (*KEYS, *RATES):
            raise InputError(f"{name}: rename the column {column!r} to {column.lower()!r}.")
    long = any(column in header for column in RATES)
    for column in ("stage", *(RATES if long else ())):
        if column not in header:
            layout = "stage, task and success" if long else "stage and one column for each task"
            near = difflib.get_close_matches(
                column, [one for one in header if one not in (*KEYS, *RATES)], n=1
            )
            hint = f" Rename {near[0]!r} to {column!r}." if near else ""
            raise InputError(f"{name}: the column {column!r} is missing: expected {layout}.{hint}")
    if long:
        for column in header:
            if column not in (*KEYS, *RATES):
                known = (*KEYS, *RATES)
                raise InputError(
                    f"{name}: unknown column {quoted(column)}: a long table has {', '.join(known)}."
                    f"{did_you_mean(column, known)}"
                )
    return long


def _cells(row: dict[str, str], long: bool, where: str) -> list[tuple[Cell, str]]:
    """Return the cells of a row with their texts."""
    for key in ("method", "task") if long else ("method",):
        if row.get(key) == "":
            raise InputError(f"{where}: the {key} has no name.")
    method, seed, stage = (row.pop(key, "") for key in KEYS)
    stage = stage.removesuffix(".0")  # pandas writes this if a cell of the column is missing
    if not stage.isascii() or not stage.isdigit():
        raise InputError(
            f"{where}: stage must be a whole number, the number of targets learned so far, not "
            f"{quoted(stage)}."
        )
    pairs = [(row["task"], row["success"])] if long else list(row.items())
    return [(Cell(method, seed, int(stage), task), text) for task, text in pairs]


def _rate(text: str, where: str) -> float:
    """Return the success rate in a cell, NaN if it is missing."""
    if text.lower() in MISSING:
        return float("nan")
    try:
        return float(text.replace("_", "-"))  # Python reads 1_0 as 10
    except ValueError:
        raise InputError(
            f"{where}: expected a success rate such as 0.8 or 80, or an empty cell; found {quoted(text)}."
        ) from None
