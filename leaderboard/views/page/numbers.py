"""Numbers as the tables show them: text, sort key, interval and bar."""

from __future__ import annotations

from dataclasses import dataclass

from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import DIFFERENCE

from ...board.rows import Row
from ..format import Column, bytes_text, number_text, times_text

MISSING = "\N{EN DASH}"
"""Text for a value that could not be computed."""


@dataclass(frozen=True)
class Number:
    """A number in a cell."""

    text: str
    """Text in the cell."""
    order: str = ""
    """Sort key; empty if the number is missing."""
    note: str = ""
    """Its interval, or the reason why it is missing."""
    bar: tuple[float, ...] = ()
    """Low end, value and high end in per cent of a bar from 0 to 1; empty without an interval."""


def number(one: Estimate, column: Column) -> Number:
    """Return the cell of a metric."""
    metric, form = column.metric, column.form
    if one.value is None:
        return Number(MISSING, note=f"missing: {metric.missing.replace('`', '')}")
    text, order = number_text(one.value, form), number_text(one.value, ".6f")
    if one.low is None or one.high is None:
        return Number(text, order, "without an interval")
    ends = [round(100 * min(max(round(end, 9), 0.0), 1.0)) for end in (one.low, one.value, one.high)]
    note = f"95 % interval from {number_text(one.low, form)} to {number_text(one.high, form)}"
    has_bar = (metric.low, metric.high) == (0, 1) and metric.units != DIFFERENCE
    return Number(text, order, note, tuple(ends) if has_bar else ())


def tried(row: Row) -> Number:
    """Return the number of settings that tuning tried."""
    if row.tried is None:
        return Number(MISSING, note="the method was not tuned here")
    return Number(str(row.tried), str(row.tried))


def cost(row: Row) -> Number:
    """Return the relative cost."""
    relative = row.costs["relative_cost"]
    if relative is None:
        return Number(
            MISSING, note="missing: the time of a step was not measured, for this method or for sft"
        )
    return Number(times_text(relative), number_text(relative, ".6f"))


def size(row: Row) -> Number:
    """Return the bytes kept."""
    kept = row.costs["bytes_kept"]
    if kept is None:
        return Number(MISSING, note="missing: a record has no value")
    return Number(bytes_text(kept), number_text(kept, ".0f"), f"{number_text(kept, ',.0f')} bytes")
