"""The picture of the findings: the gain of every method over tuned fine-tuning, with its interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..board.rows import Row
from ..board.summary import DIVISIONS
from ..views.page.charts.vega import FONT, Spec, axis, colour, heading, layer, rounded, specification

WIDTH = 520
"""Width of the plot in pixels."""

PADDING = {"left": 24, "right": 8, "top": 5, "bottom": 5}
"""Pixels around the picture: browsers draw the names of methods wider than the fonts that measure them."""

ROW_HEIGHT = 18
"""Height of a method's line in pixels."""


def gains_chart(boards: Mapping[str, Sequence[Row]]) -> Spec:
    """Return the chart: one panel for each scenario, one line for each method, the largest gain on top."""
    panels = [_panel(name, rows) for name, rows in boards.items() if rows]
    return specification(FONT, padding=PADDING, vconcat=panels)


def _panel(name: str, rows: Sequence[Row]) -> Spec:
    values = [
        {
            "method": row.method,
            "division": row.division,
            **{end: rounded(getattr(row.estimates["gain"], end)) for end in ("low", "value", "high")},
        }
        for row in rows
    ]
    divisions = [division for division in DIVISIONS if any(row.division == division for row in rows)]
    method = {
        "field": "method",
        "type": "nominal",
        "sort": [row.method for row in rows],
        "title": None,
        "axis": {"labelColor": colour("ink")},
    }
    hue = {
        "field": "division",
        "type": "nominal",
        "legend": {"columnPadding": 28},
        "scale": {
            "domain": divisions,
            "range": [colour(f"mark-{DIVISIONS.index(division)}") for division in divisions],
        },
    }
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
                "encoding": {"y": method, "x": gain, "color": hue},
            },
        ],
    }
