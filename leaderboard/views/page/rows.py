"""Rows as the templates need them: texts, bars and shades."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from clbench.base.text import printable
from clbench.learning.registry import load_method
from clbench.scoring.intervals import Estimate, needed_references, row_generator
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS
from clbench.scoring.scores import rates_of
from clbench.spec.identifiers import built_in_methods

from ...board.rows import Row, standing_of
from ...board.runs import PRIOR
from ...board.summary import DIVISIONS, ELSEWHERE, RANKED_BY, letters_of
from ..charts.curves import estimated, retained_curve, target_curves
from ..charts.vega import finite, rounded
from ..descriptions import Description, describe
from ..format import (
    NAMED,
    Column,
    aligned,
    column_title,
    format_interval,
    number_text,
    shown,
    standing_text,
    tier_text,
    title_of,
)
from ..templating import arxiv_ids
from .details import Diagnostics, Entry, commands, diagnostics, flat, same_or_each
from .numbers import MISSING, Number, cost, number, size, tried

STEPS = {
    "steps": "optimiser steps, in all stages",
    "environment_steps": "environment steps, in all stages",
}
"""Titles of costs that say what is counted; all costs are means over seeds."""


@dataclass(frozen=True)
class MetricView:
    """A metric of one row."""

    metric: Metric
    title: str
    number: Number
    interval: str
    seeds: tuple[str, ...]
    """Values by seed."""


@dataclass(frozen=True)
class MatrixLine:
    """A row of the success matrix, mean over seeds."""

    name: str
    cells: tuple[tuple[str, float | None], ...]
    """Text and success rate of each task."""
    learned: int | None
    """Column of the task that this stage learned."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RowView:
    """A row and its section."""

    row: Row
    letters: str
    """Letters of its groups, each in the column of its group."""
    place: int | None
    """Place in its division."""
    standing: str
    """Its place, and the methods that are not told apart from it, in words."""
    cells: tuple[Number, ...]
    """Cells of the table's `columns`."""
    metrics: tuple[MetricView, ...]
    """Metrics in the section of the row."""
    stages: tuple[MatrixLine, ...]
    data: Mapping[str, Any]
    """Data that the page draws when the section opens."""
    description: Description | None
    """Description of its method, if it is built in."""

    @property
    def anchor(self) -> str:
        """Anchor on the page."""
        return f"{self.row.scenario}/{self.row.method}"

    @property
    def division_number(self) -> int:
        """Place of its division in `DIVISIONS`."""
        return DIVISIONS.index(self.row.division)

    @property
    def tier(self) -> str:
        """Its tier, and how many of its runs reached a higher one."""
        return tier_text(self.row)

    @property
    def price(self) -> tuple[Number, Number]:
        """Cells of the relative cost and of the bytes kept."""
        return cost(self.row), size(self.row)

    @property
    def tried(self) -> Number:
        """Cell of the settings tried."""
        return tried(self.row)

    @property
    def summary(self) -> str:
        """One sentence about its method, empty if the method is not built in."""
        return self.description.summary if self.description else ""

    @property
    def papers(self) -> list[str]:
        """Identifiers of its method's papers on arXiv."""
        text = self.description.text if self.description else None
        return arxiv_ids(" ".join((text.idea, *text.rule))) if text else []

    @property
    def costs(self) -> list[Entry]:
        """Every cost that was measured, by its name, as the table shows it."""
        shown = {"relative_cost": cost(self.row).text, "bytes_kept": size(self.row).text}
        return [
            Entry(STEPS.get(name, title_of(name)), shown.get(name) or number_text(value, ",.0f"))
            for name, value in self.row.costs.items()
            if value is not None
        ]

    @property
    def orders(self) -> list[tuple[str, str, str]]:
        """Number, targets and final average of each order of the targets."""
        return [
            (
                str(one.number),
                printable(", ".join(one.targets)),
                number_text(one.final_average, ".2f", MISSING),
            )
            for one in self.row.orders.orders
        ]

    @property
    def order_sensitivity(self) -> str:
        """Range of these final averages, empty if there are too few orders."""
        return number_text(self.row.orders.sensitivity, ".2f", "")

    @property
    def commands(self) -> str:
        """Commands that make its records again."""
        return "\n".join(commands(self.row))

    @property
    def diagnostics(self) -> Diagnostics:
        """Diagnostics of its method."""
        return diagnostics(self.row.runs)

    @property
    def settings(self) -> list[Entry]:
        """Hyper-parameters, and the prior data that its method may use."""
        run = self.row.runs[0].record.run
        uses = {f"prior {kind}": run.uses.get(kind, "not known") for kind in PRIOR}
        return [*flat(run.settings), *flat(uses)]

    @property
    def findings(self) -> list[Entry]:
        """What others found when they checked its runs."""
        checked = [run for run in self.row.runs if run.findings]
        if not checked:
            return []
        found = same_or_each([(run.seed, flat(dict(run.findings))) for run in checked])
        return [Entry("seeds", ", ".join(str(run.seed) for run in checked)), *found]

    @property
    def fingerprint(self) -> list[Entry]:
        """Machine and software of its runs."""
        return same_or_each([(run.seed, flat(run.record.fingerprint)) for run in self.row.runs])


MAIN = (RANKED_BY, "gain", "adaptation", "retention", "kept_targets", "kept")
"""Metrics that a table shows at first, with the same titles in every scenario. It shows its other columns
when the reader asks for them."""


def columns(rows: Sequence[Row]) -> tuple[Column, ...]:
    """Return the columns of a table of `rows`, those of `MAIN` first."""
    main = [Column(METRICS[name], column_title(name, to_criterion=True)) for name in MAIN]
    known = [one for one in main if any(row.estimates[one.metric.name].value is not None for row in rows)]
    return (*known, *(one for one in shown(rows) if one.metric.name not in MAIN))


def others(rows: Sequence[Row]) -> list[Metric]:
    """Return the metrics that a table of `rows` does not show; the section of a row lists them separately."""
    there = {one.metric.name for one in columns(rows)}
    return [metric for metric in METRICS.values() if metric.name not in there]


def places(row: Row) -> tuple[str, ...]:
    """Return the names of the targets of a row by stage; by number where each seed has its own order."""
    target = row.runs[0].scores.layout.target
    numbered = tuple(f"target {number}" for number in range(1, len(target) + 1))
    return numbered if row.runs[0].published.balanced else target


def row_view(row: Row, rows: Sequence[Row]) -> RowView:
    """Return the view of a row, given all rows of its scenario."""
    seeds, table = _of_seeds(row, rows), columns(rows)
    return RowView(
        row=row,
        letters=_letters(row, rows),
        place=standing.place if (standing := standing_of(row, rows)) else None,
        standing=standing_text(row, rows, NAMED),
        cells=tuple(number(row.estimates[one.metric.name], one) for one in table),
        metrics=tuple(_metric(one, row.estimates[one.metric.name], seeds[one.metric.name]) for one in table),
        stages=tuple(_stages(row)),
        data=_drawn(row, seeds, others(rows)),
        description=_description(row.method) if row.method in built_in_methods() else None,
    )


def _letters(row: Row, rows: Iterable[Row]) -> str:
    """Return the letters of a row; a dash if there is no other row to tell it apart from."""
    rivals = [other for other in rows if other.division == row.division]
    letters = letters_of(row, rivals)
    return aligned(letters, rivals) if letters else MISSING


@cache
def _description(method: str) -> Description:
    return describe(method, load_method(method))


def _drawn(
    row: Row, seeds: Mapping[str, Sequence[float | None]], metrics: Iterable[Metric]
) -> dict[str, Any]:
    """Return the curves, the success matrix of each seed, and the values of `metrics` by seed."""
    curves = estimated(
        {"retained": retained_curve, "target": target_curves},
        [run.scores for run in row.runs],
        row_generator(row.scenario, f"{row.method} curves"),
    )
    success = {str(run.seed): run.scores.rates().success for run in row.runs}
    return {
        **{name: [_triple(point) for point in points] for name, points in curves.items()},
        "seeds": {seed: [list(map(rounded, line)) for line in lines] for seed, lines in success.items()},
        "elsewhere": row.division in ELSEWHERE,
        "metrics": [
            [
                _words(row.estimates[metric.name]),
                *(number_text(value, ".2f", MISSING) for value in seeds[metric.name]),
            ]
            for metric in metrics
        ],
    }


def _words(one: Estimate) -> str:
    return MISSING if one.value is None else format_interval(one)


def _triple(one: Estimate) -> list[float | None]:
    """Return a value with its ends; the page writes them, so they are not rounded to what a chart needs."""
    ends = map(finite, (one.value, one.low, one.high))
    return [None if end is None else round(end, 9) + 0.0 for end in ends]


def _metric(column: Column, one: Estimate, seeds: Sequence[float | None]) -> MetricView:
    words = "" if one.value is None else format_interval(one, column.form)
    texts = tuple(number_text(value, column.form, MISSING) for value in seeds)
    return MetricView(column.metric, column.title, number(one, column), words, texts)


def _of_seeds(row: Row, rows: Sequence[Row]) -> dict[str, list[float | None]]:
    """Return the values of every metric by seed, None where the row has no value."""
    scores = {other.method: other.scores for other in rows}
    references = needed_references(METRICS.values(), row.seeds, scores)
    rates = rates_of([run.scores for run in row.runs], references)
    found: dict[str, list[float | None]] = {}
    for metric in METRICS.values():
        known = row.estimates[metric.name].value is not None
        found[metric.name] = (
            [finite(value) for value in metric.function(rates)] if known else [None] * len(row.runs)
        )
    return found


def _stages(row: Row) -> list[MatrixLine]:
    """Return the success matrix."""
    layout, names = row.runs[0].scores.layout, places(row)
    begin = "after the old skills" if row.division == "online" else "pretrained"
    success = np.mean([run.scores.rates().success for run in row.runs], axis=0)
    return [
        MatrixLine(
            printable(f"after {names[stage - 1]}") if stage else begin,
            tuple((number_text(value, ".2f", MISSING), value) for value in map(finite, line)),
            len(layout.retained) + stage - 1 if stage else None,
        )
        for stage, line in enumerate(success)
    ]
