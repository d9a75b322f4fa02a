"""The leaderboard as Markdown, and the environment of all templates of Markdown pages.

The same content gives the same bytes. A template escapes every value unless it is of the type `Markdown`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from clbench.base.text import counted, printable
from clbench.records.paths import table_parts
from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import Metric

from ..board.frontier import TiedGain
from ..board.overall import overall
from ..board.rows import Board, Row, certain_sides, told_above
from ..board.summary import letters_of, tables_of
from ..policies.compared import Comparisons
from ..policies.decoders import read_decoding
from .format import (
    MISSING,
    Column,
    agreement_text,
    column_title,
    format_interval,
    machine_text,
    number_text,
    over_tied,
    prediction_text,
    shown,
    start_text,
    tiers_text,
    title_of,
    unpaired_text,
)

_ARXIV = re.compile(r"arXiv (\d{4}\.\d{5})")


class Markdown(str):
    """Text that is Markdown already: templates do not escape it."""


def markdown(board: Board, comparisons: Comparisons) -> str:
    """Return the leaderboard as a page of Markdown.

    Args:
        board: The board.
        comparisons: What `compared.by_table` says of its rows.
    """
    averages = overall(board.rows)
    by_scenario = tables_of(board.rows)
    return template(__file__, "leaderboard.md.jinja").render(
        board=board,
        averages=averages,
        by_scenario=by_scenario,
        shown=shown,
        all_shown=_all_shown(by_scenario.values()),
        agreement_text=agreement_text,
        comparisons=comparisons,
        column_title=column_title,
        decoding=read_decoding(),
        counted=counted,
        policy_of=lambda table: table_parts(table)[1],
        start_text=start_text,
        machine_text=machine_text,
        unpaired_text=unpaired_text,
        tiers_text=tiers_text,
        prediction_text=prediction_text,
        letters_of=letters_of,
        tied_text=lambda id_, rows: _tied_text(id_, rows, board.tied.get(id_, {})),
        ends=_ends,
    )


def _tied_text(name: str, rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]]) -> str:
    """Return which rows are told apart above plain fine-tuning, but not from its settings rated as highly."""
    sides = certain_sides(rows, tied)
    found = [
        sentence
        for row in told_above(rows)
        if row.method not in sides
        for sentence in over_tied(name, row.method, row.estimates["gain"], tied[row.method])
    ]
    return " ".join(found)


def _all_shown(tables: Iterable[Sequence[Row]]) -> list[Column]:
    """Return the columns of all tables, each once."""
    return list(dict.fromkeys(column for rows in tables for column in shown(rows)))


def _ends(metric: Metric) -> list[str]:
    return ["unbounded" if math.isinf(end) else f"{end:g}" for end in (metric.low, metric.high)]


# ---- templates ---------------------------------------------------------------------------------------------


def template(module: str, name: str) -> Template:
    """Return a template in the folder `templates` beside a module, which gives its `__file__`."""
    return _templates(Path(module).with_name("templates")).get_template(name)


@cache
def _templates(folder: Path) -> Environment:
    """Return the templates in `folder`, with the filters that Markdown pages need."""
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=False,  # it would escape HTML; `finalize` escapes Markdown
        finalize=_escaped_unless_markdown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        code=code,
        interval=_interval,
        lines=_lines,
        links=links,
        number=number_text,
        prose=prose,
        raw=Markdown,
        title_of=title_of,
    )
    environment.globals.update(MISSING=MISSING)
    return environment


def _escaped_unless_markdown(value: object) -> str:
    return value if isinstance(value, Markdown) else escaped(str(value))


def escaped(text: str) -> Markdown:
    """Return `text`, which a stranger may have written, so that Markdown shows it as it is.

    Backslashes go before every character that can open markup, HTML, a formula, a mention or a table cell,
    and into web addresses.
    """
    return Markdown(
        re.sub(
            r"([\\`*_{}\[\]<>|~&@#$]|(?<=:)/(?=/)|(?<=www)\.)", r"\\\1", printable(text), flags=re.IGNORECASE
        )
    )


def prose(text: str) -> Markdown:
    """Return words of ours for Markdown: code in backticks stays, arXiv identifiers become links."""
    parts = re.split(r"(`[^`]+`)", text)
    return Markdown("".join(part if part.startswith("`") else linked(escaped(part)) for part in parts))


def linked(text: str) -> Markdown:
    """Return `text` with links for the arXiv identifiers in it."""
    return Markdown(_ARXIV.sub(r"[arXiv \1](https://arxiv.org/abs/\1)", text))


def arxiv_ids(text: str) -> list[str]:
    """Return the arXiv identifiers in `text`, each once, in order."""
    return list(dict.fromkeys(_ARXIV.findall(text)))


def links(ids: Iterable[str]) -> Markdown:
    """Return links to papers, given their arXiv identifiers."""
    return Markdown(", ".join(linked(f"arXiv {one}") for one in ids))


def code(text: str) -> Markdown:
    """Return `text`, of ours, as code."""
    return Markdown(f"`{text}`")


def _interval(estimate: Estimate, form: str = ".2f") -> Markdown:
    return Markdown(format_interval(estimate, form))


def _lines(texts: Iterable[Any]) -> Markdown:
    """Return texts below each other in one cell."""
    return Markdown("<br>".join(map(escaped, texts)))
