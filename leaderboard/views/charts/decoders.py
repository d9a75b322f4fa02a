"""The decoders of a policy side by side: speed, and success."""

from __future__ import annotations

from ...policies.decoders import Decoding
from ..format import format_interval
from .vega import SYSTEM_FONT, Spec, colour, layer, rounded, specification


def decoders(found: Decoding, narrow: bool) -> Spec:
    """Return two charts of the decoders: speed, and success beyond the first decoder's.

    Args:
        found: Results of the benchmark.
        narrow: Whether it is for a phone: the charts stand one below the other, and names have several lines.
    """
    panels = (("speed_up", "speed-up", 1.0), ("difference", "difference of success", 0.0))
    if narrow:
        lines = {"labelExpr": "split(datum.label, ', ')", "labelLimit": 190}
        return specification(SYSTEM_FONT, vconcat=[_compared(found, *one, 140, 50, lines) for one in panels])
    speed, success = panels
    beside = [_compared(found, *speed, 220, 22, {"labelLimit": 340})]
    beside += [_compared(found, *success, 220, 22, {"labels": False})]
    return specification(SYSTEM_FONT, hconcat=beside)


def _compared(
    found: Decoding, name: str, title: str, neutral: float, width: int, step: int, labels: Spec
) -> Spec:
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
    names = {"title": None, "ticks": False, "domain": False, **labels}
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
    return {"layer": layers, "width": width, "height": {"step": step}}
