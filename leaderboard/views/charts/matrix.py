"""The success matrix as Vega-Lite: stages from top to bottom, tasks from left to right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from clbench.scoring.layout import Array

from .vega import FONT, Spec, colour, heading, rounded, specification

CELL = {"step": 56}, {"step": 30}
"""Width and height of a cell in pixels."""


def matrix(stages: Sequence[str], groups: Mapping[str, Sequence[str]], rates: Array, title: str) -> Spec:
    """Return the chart of a success matrix; a frame marks the task that each stage learned.

    Args:
        stages: Names of the rows, the pretrained policy first.
        groups: Names of the columns by group, in their order; the groups are those of a scenario.
        rates: Success rates, (stages, tasks), NaN where missing.
        title: Title of the chart.
    """
    tasks = [(group, name) for group, names in groups.items() for name in names]
    first = len(groups["retained"])
    cells = [
        {
            "after": after,
            "group": group,
            "task": task,
            "success": rounded(rates[stage, column]),
            "learned": stage > 0 and column == first + stage - 1,
        }
        for stage, after in enumerate(stages)
        for column, (group, task) in enumerate(tasks)
    ]
    column: Spec = {"field": "group", "sort": [*groups], "title": None, "spacing": 12}
    column["header"] = {"labelColor": colour("ink"), "labelFontSize": 12}
    return specification(
        FONT,
        title=heading(title),
        data={"values": cells},
        facet={"column": column},
        resolve={"scale": {"x": "independent"}},
        spec={"width": CELL[0], "height": CELL[1], "layer": _layers(list(stages), tasks)},
    )


def _layers(stages: list[str], tasks: Sequence[tuple[str, str]]) -> list[Spec]:
    names = list(dict.fromkeys(task for _, task in tasks))
    x: Spec = {"field": "task", "type": "nominal", "sort": names, "title": None}
    y: Spec = {"field": "after", "type": "nominal", "sort": stages, "title": None}
    x["axis"] = {"orient": "top", "labelAngle": -35, "domain": False, "ticks": False}
    y["axis"] = {"domain": False, "ticks": False}
    shade: Spec = {"field": "success", "type": "quantitative", "legend": None}
    shade["scale"] = {"scheme": "cividis", "domain": [0, 1]}
    white = {"test": "datum.success !== null && datum.success < 0.5", "value": "#fff"}
    text = {"field": "success", "type": "quantitative", "format": ".2f"}
    here = {"x": x, "y": y}
    return [
        {"mark": {"type": "rect"}, "encoding": {**here, "color": shade}},
        {
            "transform": [{"filter": "datum.learned"}],
            "mark": {"type": "rect", "filled": False, "stroke": colour("mark-1"), "strokeWidth": 3},
            "encoding": here,
        },
        {
            "transform": [{"filter": "isValid(datum.success)"}],
            "mark": {"type": "text", "fontSize": 12},
            "encoding": {**here, "text": text, "color": {"condition": white, "value": "#000"}},
        },
    ]
