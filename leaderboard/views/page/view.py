"""Scenarios and rows as the templates need them: texts, bars and shades."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from typing import Any, TypeVar

import numpy as np

from clbench.base.text import printable
from clbench.learning.registry import load_method
from clbench.scoring.intervals import Estimate, needed_references, row_generator
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS
from clbench.scoring.scores import rates_of
from clbench.spec.identifiers import built_in_methods

from ...board.frontier import Curve
from ...board.rows import Row, Table, standing_of
from ...board.summary import DIVISIONS, METHODS
from ...policies.compared import Comparison, by_table
from ...policies.decoders import Decoding, read_decoding
from ..descriptions import RULES, Description, describe
from ..format import (
    Column,
    Rows,
    agreement_text,
    aligned,
    format_interval,
    number_text,
    prediction_text,
    scaled,
    shown,
    standing_text,
    start_text,
    title_of,
)
from ..markdown import arxiv_ids
from .charts import finite, rounded
from .curves import estimated, retained_curve, target_curves
from .definitions import Family, families
from .details import Diagnostics, Entry, commands, diagnostics, flat, same_or_each

MISSING = "\N{EN DASH}"
"""Text for a value that could not be computed."""

NAMED = 3
"""Number of methods not told apart from a row that are named; further ones are only counted."""

SHADES = 20
"""Number of shades between success 0 and success 1."""


Item = TypeVar("Item")
Group = tuple[int, str, str, list[Item]]
"""Number, name and rule of a division, and its rows."""


def grouped(rows: Iterable[Item], divisions: Iterable[str]) -> list[Group[Item]]:
    """Return sorted rows by division, given the division of each row."""
    groups = groupby(zip(divisions, rows, strict=True), key=lambda pair: pair[0])
    return [(DIVISIONS.index(name), name, RULES[name], [row for _, row in pairs]) for name, pairs in groups]


@dataclass(frozen=True)
class Number:
    """A number in a cell."""

    text: str
    """Text in the cell."""
    order: str = ""
    """Sort key; empty if the number is missing."""
    note: str = ""
    """Its interval, or the reason why it is missing."""
    bar: tuple[float, ...] = ()
    """Low end, value and high end in per cent of a bar from 0 to 1; empty without an interval."""


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
class Stage:
    """A row of the success matrix, mean over seeds."""

    name: str
    texts: tuple[str, ...]
    """Success rates by task."""
    shades: tuple[int | None, ...]
    """Shades by task, from 0 to `SHADES`."""
    learned: int | None
    """Column of the task that this stage learned."""


@dataclass(frozen=True, eq=False)
class RowView:
    """A row and its section."""

    row: Row
    groups: str
    """Letters of its groups, each in the column of its group."""
    place: int | None
    """Place in its division."""
    standing: str
    """Its place, and the methods that are not told apart from it, in words."""
    cells: tuple[Number, ...]
    """Cells of the table's `columns`, then the settings tried if stages end when the target is learned, the
    relative cost and the bytes kept."""
    metrics: tuple[MetricView, ...]
    """Metrics in the section of the row."""
    stages: tuple[Stage, ...]
    data: Mapping[str, Any]
    """Data that the page draws when the section opens."""
    description: Description | None
    """Description of its method, if it is built in."""

    @property
    def anchor(self) -> str:
        """Anchor on the page."""
        return f"{self.row.scenario}/{self.row.method}"

    @property
    def division(self) -> int:
        """Number of its division."""
        return DIVISIONS.index(self.row.division)

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
        """Every cost by its name."""
        return [
            Entry(title_of(name), number_text(value, ",.2f" if name == "relative_cost" else ",.0f", MISSING))
            for name, value in self.row.costs.items()
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
        uses = {f"prior {kind}": run.uses.get(kind, "not known") for kind in ("demonstrations", "questions")}
        return [*flat(run.settings), *flat(uses)]

    @property
    def findings(self) -> list[Entry]:
        """What others found who checked its runs."""
        checked = [run for run in self.row.runs if run.findings]
        if not checked:
            return []
        found = same_or_each([(run.seed, flat(dict(run.findings))) for run in checked])
        return [Entry("seeds", ", ".join(str(run.seed) for run in checked)), *found]

    @property
    def fingerprint(self) -> list[Entry]:
        """Machine and software of its runs."""
        return same_or_each([(run.seed, flat(run.record.fingerprint)) for run in self.row.runs])


def columns(rows: Rows) -> tuple[Column, ...]:
    """Return the columns of a table of `rows`; the section of a row has all metrics."""
    return tuple(one for one in shown(rows) if one.metric.name != "zero_shot")


def others(rows: Rows) -> list[Metric]:
    """Return the metrics that a table of `rows` does not show; the section of a row lists them apart."""
    there = {one.metric.name for one in shown(rows)}
    return [metric for metric in METRICS.values() if metric.name not in there]


@dataclass(frozen=True, eq=False)
class ScenarioView:
    """A scenario and its rows."""

    id: str
    groups: Mapping[str, tuple[str, ...]]
    """Names of the tasks by group, targets in their published order."""
    tasks: Mapping[str, tuple[str, ...]]
    """The same as heads of columns: targets by their place where each seed has its own order."""
    balanced: bool
    """Whether each seed has its own order of the targets."""
    steps: tuple[int, ...]
    """Evaluation points of a stage."""
    rows: tuple[RowView, ...]
    families: tuple[Family, ...]
    frontier: tuple[Curve, ...]
    """Methods along the ladder of step sizes."""
    start: str
    """Sentence on what the pretrained policy can do, empty if there is none."""
    agreement: str
    """Sentence on how alike two halves of the seeds order the methods, empty if it is not known."""
    comparisons: tuple[Comparison, ...]
    """The same methods with the default policy; none for a table of that policy."""
    decoding: Decoding | None
    """Decoders of the policy; None where there are none to choose among."""

    @property
    def table(self) -> list[Row]:
        """Its rows without their sections."""
        return [view.row for view in self.rows]

    @property
    def to_criterion(self) -> bool:
        """Whether its stages end when the target is learned."""
        return self.rows[0].row.to_criterion

    @property
    def prediction(self) -> str:
        """Sentence on what predicts forgetting among the methods, empty if nothing is known."""
        return prediction_text(self.table)

    @property
    def others(self) -> list[Metric]:
        """Metrics that its table does not show."""
        return others(self.table)

    @property
    def divisions(self) -> list[Group[RowView]]:
        """Its rows by division."""
        return grouped(self.rows, [view.row.division for view in self.rows])

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of its table."""
        return columns(self.table)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return sum(len(view.row.runs) for view in self.rows)

    @property
    def competing(self) -> list[RowView]:
        """Rows of the methods that compete."""
        return [view for view in self.rows if view.row.division in METHODS]


def scenarios(table: Table) -> list[ScenarioView]:
    """Return the view of each scenario."""
    found = []
    comparisons, decoding = by_table(table.rows), read_decoding()
    for scenario, members in groupby(table.rows, key=lambda row: row.scenario):
        rows = list(members)
        layout, published = rows[0].runs[0].scores.layout, rows[0].runs[0].published
        groups = {"retained": layout.retained, "target": published.target, "held out": layout.held_out}
        tasks = {**groups, "target": _places(rows[0])}
        views = [_row(row, rows) for row in rows]
        competing = [row for row in rows if row.division in METHODS]
        found.append(
            ScenarioView(
                scenario,
                _printable(groups),
                _printable(tasks),
                published.balanced,
                layout.steps,
                tuple(views),
                tuple(families(competing)),
                table.frontiers.get(scenario, ()),
                start_text(table.starts.get(scenario)),
                agreement_text(table.agreements.get(scenario)),
                comparisons.get(scenario, ()),
                decoding if decoding and scenario == decoding.place else None,
            )
        )
    return found


def _printable(groups: Mapping[str, Iterable[str]]) -> dict[str, tuple[str, ...]]:
    return {group: tuple(map(printable, names)) for group, names in groups.items()}


def _places(row: Row) -> tuple[str, ...]:
    """Return the names of the targets by stage; by number where each seed has its own order."""
    target = row.runs[0].scores.layout.target
    numbered = tuple(f"target {number}" for number in range(1, len(target) + 1))
    return numbered if row.runs[0].published.balanced else target


def _row(row: Row, rows: Sequence[Row]) -> RowView:
    seeds = _of_seeds(row, rows)
    return RowView(
        row,
        aligned(row.groups, [other for other in rows if other.division == row.division]) or MISSING,
        standing.place if (standing := standing_of(row, rows)) else None,
        standing_text(row, rows, NAMED),
        (*(number(row.estimates[one.metric.name], one) for one in columns(rows)), *_tried(row), *_costs(row)),
        tuple(_metric(one, row.estimates[one.metric.name], seeds[one.metric.name]) for one in shown(rows)),
        tuple(_stages(row)),
        _drawn(row, seeds, others(rows)),
        _description(row.method) if row.method in built_in_methods() else None,
    )


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
        "metrics": [
            [*_triple(row.estimates[metric.name]), *map(rounded, seeds[metric.name])] for metric in metrics
        ],
    }


def _triple(one: Estimate) -> list[float | None]:
    return [rounded(value) for value in (one.value, one.low, one.high)]


# ---- numbers -----------------------------------------------------------------------------------------------


def number(one: Estimate, column: Column) -> Number:
    """Return the cell of a metric."""
    metric, form = column.metric, column.form
    if one.value is None:
        return Number(MISSING, note=f"missing: {metric.missing}")
    text, order = number_text(one.value, form), number_text(one.value, ".6f")
    if one.low is None or one.high is None:
        return Number(text, order, "without an interval")
    ends = [round(100 * min(max(round(end, 9), 0.0), 1.0)) for end in (one.low, one.value, one.high)]
    note = f"95 % interval from {number_text(one.low, form)} to {number_text(one.high, form)}"
    has_bar = metric.high <= 1 and not metric.units.startswith("difference")
    return Number(text, order, note, tuple(ends) if has_bar else ())


def _tried(row: Row) -> tuple[Number, ...]:
    """Return the number of settings that tuning tried, where the table has that column."""
    if not row.to_criterion:
        return ()
    if row.tried is None:
        return (Number(MISSING, note="the method was not tuned here"),)
    return (Number(str(row.tried), str(row.tried)),)


def _costs(row: Row) -> tuple[Number, Number]:
    """Return the relative cost and the bytes kept."""
    relative, kept = row.costs["relative_cost"], row.costs["bytes_kept"]
    cost = Number(MISSING, note="missing: its runs did not measure the time of a step, or sft has none")
    size = Number(MISSING, note="missing: a record has no value")
    if relative is not None:
        cost = Number(number_text(relative, ".2f") + "\N{MULTIPLICATION SIGN}", number_text(relative, ".6f"))
    if kept is not None:
        digits, unit = scaled(kept)
        text = f"{digits} {unit}B" if unit else digits
        size = Number(text, number_text(kept, ".0f"), f"{number_text(kept, ',.0f')} bytes")
    return cost, size


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


def _stages(row: Row) -> list[Stage]:
    """Return the success matrix."""
    layout, places = row.runs[0].scores.layout, _places(row)
    success = np.mean([run.scores.rates().success for run in row.runs], axis=0)
    stages = []
    for stage, line in enumerate(success):
        values = [finite(value) for value in line]
        stages.append(
            Stage(
                printable(f"after {places[stage - 1]}") if stage else "pretrained",
                tuple(number_text(value, ".2f", MISSING) for value in values),
                tuple(None if value is None else round(round(value, 9) * SHADES) for value in values),
                len(layout.retained) + stage - 1 if stage else None,
            )
        )
    return stages
