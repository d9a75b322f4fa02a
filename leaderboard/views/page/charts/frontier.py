"""The frontier as Vega-Lite: what methods learn and keep along the ladder of learning rates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from ....board.frontier import Curve, Rung
from ...format import format_interval, number_text
from .vega import SYSTEM_FONT, Size, Spec, axis, colour, layer, rounded, specification

HUES, DASHES = ("mark-0", "mark-1", "mark-2", "mark-3"), ([1, 0], [6, 3], [2, 2], [8, 3, 2, 3])
"""Colours and dashes of the lines. Together they distinguish 16 methods, neighbours by both."""

SHAPES = ("circle", "square", "triangle-up", "diamond", "cross", "triangle-down")
"""Shapes of the learning rates, the largest first."""

HIGHEST_LOW = 0.8
"""Highest low end of an axis, so that differences of a few episodes do not look large."""

BESIDE = "mark-5"
"""Colour of plain fine-tuning, which lies under all others."""


WIDE = Size(620, 400, 4)
"""Size on a desktop."""

NARROW = Size(240, 320, 2)
"""Size on a phone."""

LONG_TITLES = (
    "learned: success on each target right after learning it",
    "kept: success at the end on all that was known before the last target",
)
"""Titles of the axes where there is room."""


def frontier(curves: Sequence[Curve], size: Size, font: str = SYSTEM_FONT) -> Spec:
    """Return the chart of the curves of one scenario: a line for each method, a mark for each learning rate.

    Args:
        curves: Curves, plain fine-tuning first.
        size: Size of the chart.
        font: Font of all texts.
    """
    points = [_point(curve, rung) for curve in curves for rung in curve.rungs if _is_known(rung)]
    names = [curve.method for curve in curves]
    factors = [_text(factor) for factor in sorted({one["order"] for one in points}, reverse=True)]
    titles = LONG_TITLES if size.width > NARROW.width else ("learned", "kept")
    x, y = (_position(name, points, title) for name, title in zip("xy", titles, strict=True))
    legend = {"columns": size.columns, "symbolType": "stroke", "symbolStrokeWidth": 3, "symbolSize": 250}
    of_method = {"field": "method", "type": "nominal", "legend": legend}
    hue = of_method | {"scale": {"domain": names, "range": [colour(name) for name in _hues(curves)]}}
    dash = of_method | {"scale": {"domain": names, "range": _dashes(curves)}}
    shape = {
        "field": "learning rate",
        "type": "nominal",
        "scale": {"domain": factors, "range": [SHAPES[n % len(SHAPES)] for n in range(len(factors))]},
        "legend": {"title": "learning rate", "titleColor": colour("ink"), "columns": len(factors)}
        | {"symbolFillColor": colour("muted"), "symbolStrokeColor": colour("muted")},
    }
    tooltip = [{"field": name} for name in ("method", "learning rate", "learned", "kept", "seeds")]
    mark = {"type": "point", "filled": True, "size": 70, "opacity": 1}
    mark |= {"stroke": colour("paper"), "strokeWidth": 1}
    line = {"x": x, "y": y, "color": hue, "strokeDash": dash}
    line["order"] = {"field": "order", "sort": "descending"}
    baselines = {curve.method for curve in curves if curve.is_baseline}
    under = [one for one in points if one["method"] in baselines]
    over = [one for one in points if one["method"] not in baselines]
    layers = [
        layer(under, {"type": "line", "strokeWidth": 8, "opacity": 0.6}, **line),
        layer(over, {"type": "line", "strokeWidth": 1.75}, **line),
        layer(points, mark, x=x, y=y, color=hue, shape=shape, tooltip=tooltip),
    ]
    return specification(font, layer=layers, width=size.width, height=size.height)


def _is_known(rung: Rung) -> bool:
    return rung.learned.value is not None and rung.kept.value is not None


def _point(curve: Curve, rung: Rung) -> dict[str, Any]:
    return {
        "method": curve.method,
        "learning rate": _text(rung.factor),
        "order": rung.factor,
        "x": rounded(rung.learned.value),
        "y": rounded(rung.kept.value),
        "learned": format_interval(rung.learned),
        "kept": format_interval(rung.kept),
        "seeds": len(rung.seeds),
    }


def _text(factor: float) -> str:
    return f"\N{MULTIPLICATION SIGN} {number_text(factor, 'g')}"


def _position(name: str, points: Iterable[dict[str, Any]], title: str) -> Spec:
    """Return the encoding of an axis from the tenth below the least value, or `HIGHEST_LOW`, to 1."""
    least = min((one[name] for one in points), default=0.0)
    low = min(max(math.floor(least * 10 - 0.2) / 10, 0.0), HIGHEST_LOW)
    marks = {"format": ".2~f", "tickCount": 6}
    return axis(name, title, axis=marks, scale={"domain": [low, 1.02], "nice": False, "zero": False})


def _hues(curves: Iterable[Curve]) -> list[str]:
    """Return the colours of the curves: grey for plain fine-tuning, the others in turn."""
    return [BESIDE if curve.is_baseline else HUES[n % len(HUES)] for curve, n in _numbered(curves)]


def _dashes(curves: Iterable[Curve]) -> list[list[int]]:
    """Return the dashes of the curves: the next ones when all colours are used."""
    return [DASHES[n // len(HUES) % len(DASHES)] for _, n in _numbered(curves)]


def _numbered(curves: Iterable[Curve]) -> list[tuple[Curve, int]]:
    """Return the curves, each with the number of curves before it besides plain fine-tuning."""
    found: list[tuple[Curve, int]] = []
    for curve in curves:
        found.append((curve, sum(not other.is_baseline for other, _ in found)))
    return found
