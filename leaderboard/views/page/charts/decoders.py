"""The decoders of a policy side by side: speed, and success."""

from __future__ import annotations

from ....policies.decoders import Decoding
from ...format import format_interval
from .vega import SYSTEM_FONT, Spec, colour, layer, rounded, specification


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
