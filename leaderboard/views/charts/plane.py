"""The plane of a scenario: what methods keep against what they learn, or what they cost.

The page lets readers choose both axes and hide methods. A plane therefore has two parts: a template, which
depends only on its size, and the values that fill the template's places for two quantities. Places are texts
that begin with "@".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ...board.summary import DIVISIONS, ELSEWHERE, METHODS, RowSummary
from .axes import LEARNED, SKILLS, Axis, Quantity
from .labels import LONGEST, Mark, place
from .vega import FONT, SHAPES, SYSTEM_FONT, Size, Spec, colour, heading, layer, specification, subtitle

FULL = Size(1050, 430, 6)
"""Size where the window has room for it."""

WIDE = Size(620, 400, 4)
"""Size on a small desktop, and of pictures."""

NARROW = Size(205, 320, 2)
"""Size on a phone."""

MEANING = "Thin lines: 95 % intervals, cut off at the edge. Dashed lines: Pareto front of a division."
"""What the marks themselves do not say."""


def plane(rows: Sequence[RowSummary], size: Size, title: str = "") -> Spec:
    """Return the plane of kept skills and learned tasks as a picture.

    Args:
        rows: Rows of one scenario.
        size: Size of the plane.
        title: Text above it.
    """
    drawn = Plane(rows, LEARNED, SKILLS)
    found = {str(point["division"]) for point in drawn.points}
    spec: Spec = filled(template(size, FONT, found), drawn.places | drawn.labels(size))
    return {**spec, "title": heading(title) | subtitle((MEANING, drawn.note), size.width)}


def filled(part: Any, places: Mapping[str, Any]) -> Any:
    """Return a template with its places filled."""
    if isinstance(part, dict):
        return {name: filled(value, places) for name, value in part.items()}
    if isinstance(part, list):
        return [filled(value, places) for value in part]
    return places.get(part, part) if isinstance(part, str) else part


def template(size: Size, font: str = SYSTEM_FONT, named: Iterable[str] = ()) -> Spec:
    """Return the plane without its points and axes.

    Args:
        size: Size of the plane.
        font: Font of all texts.
        named: Divisions in the legend; without any, there is no legend.
    """
    shown = [name for name in DIVISIONS if name in set(named)]
    hues = {"domain": list(DIVISIONS), "range": [colour(f"mark-{n}") for n in range(len(DIVISIONS))]}
    legend = {"columns": size.columns, "values": shown} if shown else None
    hue = {"field": "division", "type": "nominal", "scale": hues, "legend": legend}
    shape = hue | {"scale": {"domain": list(DIVISIONS), "range": list(SHAPES)}}
    x, y = (
        {"field": name, "type": "quantitative", "title": f"@{name} title"}
        | {"scale": f"@{name} scale", "axis": f"@{name} marks"}
        for name in "xy"
    )
    across = {"x": x | {"field": "x_low"}, "x2": {"field": "x_high"}, "y": y, "color": hue}
    upright = {"x": x, "y": y | {"field": "y_low"}, "y2": {"field": "y_high"}, "color": hue}
    mark = {"type": "point", "filled": True, "size": 95, "opacity": 1}
    mark |= {"stroke": colour("paper"), "strokeWidth": 1}
    whisker = {"type": "rule", "opacity": 0.4}
    front = {"type": "line", "strokeWidth": 1.5, "strokeDash": [4, 3], "opacity": 0.8}
    tooltip = [{"field": name} for name in ("method", "division", "across", "up")]
    # In pixels, since some labels are outside the plane.
    left, top = ({"field": name, "type": "quantitative", "scale": None, "axis": None} for name in "xy")
    leader = {"type": "rule", "color": colour("line")}
    text = {"type": "text", "baseline": "middle", "fontSize": 12, "limit": LONGEST, "color": colour("ink")}
    method = {"field": "method", "type": "nominal"}
    layers = [
        _named("corners", front, x=x, y=y, color=hue, order={"field": "order"}),
        _named("points", whisker, **across),
        _named("points", whisker, **upright),
        _named("leaders", leader, x=left, y=top, x2={"value": size.width + 10}, y2={"field": "to"}),
        _named("left", text | {"align": "left"}, x=left, y=top, text=method),
        _named("right", text | {"align": "right"}, x=left, y=top, text=method),
        _named("points", mark, x=x, y=y, color=hue, shape=shape, tooltip=tooltip),
    ]
    data = {name: f"@{name}" for name in ("points", "corners", "leaders", "left", "right")}
    return specification(font, layer=layers, width=size.width, height=size.height, datasets=data)


def _named(data: str, mark: Spec, **encoding: Any) -> Spec:
    # A layer may be empty, and an empty group without a name is an error for screen readers.
    return layer([], mark | {"aria": False}, **encoding) | {"data": {"name": data}}


class Plane:
    """The rows of a scenario in the plane of two quantities."""

    def __init__(
        self,
        rows: Sequence[RowSummary],
        across: Quantity,
        up: Quantity,
        anchors: Mapping[str, str] | None = None,
    ) -> None:
        """Place the rows.

        Args:
            rows: Rows of one scenario.
            across: Quantity from left to right.
            up: Quantity from bottom to top.
            anchors: Anchors that the marks link to, by method.
        """
        self.across, self.up = Axis.of(across, rows), Axis.of(up, rows)
        inside = [row for row in rows if self._holds(row)]
        self.points = [self._point(row, (anchors or {}).get(row.method, "")) for row in inside]
        self.corners = [corner for division in (*METHODS, *ELSEWHERE) for corner in self._front(division)]
        self.outside = [row for row in rows if not self._holds(row)]

    @property
    def places(self) -> dict[str, Any]:
        """Values that fill the template at any size: points and axes."""
        axes: dict[str, Any] = {}
        for name, one in (("x", self.across), ("y", self.up)):
            axes |= {f"@{name} scale": one.scale, f"@{name} marks": one.marks}
        return {**axes, "@points": self.points, "@corners": self.corners}

    def labels(self, size: Size) -> dict[str, Any]:
        """Return the values that depend on the size: titles of the axes, labels, and lines to some labels."""
        marks = [self._mark(point, size) for point in self.points]
        rows = {round((1 - self.up.share(corner["y"])) * size.height, 3) for corner in self.corners}
        labels = place(marks, sorted(rows), size.width, size.height)
        leaders = [
            {"method": one.name, "x": _pixel(one.mark.x), "y": _pixel(one.mark.y), "to": _pixel(one.y)}
            for one in labels
            if one.mark
        ]
        texts = {
            f"@{align}": [
                {"method": one.name, "x": _pixel(one.x), "y": _pixel(one.y)}
                for one in labels
                if one.align == align
            ]
            for align in ("left", "right")
        }
        is_long = size.width > NARROW.width
        titles = {"@x title": self.across.title(is_long), "@y title": self.up.title(is_long)}
        return {"@leaders": leaders, **texts, **titles}

    @property
    def note(self) -> str:
        """Which rows are not in the plane, and their values."""
        texts = [
            f"{row.method} ({', '.join(self._value(axis.quantity, row) for axis in (self.across, self.up))})"
            for row in self.outside
        ]
        return f"Not in the chart: {'; '.join(texts)}." if texts else ""

    def _value(self, quantity: Quantity, row: RowSummary) -> str:
        one = quantity.of(row)
        return f"no {quantity.name}" if one.value is None else f"{quantity.name} {quantity.text(one)}"

    def _holds(self, row: RowSummary) -> bool:
        return all(axis.holds(axis.quantity.of(row)) for axis in (self.across, self.up))

    def _point(self, row: RowSummary, anchor: str) -> dict[str, Any]:
        point: dict[str, Any] = {"method": row.method, "division": row.division, "anchor": anchor}
        for side, name, axis in (("x", "across", self.across), ("y", "up", self.up)):
            one = axis.quantity.of(row)
            low, high = axis.clipped(one)
            point[side] = axis.number(one.value)
            point[f"{side}_low"] = axis.number(low)
            point[f"{side}_high"] = axis.number(high)
            point[name] = f"{axis.quantity.name} {axis.quantity.text(one)}"
        return point

    def _mark(self, point: Mapping[str, Any], size: Size) -> Mark:
        x, *ends = (self.across.share(point[name]) * size.width for name in ("x", "x_low", "x_high"))
        y, bottom, top = ((1 - self.up.share(point[name])) * size.height for name in ("y", "y_low", "y_high"))
        return Mark(str(point["method"]), x, y, min(ends), max(ends), top, bottom)

    def _front(self, division: str) -> list[dict[str, Any]]:
        """Return the corners of the Pareto front of two or more methods of a division.

        A point below and left of it is worse in both quantities.
        """
        points = [point for point in self.points if point["division"] == division]
        if len(points) < 2:
            return []
        best: list[tuple[float, float]] = []
        for point in sorted(points, key=lambda one: (self.across.share(one["x"]), one["y"]), reverse=True):
            if not best or point["y"] > best[-1][1]:
                best.append((point["x"], point["y"]))
        corners = [(best[0][0], self.up.worst)]
        for (x, y), (next_x, _) in zip(best, [*best[1:], (self.across.worst, 0.0)], strict=True):
            corners += [(x, y), (next_x, y)]
        return [
            {"x": x, "y": y, "division": division, "order": order}
            for order, (x, y) in enumerate(reversed(corners))
        ]


def _pixel(value: float) -> float:
    return round(value, 1) + 0.0
