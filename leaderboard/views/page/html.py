"""The page as HTML, and its pictures as SVG. The same table gives the same bytes."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import vl_convert
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from clbench.base.text import counted
from clbench.records.paths import parts_of
from clbench.spec.identifiers import folder_name

from ...board.overall import overall
from ...board.rows import Row, Table
from ...board.tiers import TIERS
from ..format import format_interval, number_text, title_of
from .charts import FONT, NARROW, PALETTE, SERIES, SHAPES, WIDE, along_a_run, decoders, in_theme, plane
from .frontier import NARROW as NARROW_FRONTIER
from .frontier import WIDE as WIDE_FRONTIER
from .frontier import frontier
from .plot import VEGA_LITE, on_paper
from .view import SHADES, ScenarioView, columns, grouped, number, scenarios

FOLDER = Path(__file__).parent
"""Folder of the templates, the style and the script."""

GROUPS = {"retained": "old skills to keep", "target": "new tasks", "held out": "never trained"}
"""Titles of the groups of tasks."""

TIER_RULES = (
    "Only the submitter has checked the runs.",
    "The metrics were recomputed from the episodes.",
    "Some of the episodes were replayed.",
    "The whole runs were repeated.",
)
"""How the rows of each tier were verified."""

CIVIDIS = (
    "#00204d",
    "#00336f",
    "#39486b",
    "#575c6d",
    "#707173",
    "#8a8779",
    "#a69d75",
    "#c4b56c",
    "#e4cf5b",
    "#ffea46",
)
"""Colours of a success rate from 0 to 1: Nuñez et al. 2018, doi 10.1371/journal.pone.0199239. They look the
same to colour-blind readers and rise in lightness, so that numbers on them are legible in both themes."""


def page(table: Table) -> str:
    """Return the page."""
    views = scenarios(table)
    scripts = [_library(), _source("page.js")]
    style = _source("style.css") + _colours()
    averages = overall(table.rows)
    return (
        _templates()
        .get_template("page.html")
        .render(
            policy=_policy(scripts, style),
            style=Markup(style),
            scripts=[Markup(script) for script in scripts],
            data=Markup(_embedded(_data(views))),
            scenarios=views,
            overall=grouped(averages, [row.division for row in averages]),
            overall_columns=columns(averages),
            not_shown=table.not_shown,
        )
    )


def pictures(table: Table) -> dict[str, str]:
    """Return the pictures by file name, each light and dark.

    They are the plane of the scenario with the most methods, and the frontier of each scenario that has one.
    """
    by_scenario: dict[str, list[Row]] = {}
    for row in table.rows:
        by_scenario.setdefault(row.scenario, []).append(row)
    rows = max(by_scenario.values(), key=len, default=[])
    specs = {"pareto": plane(rows, WIDE, font=FONT)}
    for scenario, curves in table.frontiers.items():
        specs[f"frontier-{folder_name(scenario)}"] = frontier(curves, WIDE_FRONTIER, FONT)
    found = {}
    for name, spec in specs.items():
        svg = on_paper(spec).svg() + "\n"
        found[f"{name}.svg"] = in_theme(svg, dark=False)
        found[f"{name}-dark.svg"] = in_theme(svg, dark=True)
    return found


@cache
def _templates() -> Environment:
    """Return the templates, which escape all values."""
    templates = Environment(
        loader=FileSystemLoader(FOLDER / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.globals.update(
        shapes=SHAPES,
        group_titles=GROUPS,
        tiers=TIERS,
        tier_rules=TIER_RULES,
        title_of=title_of,
        policy_of=lambda place: parts_of(place)[1],
        counted=counted,
        format_interval=format_interval,
        number_text=number_text,
        number_of=number,
        shade_of_rank=_shade_of_rank,
    )
    return templates


def _shade_of_rank(rank: int, count: int) -> int:
    """Return the shade of a rank, from success 1's for the first of `count` to success 0's for the last."""
    return SHADES - (rank - 1) * SHADES // max(count - 1, 1)


@cache
def _library() -> str:
    """Return the library that draws the charts; bundling it takes seconds."""
    return vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", VEGA_LITE)


def _source(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


def _policy(scripts: Sequence[str], style: str) -> str:
    """Return a content security policy that allows only these scripts and this style."""
    sources = " ".join(map(_hash, scripts))
    others = "default-src 'none'; base-uri 'none'; form-action 'none'"
    return f"{others}; script-src {sources}; style-src {_hash(style)}"


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _colours() -> str:
    """Return the colours of both themes and of the shades."""
    names = (f"--{name}:light-dark({light},{dark})" for name, (light, dark) in PALETTE.items())
    shades = (f".s{number}{{{_shade(number / SHADES)}}}" for number in range(SHADES + 1))
    return f":root{{{';'.join(names)}}}\n" + "\n".join(shades) + "\n"


def _shade(share: float) -> str:
    """Return the colours of a cell, with black or white text, whichever is more legible."""
    place = min(share * (len(CIVIDIS) - 1), len(CIVIDIS) - 1.000001)
    low, high = (_rgb(CIVIDIS[int(place) + step]) for step in (0, 1))
    mixed = [round(a + (b - a) * (place % 1)) for a, b in zip(low, high, strict=True)]
    linear = [(c / 255 / 12.92) if c <= 10 else ((c / 255 + 0.055) / 1.055) ** 2.4 for c in mixed]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    ink = "#000" if (luminance + 0.05) ** 2 > 1.05 * 0.05 else "#fff"
    return f"background:#{bytes(mixed).hex()};color:{ink}"


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:]))


def _data(views: Sequence[ScenarioView]) -> dict[str, Any]:
    """Return the data of the charts."""
    return {
        "rows": {view.anchor: {**view.data, "scenario": one.id} for one in views for view in one.rows},
        "scenarios": {one.id: _scenario_data(one) for one in views},
        "series": SERIES,
    }


def _scenario_data(one: ScenarioView) -> dict[str, Any]:
    rows = [view.row for view in one.rows]
    anchors = {view.row.method: view.anchor for view in one.rows}
    extra = {}
    if one.frontier:
        extra["wide_frontier"] = frontier(one.frontier, WIDE_FRONTIER)
        extra["narrow_frontier"] = frontier(one.frontier, NARROW_FRONTIER)
    if one.decoding:
        extra["wide_decoders"] = decoders(one.decoding, 260)
        extra["narrow_decoders"] = decoders(one.decoding, 90)
    names = one.tasks["target"]
    titles = names if one.balanced else [f"{number} {name}" for number, name in enumerate(names, 1)]
    steps = (1,) if one.to_criterion else one.steps
    return {
        **extra,
        "to_criterion": one.to_criterion,
        "metrics": [[title_of(metric.name), metric.description, metric.missing] for metric in one.others],
        "sft": anchors.get("sft"),
        "steps": steps,
        "targets": one.tasks["target"],
        "run": along_a_run(titles, None if one.to_criterion else one.steps[-1]),
        "wide": plane(rows, WIDE, anchors),
        "narrow": plane(rows, NARROW, anchors),
    }


def _embedded(values: Any) -> str:
    """Return JSON that cannot close its script element, whatever a stranger wrote."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
