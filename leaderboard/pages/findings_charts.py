"""The pictures of the findings: gains over tuned fine-tuning, and what smaller learning rates keep."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from clbench.scoring.intervals import Estimate

from ..board.frontier import Curve
from ..board.rows import Row
from ..board.summary import DIVISIONS
from ..views.charts.vega import FONT, SHAPES, Spec, axis, colour, heading, layer, rounded, specification

WIDTH = 520
"""Width of the plot in pixels."""

PADDING = {"left": 24, "right": 8, "top": 5, "bottom": 5}
"""Pixels around the picture: browsers draw the names of methods wider than the fonts that measure them."""

ROW_HEIGHT = 18
"""Height of a method's line in pixels."""


def gains_chart(boards: Mapping[str, Sequence[Row]]) -> Spec:
    """Return the chart: one panel for each scenario, one line for each method, the largest gain on top."""
    panels = [_panel(name, rows) for name, rows in boards.items() if rows]
    same_axis = {"scale": {"x": "shared"}}
    return specification(FONT, padding=PADDING, vconcat=panels, resolve=same_axis)


def rates_chart(ladders: Mapping[str, Sequence[Curve]]) -> Spec:
    """Return the chart: one panel for each scenario, one line for each method, one point for each rate."""
    return specification(FONT, padding=PADDING, vconcat=[_rates(*ladder) for ladder in ladders.items()])


def _panel(name: str, rows: Sequence[Row]) -> Spec:
    """Return the panel of the gains on a scenario."""
    values = [
        {
            "method": row.method,
            "division": row.division,
            **_ends(row.estimates["gain"]),
        }
        for row in rows
    ]
    divisions = [division for division in DIVISIONS if any(row.division == division for row in rows)]
    places = [DIVISIONS.index(division) for division in divisions]
    method = _names(row.method for row in rows)
    hue = {
        "field": "division",
        "type": "nominal",
        "legend": {"columnPadding": 28},
        "scale": {"domain": divisions, "range": [colour(f"mark-{place}") for place in places]},
    }
    shape = hue | {"scale": {"domain": divisions, "range": [SHAPES[place] for place in places]}}
    gain = axis(
        "value", "gain over plain fine-tuning, with 95 % interval", axis={"format": ".2~f", "tickCount": 6}
    )
    ends = {"x": {"field": "low", "type": "quantitative"}, "x2": {"field": "high"}}
    line = {"type": "rule", "color": colour("edge"), "strokeDash": [4, 3]}
    zero = layer([{"zero": 0}], line, x={"field": "zero", "type": "quantitative"})
    return {
        "title": heading(name),
        "width": WIDTH,
        "height": ROW_HEIGHT * len(rows),
        "data": {"values": values},
        "layer": [
            zero,
            {"mark": {"type": "rule", "strokeWidth": 2}, "encoding": {"y": method, "color": hue, **ends}},
            {
                "mark": {"type": "point", "filled": True, "size": 70, "opacity": 1},
                "encoding": {"y": method, "x": gain, "color": hue, "shape": shape},
            },
        ],
    }


def _ends(gain: Estimate) -> dict[str, float | None]:
    """Return a gain with the ends of its interval; one seed has none, so the ends are the gain itself."""
    names = ("low", "value", "high")
    return {end: rounded(getattr(gain, end if gain.of_seeds else "value")) for end in names}


def _rates(name: str, curves: Sequence[Curve]) -> Spec:
    """Return the panel of what the methods keep at the learning rates of a scenario."""
    values = [
        {"method": curve.method, "rate": f"{one.factor:g}", "kept": rounded(one.kept.value)}
        for curve in curves
        for one in curve.rungs
    ]
    factors = sorted({one.factor for curve in curves for one in curve.rungs}, reverse=True)
    rates = [f"{factor:g}" for factor in factors]
    method = _names(curve.method for curve in curves)
    scale = {"domain": rates, "range": [colour(f"mark-{place % 6}") for place in range(len(rates))]}
    marks = {"domain": rates, "range": [SHAPES[place % 6] for place in range(len(rates))]}
    legend = {"title": "learning rate, times the scenario's", "titleColor": colour("ink")}
    return {
        "title": heading(name),
        "width": WIDTH,
        "height": ROW_HEIGHT * len(curves),
        "data": {"values": values},
        "mark": {"type": "point", "filled": True, "size": 70, "opacity": 1},
        "encoding": {
            "y": method,
            "x": axis("kept", "kept, mean over seeds"),
            "color": {"field": "rate", "type": "nominal", "legend": legend, "scale": scale},
            "shape": {"field": "rate", "type": "nominal", "legend": legend, "scale": marks},
        },
    }


def _names(methods: Iterable[str]) -> Spec:
    """Return the encoding of the methods, each on a line of its own."""
    look = {"title": None, "axis": {"labelColor": colour("ink")}}
    return {"field": "method", "type": "nominal", "sort": list(methods), **look}
