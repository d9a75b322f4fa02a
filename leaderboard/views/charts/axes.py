"""The quantities that the plane of a scenario can show, and their axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clbench.scoring.intervals import Estimate

from ...board.summary import RowSummary, competing
from ..format import bytes_text, format_interval, times_text
from .vega import Spec, finite, rounded

ROOM = 0.02
"""Share of an axis before the first and after the last mark."""

HIGHEST_LOW = 0.8
"""Highest low end of an axis of rates, so that differences of a few episodes do not look large."""

NOT_ZERO = 1000.0
"""Bytes below which the axis of bytes is linear, since its logarithm has no zero."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of a row, a metric or a cost."""

    name: str
    """Short name."""
    source: str
    """Name of the metric or of the cost."""
    meaning: str
    """What it is, for the title of an axis."""
    is_cost: bool = False
    """Whether it is a cost: lower is better, and the axis is logarithmic."""

    @property
    def is_bytes(self) -> bool:
        """Whether it counts bytes. Many rows have 0 bytes, so the axis has a place for zero."""
        return self.source == "bytes_kept"

    def of(self, row: RowSummary) -> Estimate:
        """Return the value of a row with its interval."""
        return Estimate(row.costs[self.source], None, None) if self.is_cost else row.estimates[self.source]

    def text(self, one: Estimate) -> str:
        """Return a value in words."""
        if not self.is_cost or one.value is None:
            return format_interval(one)
        return bytes_text(one.value) if self.is_bytes else times_text(one.value)


LEARNED = Quantity("learned", "adaptation", "success on each new task right after learning it")
COST = Quantity(
    "relative cost", "relative_cost", "time of all optimiser steps divided by sft's", is_cost=True
)
BYTES = Quantity(
    "bytes kept",
    "bytes_kept",
    "state, added buffers and prior data kept between stages",
    is_cost=True,
)
KEPT = Quantity("kept", "kept", "success at the end on everything known before the last task")
SKILLS = Quantity("kept skills", "retention", "success on the old skills at the end")
TARGETS = Quantity("kept targets", "kept_targets", "success at the end on the new tasks before the last")

ACROSS = (LEARNED, COST, BYTES)
"""Quantities from left to right: what a method learns, and what it takes."""

UP = (KEPT, SKILLS, TARGETS)
"""Quantities from bottom to top: what a method keeps."""


@dataclass(frozen=True)
class Axis:
    """An axis along which right, or up, is better: costs fall along it."""

    quantity: Quantity
    low: float
    high: float

    @classmethod
    def of(cls, quantity: Quantity, rows: Sequence[RowSummary]) -> Axis:
        """Return the axis that has room for all values of the methods among `rows`, with their intervals."""
        found = [quantity.of(row) for row in competing(rows)]
        ends = [end for one in found for end in (one.value, one.low, one.high) if end is not None]
        least, most = min(ends, default=0.0), max(ends, default=1.0)
        if not quantity.is_cost:
            return cls(quantity, min(max(math.floor(least * 10 + 1e-9) / 10, 0.0), HIGHEST_LOW), 1.0)
        if quantity.is_bytes:
            return cls(quantity, 0.0, max(most, NOT_ZERO) * 2)
        # The axis is logarithmic: a method that takes no steps has no place on it.
        positive = [end for end in ends if end > 0]
        return cls(quantity, min(positive, default=1.0) / 1.25, max(positive, default=1.0) * 1.25)

    def holds(self, one: Estimate) -> bool:
        """Return whether a value is known and on the axis."""
        return one.value is not None and self.low - 1e-9 <= one.value <= self.high + 1e-9

    def clipped(self, one: Estimate) -> tuple[float | None, float | None]:
        """Return the part of an interval that is on the axis; the value twice if there is no interval."""
        if one.low is None or one.high is None:
            return one.value, one.value
        low, high = self._domain
        return max(one.low, low), min(one.high, high)

    def number(self, value: float | None) -> float | None:
        """Return a value for the chart. A cost has four digits: its axis is logarithmic, without 0."""
        known = finite(value)
        return float(f"{known:.4g}") if self.quantity.is_cost and known is not None else rounded(known)

    def share(self, value: float) -> float:
        """Return where a value is, from 0 at the worse end of the axis to 1 at the better one."""
        low, high, here = (self._bent(one) for one in (self.low, self.high, value))
        share = ROOM + (1 - 2 * ROOM) * (here - low) / (high - low)
        return 1 - share if self.quantity.is_cost else share

    @property
    def worst(self) -> float:
        """Value at the worse end."""
        return self._domain[1 if self.quantity.is_cost else 0]

    @property
    def _domain(self) -> list[float]:
        low, high = self._bent(self.low), self._bent(self.high)
        room = (high - low) * ROOM / (1 - 2 * ROOM)
        return [self._straight(low - room), self._straight(high + room)]

    @property
    def scale(self) -> Spec:
        """Its scale in Vega-Lite."""
        kind: Spec = {"domain": self._domain, "nice": False}
        if self.quantity.is_bytes:
            return kind | {"type": "symlog", "constant": NOT_ZERO, "reverse": True}
        return kind | ({"type": "log", "reverse": True} if self.quantity.is_cost else {"zero": False})

    @property
    def marks(self) -> Spec:
        """Its ticks and labels in Vega-Lite."""
        if self.quantity.is_bytes:
            # the format "~s" gives all ticks one prefix: 1 kB would read "0M"
            label = "datum.value ? replace(format(datum.value, '~s'), /([kMG])/, ' $1') + 'B' : '0'"
            return {"values": [0, 1e3, 1e6, 1e9], "labelExpr": label}
        if self.quantity.is_cost:
            return {"values": [0.5, 1, 2, 5, 10, 20, 50, 100, 1000], "format": "~r"}
        return {"format": ".2~f", "tickCount": 5}

    def title(self, is_long: bool) -> str:
        """Return the title of the axis."""
        name = self.quantity.name + (", less is better" if self.quantity.is_cost else "")
        return f"{name}: {self.quantity.meaning}" if is_long else name

    def _bent(self, value: float) -> float:
        if self.quantity.is_bytes:
            return math.copysign(math.log1p(abs(value) / NOT_ZERO), value)
        return math.log(value) if self.quantity.is_cost else value

    def _straight(self, bent: float) -> float:
        if self.quantity.is_bytes:
            return math.copysign(math.expm1(abs(bent)) * NOT_ZERO, bent)
        return math.exp(bent) if self.quantity.is_cost else bent
