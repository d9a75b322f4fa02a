"""What all charts share: colours, fonts and the parts of a Vega-Lite specification.

Colours are names of `PALETTE`, written as CSS variables, so that a chart follows the theme of the page
without a new drawing. In a picture, the colours of one theme replace them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

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

LETTER = 6
"""Mean width of a letter of a subtitle in pixels."""

Spec = dict[str, Any]
"""A Vega-Lite specification."""


@dataclass(frozen=True)
class Size:
    """Size of a chart or panel in pixels, without axes, legend and labels on the right."""

    width: int
    height: int
    columns: int
    """Number of columns of the legend, or of panels."""


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
            "titleFontSize": 13,
            "labelFontSize": 12,
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


def subtitle(texts: Iterable[str], width: int) -> Spec:
    """Return the part of a title that adds texts below it, in lines that fit a width in pixels."""
    lines = [line for text in texts for line in wrap(text, width // LETTER)]
    return {"subtitle": lines, "subtitleColor": colour("muted"), "subtitleFontSize": 12}


def axis(name: str, title: str, **rest: Any) -> Spec:
    """Return the encoding of a position on an axis, from 0 to 1 unless `rest` changes it."""
    marks = {"values": [0, 0.25, 0.5, 0.75, 1], "format": ".2~f"}
    return {"field": name, "type": "quantitative", "title": title, "axis": marks, **rest}


def rounded(value: float | None) -> float | None:
    """Return a number for a chart. It is rounded twice, to hide the last bit of a sum."""
    known = finite(value)
    return None if known is None else round(round(known, 9), 3) + 0.0


def finite(value: float | None) -> float | None:
    """Return a number, None where it is missing."""
    return float(value) if value is not None and math.isfinite(value) else None


def layer(values: Sequence[Mapping[str, Any]], mark: Spec, **encoding: Any) -> Spec:
    """Return a layer with its own data."""
    return {"data": {"values": list(values)}, "mark": mark, "encoding": encoding}
