"""The curves of a run: success on the old skills and on the target of each stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .vega import SYSTEM_FONT, Spec, axis, colour, layer, specification

SERIES = ("old skills", "target of the stage", "old skills under sft")
"""Lines in the chart of a run; the last one is for comparison."""


def along_a_run(
    targets: Sequence[str],
    steps: int | None,
    width: int | str = "container",
    font: str = SYSTEM_FONT,
    by_agent: bool = False,
) -> Spec:
    """Return the chart of a run without its points; `with_points` adds them, and the page for each row.

    The points are the named data `points`: `x` (steps since the first stage, or stages), `y` with `low` and
    `high`, one of `SERIES`, and the `stage`, which separates the curve of a target from the next; the
    parameter `shown` lists the series that have points.

    Args:
        targets: Titles of the stages.
        steps: Optimiser steps of a stage; None if a stage ends when its target is learned, and has length 1.
        width: Width in pixels, or "container" for the width of its place on the page.
        font: Font of all texts.
        by_agent: Whether another program trained the policy of the run, for a number of steps of its own.
    """
    length = steps or 1
    stages = [
        {"begin": number * length, "end": (number + 1) * length, "name": name}
        for number, name in enumerate(targets)
    ]
    count = max(len(targets), 1)
    title = "optimiser steps, stage after stage" if steps else "stages, each until its target is learned"
    x = axis(
        "x",
        "stages, one after another" if by_agent else title,
        scale={"domain": [0, count * length], "nice": False},
        axis={"values": [number * length for number in range(count + 1)], "grid": False}
        | {"labels": not by_agent},
    )
    y = axis("y", "success", scale={"domain": [0, 1]})
    hues = [colour(f"mark-{number}") for number in (0, 1, 5)]
    series = {"field": "series", "type": "nominal", "scale": {"domain": list(SERIES), "range": hues}}
    series |= {"legend": {"columns": {"expr": "width < 400 ? 1 : 3"}, "values": {"expr": "shown"}}}
    beside = {"test": {"field": "series", "equal": SERIES[-1]}, "value": [3, 3]}
    dashes = {"condition": beside, "value": [1, 0]}
    name = {"type": "text", "align": "left", "baseline": "bottom", "dx": 3, "dy": -4, "fontSize": 12}
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
