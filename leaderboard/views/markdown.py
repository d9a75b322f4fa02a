"""The leaderboard as Markdown. The same content gives the same bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from clbench.base.text import counted
from clbench.records.paths import table_parts
from clbench.scoring.metric import Metric

from ..board.certainty import TiedGain, sides_of_gains
from ..board.grid import grids
from ..board.rows import Board, Row
from ..board.summary import letters_of, tables_of
from ..policies.compared import Comparisons
from ..policies.decoders import read_decoding
from .format import (
    agreement_text,
    column_title,
    gain_text,
    machine_text,
    prediction_text,
    shown,
    start_text,
    table_title,
    tiers_text,
    unpaired_text,
)
from .templating import template


def markdown(board: Board, comparisons: Comparisons) -> str:
    """Return the leaderboard as a page of Markdown.

    Args:
        board: The board.
        comparisons: The comparisons of its rows, from `compared.by_table`.
    """
    by_scenario = tables_of(board.rows)
    return template(__file__, "leaderboard.md.jinja").render(
        board=board,
        grids=grids(by_scenario, least=2),
        by_scenario=by_scenario,
        shown=shown,
        all_shown=dict.fromkeys(column for rows in by_scenario.values() for column in shown(rows)),
        agreement_text=agreement_text,
        comparisons=comparisons,
        column_title=column_title,
        table_title=table_title,
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
    """Return sentences on rows told apart above plain fine-tuning, but not certainly above it."""
    sides = sides_of_gains(rows, tied)
    return " ".join(
        gain_text(name, row.method, row.estimates["gain"], tied.get(row.method, ()))
        for row in rows
        if sides.get(row.method) == 0 and (row.estimates["gain"].value or 0.0) > 0
    )


def _ends(metric: Metric) -> list[str]:
    return ["unbounded" if math.isinf(end) else f"{end:g}" for end in (metric.low, metric.high)]
