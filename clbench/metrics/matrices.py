"""Success matrices: their cells, their units, the groups of their tasks, and `from_matrix`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.base.text import counted, did_you_mean, quoted
from clbench.metrics.report import Matrices, Report, measure
from clbench.scoring.layout import Array, Layout

Unit = Literal["share", "percent"]
"""Unit of success rates: from 0 to 1, or from 0 to 100."""
MOST: dict[Unit, float] = {"share": 1.0, "percent": 100.0}
"""The greatest success rate in each unit."""
ROUNDING = 1e-6
"""Share by which a mean of rates may exceed the greatest rate: the last bits of a sum in single precision."""
DOUBTFUL = 2.0
"""Greatest rate above 1 that may well be an erroneous share."""
MIXED = 0.25
"""If at least this share of a method's nonzero rates is at most 1, these rates may be shares."""

Names = Sequence[str]
"""Names of tasks; a single string is one name."""


class Cell(NamedTuple):
    """The place of one success rate."""

    method: str
    """Name of the method, empty if the table has one method."""
    seed: str
    """Seed as the table writes it, empty without seeds."""
    stage: int
    """Number of targets learned so far."""
    task: str
    """Name of the task."""

    def __str__(self) -> str:
        method = f"method {quoted(self.method)}, " if self.method else ""
        seed = f"seed {quoted(self.seed)}, " if self.seed else ""
        return f"{method}{seed}stage {self.stage}, task {quoted(self.task)}"


def _names(names: Names) -> tuple[str, ...]:
    """Return names as a tuple; a single string is one name, and not its letters."""
    return (names,) if isinstance(names, str) else tuple(names)


def from_matrix(
    matrix: ArrayLike | Mapping[str, ArrayLike],
    *,
    tasks: Names | None = None,
    retained: Names = (),
    target: Names | None = None,
    held_out: Names = (),
    unit: Unit | None = None,
) -> Report:
    """Return every metric that a success matrix allows, and the reasons why the others have no value.

    Args:
        matrix: Success rates, (stages, tasks) or (seeds, stages, tasks), NaN where missing, or a masked
            array; or several such arrays by the name of the method. Row k is the end of stage k, in which
            target k is learned. If there is one row more than targets, the first row is stage 0, before the
            first target. The metric gain compares each seed with the same one of a method called sft, and
            intransigence with that of one called joint.
        tasks: Names of the columns, by default "task 1", "task 2" and so on.
        retained: Names of the tasks that are known before the first target and never trained again; a
            single string is one name, here and below.
        target: Names of the tasks that are learned, in their order. By default, they are all tasks that are
            neither retained nor held out, in the order of the columns.
        held_out: Names of the tasks that are never trained.
        unit: "share" if the rates are from 0 to 1, "percent" if they are from 0 to 100. By default, they are
            shares unless one is above 1; `Report.unit` says what was assumed.

    Raises:
        InputError: A shape does not fit the tasks or the other methods, two methods have one name, a rate is
            not a number or is out of range, there is no such unit, or the rates leave the unit in doubt.
        UnknownNameError: There is no such task.
    """
    arrays = _arrays(matrix if isinstance(matrix, Mapping) else {"": matrix})
    rows, columns = _shape(arrays)
    names = _names(tasks) if tasks is not None else tuple(f"task {n}" for n in range(1, columns + 1))
    if len(names) != columns:
        raise InputError(f"There are {counted(len(names), 'name')} for {counted(columns, 'task')}.")
    layout = layout_of(names, retained, target, held_out)
    first = 1 + len(layout.target) - rows
    if first not in (0, 1):
        raise InputError(f"The matrix has {counted(rows, 'row')}. {_expected_stages(layout)}")
    several = any(array.ndim == 3 and len(array) > 1 for array in arrays.values())
    cells = {
        Cell(method, seed, first + row, name): float(values[row, column])
        for method, array in arrays.items()
        for seed, values in _by_seed(array, several).items()
        for row in range(rows)
        for column, name in enumerate(names)
    }
    return measure(matrices_of(cells, layout, unit))


def _arrays(given: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return success rates as arrays, (stages, tasks) or (seeds, stages, tasks), by name of the method."""
    if not given:
        raise InputError("There is no matrix: expected at least one method.")
    arrays: dict[str, Array] = {}
    for method, values in given.items():
        name = str(method)  # a key may be a number
        if name in arrays:
            raise InputError(f"Two methods are called {quoted(name)}: rename one.")
        arrays[name] = _array(values, name)
    return arrays


def _by_seed(array: Array, several: bool) -> dict[str, Array]:
    """Return the matrices of an array by seed, by its position; the empty name stands for no seed.

    Args:
        array: Success rates, (stages, tasks) or (seeds, stages, tasks).
        several: Whether a method has several seeds; if none has, seeds need no names.
    """
    if array.ndim == 2:
        return {"": array}
    return {str(seed) if several else "": matrix for seed, matrix in enumerate(array)}


def _array(values: ArrayLike, method: str) -> Array:
    """Return the success rates of a method as an array, (stages, tasks) or (seeds, stages, tasks)."""
    name = f" of method {quoted(method)}" if method else ""
    try:
        array = np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan)  # a masked rate is missing
    except (TypeError, ValueError) as error:
        raise InputError(
            f"The matrix{name} is not an array of numbers: expected rows of equal length, NaN where a rate "
            f"is missing ({error})."
        ) from None
    if array.ndim not in (2, 3) or not array.size:
        raise InputError(
            f"The matrix{name} has the shape {array.shape}: expected (stages, tasks) or (seeds, stages, "
            "tasks)."
        )
    return array


def _shape(arrays: Mapping[str, Array]) -> tuple[int, int]:
    """Return the number of rows and columns, the same for all methods."""
    shapes = {method: array.shape[-2:] for method, array in arrays.items()}
    (rows, columns), *others = set(shapes.values())
    if others:
        found = ", ".join(f"{quoted(method)} {shape}" for method, shape in shapes.items())
        raise InputError(f"All methods need the same stages and tasks; their matrices have {found}.")
    return rows, columns


def matrices_of(cells: Mapping[Cell, float], layout: Layout, unit: Unit | None, where: str = "") -> Matrices:
    """Return the cells of a table as matrices.

    Args:
        cells: The success rates that are there, NaN where missing.
        layout: Groups and order of the tasks.
        unit: Unit of the rates; None to infer it from the rates.
        where: Place of the table for messages, such as "table.csv: ".
    """
    stages = sorted({cell.stage for cell in cells})
    if not stages or stages[-1] != len(layout.target) or stages[0] < 0:
        found = f"The stages are {stages[0]} to {stages[-1]}." if stages else "The table has no rows."
        raise InputError(f"{where}{found} {_expected_stages(layout)}")
    known = {cell: rate for cell, rate in cells.items() if not math.isnan(rate)}
    chosen = _likely_unit(known, where) if unit is None else unit
    if chosen not in MOST:
        hint = did_you_mean(str(chosen), MOST)
        raise InputError(f"The unit must be 'share' or 'percent', not {chosen!r}.{hint}")
    _check_range(known, chosen, where)
    places = {name: place for place, name in enumerate(layout.tasks)}
    success: dict[str, dict[str, Array]] = {}
    for cell, rate in cells.items():
        of_method = success.setdefault(cell.method, {})
        if cell.seed not in of_method:
            of_method[cell.seed] = np.full((len(layout.target) + 1, len(layout.tasks)), np.nan)
        of_method[cell.seed][cell.stage, places[cell.task]] = min(rate / MOST[chosen], 1.0)
    return Matrices(layout, success, chosen, unit is not None, max(known.values(), default=0.0))


def _likely_unit(known: Mapping[Cell, float], where: str) -> Unit:
    """Return the unit that the rates show, and refuse rates that leave it in doubt."""
    cell = max(known, key=known.__getitem__, default=None)
    if cell is None or known[cell] <= 1 + ROUNDING:
        return "share"
    mixed = "" if known[cell] <= DOUBTFUL else _mixed(known)
    if known[cell] <= DOUBTFUL or mixed:
        raise InputError(
            f"{where}{cell}: found {known[cell]:g}{mixed}: is it a share above 1, or per cent? Correct it, "
            'or set --unit percent (in Python, unit="percent") if all rates are per cent.'
        )
    return "percent"


def _mixed(known: Mapping[Cell, float]) -> str:
    """Return in words where a table in per cent has rates that look like shares; empty if it has none."""
    small: dict[tuple[str, str], list[bool]] = {}
    for one, rate in known.items():
        if rate > 0:
            for part in ("", f"seed {quoted(one.seed)}", f"task {quoted(one.task)}"):
                small.setdefault((part, one.method), []).append(rate <= 1 + ROUNDING)
    for (part, _), rates in small.items():
        if part and len(rates) > 1 and all(rates):
            return f", and all rates of {part} are at most 1"
        if not part and sum(rates) >= MIXED * len(rates):
            return ", and other rates are at most 1"
    return ""


def _check_range(known: Mapping[Cell, float], unit: Unit, where: str) -> None:
    """Refuse a rate that is impossible in its unit."""
    for cell, rate in known.items():
        if not 0 <= rate <= MOST[unit] * (1 + ROUNDING):
            words = {"share": "a share from 0 to 1", "percent": "per cent from 0 to 100"}[unit]
            raise InputError(f"{where}{cell}: expected {words}, found {rate:g}.")


def layout_of(tasks: Names, retained: Names, target: Names | None, held_out: Names) -> Layout:
    """Return the layout of a matrix whose columns are `tasks`; the groups are those of `from_matrix`."""
    known, never = _names(retained), _names(held_out)
    rest = tuple(task for task in tasks if task not in (*known, *never))
    learned = rest if target is None else _names(target)
    chosen = (*known, *learned, *never)
    for task in chosen:
        if task not in tasks:
            raise unknown("task", task, tasks)
    for task in tasks:
        if chosen.count(task) != 1:
            fault = "is in no group" if task not in chosen else "is named twice"
            raise InputError(f"Task {quoted(task)} {fault}: a task is retained, a target, or held out.")
    return Layout(
        known, learned, never, episodes=(), curve_episodes=(), validation_episodes=(), steps=(1,), kinds=()
    )


def _expected_stages(layout: Layout) -> str:
    """Return which stages a table with these targets has, and what to do if there are more or fewer."""
    count = len(layout.target)
    if not count:
        return "Expected stage 0 alone: no task is left as a target. Name fewer ones as retained or held out."
    return (
        f"Expected stages 1 to {count}, one for each of {counted(count, 'target')}: stage k is the end of "
        "the training on target k, and stage 0, which may be missing, is before the first. Name tasks that "
        "are not targets as retained or held out."
    )
