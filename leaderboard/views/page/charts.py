"""The charts as Vega-Lite: the plane of retention and adaptation, and the curves of a run.

Colours are names of `PALETTE`, written as CSS variables, so that a chart follows the theme of the page
without a new drawing. In a picture, the colours of one theme replace them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ...board.summary import DIVISIONS, RowSummary
from ...policies.decoders import Decoding
from ..format import format_interval
from .labels import LONGEST, Mark, place

PALETTE: Mapping[str, tuple[str, str]] = {
    "paper": ("#ffffff", "#14171b"),
    "raised": ("#f5f7f9", "#1c2127"),
    "ink": ("#1a1f26", "#e7eaee"),
    "muted": ("#566170", "#a3adb9"),
    "line": ("#d9dfe6", "#343b45"),
    "edge": ("#8b96a3", "#6d7885"),
    "accent": ("#0a58a8", "#7fb8f5"),
    "mark-0": ("#0072b2", "#56b4e9"),
    "mark-1": ("#d55e00", "#e69f00"),
    "mark-2": ("#00805d", "#2bc49a"),
    "mark-3": ("#a0527f", "#cc79a7"),
    "mark-4": ("#8a6d00", "#d9b92e"),
    "mark-5": ("#6b7480", "#9aa4b0"),
}
"""Colours in the light and in the dark theme. Marks have the colours of Okabe and Ito, which colour-blind
readers can distinguish, or similar ones where the contrast to the paper was below 3."""

SHAPES = ("circle", "square", "triangle-up", "cross", "triangle-down", "diamond")
"""Shape of the marks of each of `DIVISIONS`: colour is never the only sign."""

FONT = "Liberation Sans, Arial, Helvetica, sans-serif"
"""Fonts of pictures: the converter includes the first, so that texts have the same width on every machine."""

SYSTEM_FONT = "system-ui, sans-serif"
"""Font of the page."""

Spec = dict[str, Any]
"""A specification of Vega-Lite."""


def colour(name: str) -> str:
    """Return the CSS variable of a colour of `PALETTE`."""
    return f"var(--{name})"


def in_theme(svg: str, dark: bool) -> str:
    """Return a picture with the colours of one theme instead of their names."""
    for name, colours in PALETTE.items():
        svg = svg.replace(colour(name), colours[dark])
    return svg


def _config(font: str) -> Spec:
    return {
        "font": font,
        "background": None,
        "axis": {
            "labelColor": colour("muted"),
            "titleColor": colour("ink"),
            "titleFontWeight": "normal",
            "titleFontSize": 12,
            "labelFontSize": 11,
            "titlePadding": 8,
            "gridColor": colour("line"),
            "domainColor": colour("line"),
            "tickColor": colour("line"),
        },
        "legend": {
            "labelColor": colour("ink"),
            "labelFontSize": 12,
            "orient": "top",
            "title": None,
            "symbolSize": 90,
            "symbolOpacity": 1,
        },
        "view": {"stroke": None},
    }


def specification(font: str, **parts: Any) -> Spec:
    """Return a chart of `parts`, for example of layers, the lowest first."""
    schema = "https://vega.github.io/schema/vega-lite/v6.json"
    return {"$schema": schema, "config": _config(font), **parts}


def heading(text: str) -> Spec:
    """Return the title of a chart."""
    return {"text": text, "anchor": "start", "color": colour("ink"), "fontSize": 13}


def axis(name: str, title: str, **rest: Any) -> Spec:
    """Return the encoding of a position on an axis, from 0 to 1 unless `rest` changes it."""
    marks = {"values": [0, 0.25, 0.5, 0.75, 1], "format": ".2~f"}
    return {"field": name, "type": "quantitative", "title": title, "axis": marks, **rest}


def rounded(value: float | None) -> float | None:
    """Return a number for a chart. Rounded twice, so that the last bit of a sum does not show."""
    known = finite(value)
    return None if known is None else round(round(known, 9), 3) + 0.0


def finite(value: float | None) -> float | None:
    """Return a number, None where it is missing."""
    return float(value) if value is not None and math.isfinite(value) else None


# ---- the plane ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Size:
    """Size of the plane in pixels, without axes, legend and the labels on the right."""

    width: int
    height: int
    columns: int
    """Number of columns of the legend."""
    titles: tuple[str, str]
    """Titles of the axes."""


WIDE = Size(
    620,
    400,
    4,
    (
        "adaptation: success on each target right after learning it",
        "retention: success on the old skills at the end",
    ),
)
"""Size on a desktop."""

NARROW = Size(205, 320, 2, ("adaptation", "retention"))
"""Size on a phone."""

LOW, HIGH = -0.02, 1.02
"""Ends of both axes, so that a mark at 0 or 1 is not cut off."""


def plane(
    rows: Sequence[RowSummary], size: Size, anchors: Mapping[str, str] | None = None, font: str = SYSTEM_FONT
) -> Spec:
    """Return the plane of retention and adaptation with the Pareto front of each division.

    Args:
        rows: Rows of one scenario.
        size: Size of the plane.
        anchors: Anchors that the marks link to, by method.
        font: Font of all texts.
    """
    points = [_point(row, (anchors or {}).get(row.method, "")) for row in rows if _is_in_plane(row)]
    fronts = {
        division: _front([one for one in points if one["division"] == division])
        for division in DIVISIONS[:-1]
    }
    corners = [
        {"x": x, "y": y, "division": division, "order": order}
        for division, front in fronts.items()
        for order, (x, y) in enumerate(front)
    ]
    x, y = (
        axis(name, title, scale={"domain": [LOW, HIGH]})
        for name, title in zip("xy", size.titles, strict=True)
    )
    found = {one["division"] for one in points}
    marks = [(name, colour(f"mark-{n}"), SHAPES[n]) for n, name in enumerate(DIVISIONS) if name in found]
    names, hues, shapes = ([entry[part] for entry in marks] for part in range(3))
    hue = {"field": "division", "type": "nominal", "scale": {"domain": names, "range": hues}}
    hue |= {"legend": {"columns": size.columns}}
    shape = hue | {"scale": {"domain": names, "range": shapes}}
    across = {"x": x | {"field": "x_low"}, "x2": {"field": "x_high"}, "y": y, "color": hue}
    upright = {"x": x, "y": y | {"field": "y_low"}, "y2": {"field": "y_high"}, "color": hue}
    tooltip = [{"field": name} for name in ("method", "division", "adaptation", "retention")]
    mark = {
        "type": "point",
        "filled": True,
        "size": 85,
        "opacity": 1,
        "stroke": colour("paper"),
        "strokeWidth": 1,
    }
    front = {"type": "line", "strokeWidth": 1.5, "strokeDash": [4, 3], "opacity": 0.8}
    layers = [
        layer(corners, front, x=x, y=y, color=hue, order={"field": "order"}),
        layer(points, {"type": "rule", "opacity": 0.4}, **across),
        layer(points, {"type": "rule", "opacity": 0.4}, **upright),
        *_labels(points, {y for corners in fronts.values() for _, y in corners}, size),
        layer(points, mark, x=x, y=y, color=hue, shape=shape, tooltip=tooltip),
    ]
    return specification(font, layer=layers, width=size.width, height=size.height)


def layer(values: Sequence[Mapping[str, Any]], mark: Spec, **encoding: Any) -> Spec:
    """Return a layer with its own data."""
    return {"data": {"values": list(values)}, "mark": mark, "encoding": encoding}


def _is_in_plane(row: RowSummary) -> bool:
    return row.estimates["adaptation"].value is not None and row.estimates["retention"].value is not None


def _point(row: RowSummary, anchor: str) -> dict[str, Any]:
    point: dict[str, Any] = {"method": row.method, "division": row.division, "anchor": anchor}
    for side, name in (("x", "adaptation"), ("y", "retention")):
        one = row.estimates[name]
        point[side] = rounded(one.value)
        point[f"{side}_low"] = rounded(one.value if one.low is None else one.low)
        point[f"{side}_high"] = rounded(one.value if one.high is None else one.high)
        point[name] = format_interval(one)
    return point


def _front(points: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """Return the corners of the Pareto front: a point below and left of it is worse in both values."""
    best: list[tuple[float, float]] = []
    for x, y in sorted(((one["x"], one["y"]) for one in points), reverse=True):
        if not best or y > best[-1][1]:
            best.append((x, y))
    if not best:
        return []
    corners = [(best[0][0], 0.0)]
    for (x, y), (next_x, _) in zip(best, [*best[1:], (0.0, 0.0)], strict=True):
        corners += [(x, y), (next_x, y)]
    return corners[::-1]


def _labels(points: Sequence[Mapping[str, Any]], lines: Iterable[float], size: Size) -> list[Spec]:
    """Return the layers of the labels and of the lines to the labels on the right."""

    def across(value: float) -> float:
        return (value - LOW) / (HIGH - LOW) * size.width

    def down(value: float) -> float:
        return (HIGH - value) / (HIGH - LOW) * size.height

    marks = [
        Mark(
            str(one["method"]),
            across(one["x"]),
            down(one["y"]),
            *(across(one[name]) for name in ("x_low", "x_high")),
            *(down(one[name]) for name in ("y_high", "y_low")),
        )
        for one in points
    ]
    labels = place(marks, [down(line) for line in lines], size.width, size.height)
    leaders = [
        {"x": _pixel(one.mark.x), "y": _pixel(one.mark.y), "to": _pixel(one.y)} for one in labels if one.mark
    ]
    # In pixels, since some labels are outside the plane.
    x, y = ({"field": name, "type": "quantitative", "scale": None, "axis": None} for name in "xy")
    rule = {"type": "rule", "color": colour("line")}
    layers = [layer(leaders, rule, x=x, y=y, x2={"value": size.width + 10}, y2={"field": "to"})]
    for align in ("left", "right"):
        texts = [
            {"method": one.name, "x": _pixel(one.x), "y": _pixel(one.y)}
            for one in labels
            if one.align == align
        ]
        mark = {"type": "text", "align": align, "baseline": "middle", "fontSize": 11, "limit": LONGEST}
        text = {"field": "method", "type": "nominal"}
        layers.append(layer(texts, mark | {"color": colour("ink")}, x=x, y=y, text=text))
    return layers


def _pixel(value: float) -> float:
    return round(value, 1) + 0.0


# ---- along a run -------------------------------------------------------------------------------------------

SERIES = ("old skills", "target of the stage", "old skills under sft")
"""Lines in the chart of a run; the last one is for comparison."""


def along_a_run(
    targets: Sequence[str], steps: int | None, width: int | str = "container", font: str = SYSTEM_FONT
) -> Spec:
    """Return the chart of a run without its points; `with_points` adds them, and the page for each row.

    The points are the named data `points`: `x` (steps since the first stage, or stages), `y` with `low` and
    `high`, one of `SERIES`, and the `stage`, which separates the curve of a target from the next; the
    parameter `shown` lists the series that have points.

    Args:
        targets: Titles of the stages.
        steps: Optimiser steps of a stage; None if a stage ends when its target is learned, and is one long.
        width: Width in pixels, or "container" for that of the place on the page.
        font: Font of all texts.
    """
    length = steps or 1
    stages = [
        {"begin": number * length, "end": (number + 1) * length, "name": name}
        for number, name in enumerate(targets)
    ]
    count = max(len(targets), 1)
    x = axis(
        "x",
        "optimiser steps, stage after stage" if steps else "stages, each until its target is learned",
        scale={"domain": [0, count * length], "nice": False},
        axis={"values": [number * length for number in range(count + 1)], "grid": False},
    )
    y = axis("y", "success", scale={"domain": [0, 1]})
    hues = [colour(f"mark-{number}") for number in (0, 1, 5)]
    series = {"field": "series", "type": "nominal", "scale": {"domain": list(SERIES), "range": hues}}
    series |= {"legend": {"columns": {"expr": "width < 400 ? 1 : 3"}, "values": {"expr": "shown"}}}
    beside = {"test": {"field": "series", "equal": SERIES[-1]}, "value": [3, 3]}
    dashes = {"condition": beside, "value": [1, 0]}
    name = {"type": "text", "align": "left", "baseline": "bottom", "dx": 3, "dy": -4, "fontSize": 11}
    name |= {"color": colour("muted"), "limit": {"expr": f"width / {count} - 5"}}
    begin = x | {"field": "begin"}
    lines: Spec = {"x": x, "y": y, "color": series, "detail": {"field": "stage"}}
    area = lines | {"y": y | {"field": "low"}, "y2": {"field": "high"}}
    tooltip = [{"field": field} for field in ("series", "at", "success")]
    layers = [
        layer(stages[1::2], {"type": "rect", "color": colour("raised")}, x=begin, x2={"field": "end"}),
        layer(stages, name, x=begin, y={"value": 0}, text={"field": "name", "type": "nominal"}),
        _points({"type": "area", "opacity": 0.15}, **area),
        _points({"type": "line", "strokeWidth": 2}, **lines, strokeDash=dashes),
        _points({"type": "point", "filled": True, "size": 30, "opacity": 1}, **lines, tooltip=tooltip),
    ]
    return specification(font, layer=layers, width=width, height=230)


def with_points(chart: Spec, points: Sequence[Mapping[str, Any]]) -> Spec:
    """Return the chart of a run with its points."""
    present = {point["series"] for point in points}
    shown = [series for series in SERIES if series in present]
    return {**chart, "params": [{"name": "shown", "value": shown}], "datasets": {"points": list(points)}}


def _points(mark: Spec, **encoding: Any) -> Spec:
    return {"data": {"name": "points"}, "mark": mark, "encoding": encoding}


# ---- decoders ----------------------------------------------------------------------------------------------


def decoders(found: Decoding, width: int, font: str = SYSTEM_FONT) -> Spec:
    """Return two charts of the decoders side by side: speed, and success beyond the first decoder's.

    Args:
        found: Results of the benchmark.
        width: Width of each chart, in pixels.
        font: Font of all texts.
    """
    panels = [("speed_up", "speed-up", 1.0), ("difference", "difference of success", 0.0)]
    return specification(
        font,
        hconcat=[
            _compared(found, name, title, neutral, width, labels=not number)
            for number, (name, title, neutral) in enumerate(panels)
        ],
    )


def _compared(found: Decoding, name: str, title: str, neutral: float, width: int, labels: bool) -> Spec:
    points = [
        {
            "decoder": one.name,
            title: format_interval(estimate := getattr(one, name)),
            "x": rounded(estimate.value),
            "low": rounded(estimate.low),
            "high": rounded(estimate.high),
        }
        for one in found.decoders
    ]
    names = {"labelLimit": 260, "title": None, "labels": labels, "ticks": False, "domain": False}
    y = {"field": "decoder", "type": "nominal", "sort": None, "axis": names}
    x = {"field": "x", "type": "quantitative", "title": title, "scale": {"zero": False}}
    x |= {"axis": {"tickCount": 5}}
    tooltip = [{"field": field} for field in ("decoder", title)]
    line = {"type": "rule", "strokeDash": [3, 3], "color": colour("muted")}
    whisker = {"type": "rule", "strokeWidth": 2, "color": colour("mark-0")}
    mark = {"type": "point", "filled": True, "size": 70, "opacity": 1, "color": colour("mark-0")}
    layers = [
        layer([{"x": neutral}], line, x=x),
        layer(points, whisker, y=y, x=x | {"field": "low"}, x2={"field": "high"}),
        layer(points, mark, y=y, x=x, tooltip=tooltip),
    ]
    return {"layer": layers, "width": width, "height": {"step": 22}}
