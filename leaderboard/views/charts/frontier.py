"""The frontier as Vega-Lite: what methods learn and keep along the ladder of learning rates.

Each method has a panel with the line of plain fine-tuning in it: all lines in one picture would be a tangle.
Methods with prior demonstrations may keep so much more than other methods that their panels have their own
axes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

from ...board.frontier import Curve
from ...board.summary import DIVISIONS, WITH_DEMONSTRATIONS
from ..format import format_interval, number_text
from .vega import SYSTEM_FONT, Size, Spec, axis, colour, heading, layer, rounded, specification, subtitle

RATE_SHAPES = ("circle", "square", "triangle-up", "diamond", "cross", "triangle-down")
"""Shapes of the learning rates, the largest first."""

BESIDE = "sft, in every panel"
"""Name of plain fine-tuning in the legend."""

WIDE = Size(165, 150, 4)
"""Size of a panel on a desktop."""

NARROW = Size(145, 145, 2)
"""Size of a panel on a phone."""

SPACING = {"row": 36, "column": 14}
"""Pixels between two panels: room for the name of the lower one."""

MEANINGS = (
    "to the right: learned, success on each target right after learning it",
    "upwards: kept, success at the end on all that was known before the last target",
    "thin lines: 95 % intervals of what is kept, cut at the ends of the axis",
)
"""What the axes show."""

LEAST_SPAN = 0.15
"""Least length of an axis, so that differences of a few episodes do not look large."""

STEPS = (0.05, 0.1, 0.2, 0.25)
"""Possible distances of two ticks; axes begin and end at a multiple of the first."""

PARTS = 4
"""Most parts of an axis between ticks: there is room for this many labels."""

ROOM = 0.01
"""Least distance of a mark from the ends of its axis."""

Points: TypeAlias = list[dict[str, Any]]
"""Marks of a curve."""


def frontier(curves: Sequence[Curve], size: Size, font: str = SYSTEM_FONT) -> Spec:
    """Return the chart of the curves of one scenario: a panel for each method, a mark for each learning rate.

    Args:
        curves: Curves, plain fine-tuning first.
        size: Size of a panel.
        font: Font of all texts.
    """
    known = [(curve, points) for curve in curves if (points := _points(curve))]
    baseline = [one for curve, points in known if curve.is_baseline for one in points]
    others = [(curve, points) for curve, points in known if not curve.is_baseline]
    out = [one for one in others if one[0].division not in WITH_DEMONSTRATIONS]
    having = [one for one in others if one[0].division in WITH_DEMONSTRATIONS]
    apart = ", other axes" if out else ""
    groups = {"Without prior demonstrations": out, f"With prior demonstrations{apart}": having}
    if not others:
        groups = {"Plain fine-tuning": known}
    look = _look([one for _, points in known for one in points], size)
    parts = [_group(title, members, baseline, look, size) for title, members in groups.items() if members]
    if parts:
        parts[0]["title"] |= subtitle(MEANINGS, size.columns * (size.width + SPACING["column"]))
    spec = specification(font, vconcat=parts, spacing=28)
    spec["config"]["legend"]["layout"] = {"top": {"direction": "vertical", "anchor": "start", "margin": 8}}
    return spec


def _points(curve: Curve) -> Points:
    """Return the marks of a curve whose values are known."""
    return [
        {
            "method": curve.method,
            "line": BESIDE if curve.is_baseline else curve.division,
            "learning rate": f"\N{MULTIPLICATION SIGN} {number_text(rung.factor, 'g')}",
            "order": rung.factor,
            "x": rounded(rung.learned.value),
            "y": rounded(rung.kept.value),
            "low": rounded(rung.kept.low),
            "high": rounded(rung.kept.high),
            "learned": format_interval(rung.learned),
            "kept": format_interval(rung.kept),
            "seeds": len(rung.seeds),
        }
        for rung in curve.rungs
        if rung.learned.value is not None and rung.kept.value is not None
    ]


def _look(points: Points, size: Size) -> Spec:
    """Return the colours of the lines and the shapes of the marks, with their legends."""
    divisions = [name for name in DIVISIONS if any(one["line"] == name for one in points)]
    lines = [BESIDE, *divisions] if any(one["line"] == BESIDE for one in points) else divisions
    hues = [colour("ink" if name == BESIDE else f"mark-{DIVISIONS.index(name)}") for name in lines]
    rates = {one["learning rate"]: one["order"] for one in points}
    factors = sorted(rates, key=lambda name: -rates[name])
    legend: Spec = {
        "columns": size.columns,
        "symbolType": "stroke",
        "symbolStrokeWidth": 3,
        "symbolSize": 250,
        "columnPadding": 16,
    }
    grey = {"symbolFillColor": colour("muted"), "symbolStrokeColor": colour("muted")}
    rate: Spec = {"title": "learning rate", "titleColor": colour("ink"), "titleFontWeight": "normal"}
    rate |= {"titleFontSize": 12, "columns": len(factors), **grey}
    shapes = [RATE_SHAPES[number % len(RATE_SHAPES)] for number in range(len(factors))]
    return {
        "color": {"field": "line", "type": "nominal", "legend": legend}
        | {"scale": {"domain": lines, "range": hues}},
        "shape": {"field": "learning rate", "type": "nominal", "legend": rate}
        | {"scale": {"domain": factors, "range": shapes}},
    }


def _group(
    title: str, members: Sequence[tuple[Curve, Points]], baseline: Points, look: Spec, size: Size
) -> Spec:
    """Return the panels of some curves, which share their axes; axes are named only at the edge."""
    shown = [*baseline, *(one for _, points in members for one in points)]
    ends = {name: _ends(one[name] for one in shown) for name in "xy"}
    panels = []
    for number, (curve, points) in enumerate(members):
        x = _position("x", "learned", ends["x"], is_named=number + size.columns >= len(members))
        y = _position("y", "kept", ends["y"], is_named=number % size.columns == 0)
        beside = [] if curve.is_baseline else baseline
        layers = [
            *_drawn(points, x, y, look),
            *_drawn(beside, x, y, look, is_baseline=True),
            _name(curve.method, size),
        ]
        panels.append({"layer": layers, "width": size.width, "height": size.height})
    grid = {"columns": size.columns, "spacing": SPACING, "bounds": "flush"}
    return {"title": {**heading(title), "frame": "group", "offset": 12}, "concat": panels, **grid}


def _name(method: str, size: Size) -> Spec:
    """Return the name above a panel. A title would be higher where the axis has labels."""
    text = {"type": "text", "align": "left", "baseline": "bottom", "fontSize": 13, "limit": size.width}
    text |= {"color": colour("ink"), "tooltip": None}
    place = {"x": {"value": 0}, "y": {"value": -6}}
    return layer([{"name": method}], text, **place, text={"field": "name", "type": "nominal"})


def _drawn(points: Points, x: Spec, y: Spec, look: Spec, is_baseline: bool = False) -> list[Spec]:
    """Return the layers of a line. The baseline comes last; its smaller marks leave those below in sight."""
    if not points:
        return []
    tooltip = [{"field": name} for name in ("method", "learning rate", "learned", "kept", "seeds")]
    mark = {"type": "point", "filled": True, "size": 48 if is_baseline else 95, "opacity": 1}
    mark |= {"stroke": colour("paper"), "strokeWidth": 1}
    place = {"x": x, "y": y, "color": look["color"]}
    order = {"field": "order", "sort": "descending"}
    upright = place | {"y": y | {"field": "low"}, "y2": {"field": "high"}}
    whiskers = layer(points, {"type": "rule", "opacity": 0.4, "clip": True, "aria": False}, **upright)
    return [
        *([] if is_baseline else [whiskers]),
        layer(points, {"type": "line", "strokeWidth": 2}, **place, order=order),
        layer(points, mark, **place, shape=look["shape"], tooltip=tooltip),
    ]


def _ends(values: Iterable[float]) -> tuple[float, float]:
    """Return the ends of an axis with room for values, multiples of the least of `STEPS`."""
    found = list(values)
    most = round(1 / STEPS[0])
    low = max(math.floor((min(found) - ROOM) * most), 0)
    high = min(math.ceil((max(found) + ROOM) * most), most)
    least = round(LEAST_SPAN * most)
    high = min(max(high, low + least), most)
    return min(low, high - least) / most, high / most


def _position(name: str, title: str, ends: tuple[float, float], is_named: bool) -> Spec:
    """Return the encoding of an axis. The last label across is left out: it would touch the next panel's."""
    low, high = ends
    step = next((one for one in STEPS if (high - low) / one <= PARTS + 1e-9), STEPS[-1])
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [round(number * step, 9) for number in range(first, last + 1)]
    if name == "x" and values[-1] > high - ROOM:
        values.pop()
    marks = {"values": values, "format": ".2~f", "labelFlush": False}
    marks |= {} if is_named else {"labels": False, "ticks": False}
    scale = {"domain": [low, high], "nice": False, "zero": False}
    return axis(name, title if is_named else "", axis=marks, scale=scale)
