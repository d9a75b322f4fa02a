"""The page as HTML, and its pictures as SVG. The same board gives the same bytes."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import vl_convert
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from clbench.base.text import counted, printable
from clbench.records.paths import table_parts
from clbench.spec.identifiers import built_in_methods, folder_name
from clbench.spec.references import BASELINE

from ...board.rows import Board
from ...board.summary import DIVISIONS, ELSEWHERE
from ...board.tiers import TIERS
from ...policies.compared import Comparisons
from ..charts.along import SERIES, along_a_run
from ..charts.axes import ACROSS, UP
from ..charts.decoders import decoders
from ..charts.frontier import NARROW as NARROW_FRONTIER
from ..charts.frontier import WIDE as WIDE_FRONTIER
from ..charts.frontier import frontier
from ..charts.picture import VEGA_LITE, in_both_themes
from ..charts.plane import FULL, NARROW, WIDE, Plane, plane, template
from ..charts.vega import FONT, PALETTE, SHAPES
from ..format import column_title, format_interval, number_text, table_title, title_of
from .heat import COLUMNS, heat_maps
from .numbers import MISSING
from .rows import MAIN
from .view import ScenarioView, scenarios, sorted_tables

FOLDER = Path(__file__).parent
"""Folder of the templates, the style and the script."""

REPOSITORY = "https://github.com/clbench/clbench"
"""Address of the project, as in its metadata."""

PLANES = {"full": FULL, "wide": WIDE, "narrow": NARROW}
"""Sizes of the plane by name."""

GROUPS = {"retained": "old skills to keep", "target": "new tasks", "held out": "never trained"}
"""Titles of the groups of tasks."""

TIER_RULES = (
    "At least one run was checked only by its submitter.",
    "For every run, at least the metrics were recomputed from its episodes.",
    "For every run, at least some episodes were replayed.",
    "Every run was repeated as a whole.",
)
"""How the rows of each tier were verified."""

SHADES = 20
"""Number of shades between success 0 and success 1."""

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


def page(board: Board, comparisons: Comparisons) -> str:
    """Return the page.

    Args:
        board: The board.
        comparisons: The comparisons of its rows, from `compared.by_table`.
    """
    tables = sorted_tables(board)
    views = scenarios(tables, board, comparisons)
    # only drawing waits for the library
    scripts = [_source("choices.js"), _source("page.js"), _library()]
    maps = heat_maps(tables)
    style = _source("style.css") + _colours()
    return (
        _templates()
        .get_template("page.html")
        .render(
            policy=_policy(scripts, style),
            style=Markup(style),
            scripts=[Markup(script) for script in scripts],
            data=_packed(_data(views)),
            scenarios=views,
            heat_maps=maps,
            shown_divisions={row.division_number for one in maps for row in one.rows},
            not_shown=board.not_shown,
        )
    )


def pictures(board: Board) -> dict[str, str]:
    """Return the pictures by file name, each light and dark.

    They are the plane of the scenario with the most methods, and the frontier of each scenario that has one.
    """
    rows = max(sorted_tables(board).values(), key=len, default=[])
    specs = {"pareto": plane(rows, WIDE, rows[0].scenario if rows else "")}
    for scenario, curves in board.frontiers.items():
        specs[f"frontier-{folder_name(scenario)}"] = frontier(curves, WIDE_FRONTIER, FONT)
    return {name: svg for stem, spec in specs.items() for name, svg in in_both_themes(stem, spec).items()}


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
        column_title=column_title,
        policy_of=lambda table: table_parts(table)[1],
        counted=counted,
        format_interval=format_interval,
        number_text=number_text,
        shade=lambda value: round(round(value, 9) * SHADES),
        shade_of_rank=_shade_of_rank,
        main=MAIN,
        across=ACROSS,
        up=UP,
        repository=REPOSITORY,
        method_page=_method_page,
        table_title=table_title,
        heat_columns=COLUMNS,
        divisions=list(enumerate(DIVISIONS)),
    )
    return templates


def _method_page(method: str) -> str:
    """Return the address of a method's page, empty if the method is not built in."""
    return (
        f"{REPOSITORY}/blob/main/docs/reference/methods/{method}.md" if method in built_in_methods() else ""
    )


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
    return f"{others}; img-src data:; script-src {sources}; style-src {_hash(style)}"


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
    low, high = (bytes.fromhex(CIVIDIS[int(place) + step][1:]) for step in (0, 1))
    mixed = [round(a + (b - a) * (place % 1)) for a, b in zip(low, high, strict=True)]
    linear = [(c / 255 / 12.92) if c <= 10 else ((c / 255 + 0.055) / 1.055) ** 2.4 for c in mixed]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    ink = "#000" if (luminance + 0.05) ** 2 > 1.05 * 0.05 else "#fff"
    return f"background:#{bytes(mixed).hex()};color:{ink}"


def _data(views: Sequence[ScenarioView]) -> dict[str, Any]:
    """Return what the page draws when the reader asks for it: charts, and the sections of the rows."""
    return {
        "rows": {
            view.anchor: {**view.data, "scenario": one.id, "html": _section(one, number)}
            for one in views
            for number, view in enumerate(one.rows)
        },
        "scenarios": {one.id: _scenario_data(one) for one in views},
        "series": SERIES,
        "shades": SHADES,
        "missing": MISSING,
        "planes": {name: template(size) for name, size in PLANES.items()},
    }


def _section(one: ScenarioView, number: int) -> str:
    """Return the section of a row as HTML."""
    before, after = (
        one.rows[place] if 0 <= place < len(one.rows) else None for place in (number - 1, number + 1)
    )
    section = _templates().get_template("row.html")
    return section.render(one=one, view=one.rows[number], previous=before, next=after)


def _scenario_data(one: ScenarioView) -> dict[str, Any]:
    anchors = {view.row.method: view.anchor for view in one.rows}
    extra = {}
    if one.frontier:
        extra["wide_frontier"] = frontier(one.frontier, WIDE_FRONTIER)
        extra["narrow_frontier"] = frontier(one.frontier, NARROW_FRONTIER)
    if one.decoding:
        extra["wide_decoders"] = decoders(one.decoding, narrow=False)
        extra["narrow_decoders"] = decoders(one.decoding, narrow=True)
    names = one.tasks["target"]
    titles = names if one.balanced else [f"{number} {name}" for number, name in enumerate(names, 1)]
    steps = (1,) if one.to_criterion else one.steps
    length = None if one.to_criterion else one.steps[-1]
    if one.balanced:
        extra["orders"] = {
            str(run.seed): [printable(name) for name in run.scores.layout.target]
            for view in one.rows
            if view.row.division not in ELSEWHERE  # those keep the published order
            for run in view.row.runs
        }
    if one.has_agents:
        extra["run_elsewhere"] = along_a_run(titles, length, by_agent=True)
    return {
        **extra,
        "to_criterion": one.to_criterion,
        "metrics": [[title_of(metric.name), metric.description, metric.missing] for metric in one.others],
        "sft": anchors.get(BASELINE),
        "steps": steps,
        "targets": one.tasks["target"],
        "run": along_a_run(titles, length),
        "planes": _planes(one, anchors),
    }


def _planes(one: ScenarioView, anchors: Mapping[str, str]) -> dict[str, Any]:
    """Return the values that fill the template of the plane, by its two quantities."""
    planes = {
        f"{across.name}, {up.name}": Plane(one.table, across, up, anchors) for across in ACROSS for up in UP
    }
    return {
        name: {
            "note": drawn.note,
            "places": drawn.places,
            **{size: drawn.labels(PLANES[size]) for size in PLANES},
        }
        for name, drawn in planes.items()
    }


def _packed(values: Any) -> str:
    """Return JSON as gzip in base64: a fifth of the size, and it cannot close its element."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode("ascii")
