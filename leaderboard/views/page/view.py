"""What the page shows of scenarios and rows, ready for the templates: texts, bars and shades."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from typing import Any, TypeVar

import numpy as np

from clbench.learning.registry import load_method
from clbench.scoring.intervals import Estimate, needed_references, row_generator
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS
from clbench.scoring.scores import rates_of
from clbench.spec.identifiers import built_in_methods

from ...board.rows import Row, Table, rank_mates
from ...board.runs import DIVISIONS, METHODS, printable
from ...pages.descriptions import Description, describe
from ..markdown import arxiv_ids
from ..table import SHOWN, Rows, interval, number_text, scaled, shown, title_of
from .charts import finite, rounded
from .curves import estimated, retained_curve, target_curves
from .definitions import Family, families
from .details import Diagnostics, Entry, commands, diagnostics, flat, same_or_each

MISSING = "\N{EN DASH}"
"""What stands for a value that could not be computed."""

NAMED = 3
"""Methods that share a rank and are named; of more only the number is told."""

OTHERS = tuple(metric for metric in METRICS.values() if metric not in SHOWN)
"""Metrics that a row's section has besides."""

SHADES = 20
"""Steps between a success of 0 and of 1 that have a colour of their own."""

RULES: Mapping[str, str] = dict(
    zip(
        DIVISIONS,
        (
            "see nothing of what came before",
            "may look at questions from before, but at no demonstrations",
            "may look at demonstrations from before",
            "learn by trial, without the pretrained policy and demonstrations: no method compares with them",
            "do not compete: they show what could be had at best, and what doing nothing gives",
        ),
        strict=True,
    )
)
"""What the methods of each division do."""


Item = TypeVar("Item")
Group = tuple[int, str, str, list[Item]]
"""Number, name and rule of a division, and the rows in it."""


def grouped(rows: Iterable[Item], divisions: Iterable[str]) -> list[Group[Item]]:
    """Return sorted rows by division, given that of each."""
    groups = groupby(zip(divisions, rows, strict=True), key=lambda pair: pair[0])
    return [(DIVISIONS.index(name), name, RULES[name], [row for _, row in pairs]) for name, pairs in groups]


@dataclass(frozen=True)
class Number:
    """A number in a cell."""

    text: str
    """As it is shown."""
    order: str = ""
    """What it is sorted by; nothing if it is missing."""
    note: str = ""
    """Its interval, or why it is missing."""
    bar: tuple[float, ...] = ()
    """Low end, value and high end in per cent of a bar from 0 to 1; nothing without an interval."""


@dataclass(frozen=True)
class MetricView:
    """A metric of one row."""

    metric: Metric
    number: Number
    interval: str
    seeds: tuple[str, ...]
    """Value of each seed."""

    @property
    def title(self) -> str:
        """Its name in words."""
        return title_of(self.metric.name)


@dataclass(frozen=True)
class Stage:
    """A line of the success matrix: mean over seeds."""

    name: str
    texts: tuple[str, ...]
    """Success on each task."""
    shades: tuple[int | None, ...]
    """Number of its colour, from 0 to `SHADES`."""
    learned: int | None
    """Column of the task that was learned in this stage."""


@dataclass(frozen=True, eq=False)
class RowView:
    """A row and its section."""

    row: Row
    rank: str
    """As it is shown, = where it is shared."""
    place: str
    """Its rank in words."""
    cells: tuple[Number, ...]
    """Of the table's `columns`, then the relative cost and the bytes kept."""
    metrics: tuple[MetricView, ...]
    """What is shown of this row alone."""
    stages: tuple[Stage, ...]
    data: Mapping[str, Any]
    """What the page draws when the section is opened."""
    description: Description | None
    """What the code says of its method, if it is one of ours."""

    @property
    def anchor(self) -> str:
        """Its place on the page."""
        return f"{self.row.scenario}/{self.row.method}"

    @property
    def division(self) -> int:
        """Number of its division."""
        return DIVISIONS.index(self.row.division)

    @property
    def summary(self) -> str:
        """What its method does, nothing if that is not known here."""
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
        """How far these lie apart, nothing if they are too few."""
        return number_text(self.row.orders.sensitivity, ".2f", "")

    @property
    def commands(self) -> str:
        """What makes its records again."""
        return "\n".join(commands(self.row))

    @property
    def diagnostics(self) -> Diagnostics:
        """What its method tells about itself."""
        return diagnostics(self.row.runs)

    @property
    def settings(self) -> list[Entry]:
        """Hyper-parameters, and the prior data that its method may touch."""
        run = self.row.runs[0].record.run
        uses = {f"prior {kind}": run["uses"][kind] for kind in ("demonstrations", "questions")}
        return [*flat(run["settings"]), *flat(uses)]

    @property
    def fingerprint(self) -> list[Entry]:
        """What its runs were made with."""
        return same_or_each([(run.seed, flat(run.record.fingerprint)) for run in self.row.runs])


def columns(rows: Rows) -> tuple[Metric, ...]:
    """Return the metrics of a table of `rows`; a row's own section has all."""
    return tuple(metric for metric in shown(rows) if metric.name != "zero_shot")


@dataclass(frozen=True, eq=False)
class ScenarioView:
    """A scenario and its rows."""

    id: str
    tasks: Mapping[str, tuple[str, ...]]
    """Names by group."""
    steps: tuple[int, ...]
    """Evaluation points of a stage."""
    rows: tuple[RowView, ...]
    families: tuple[Family, ...]

    @property
    def divisions(self) -> list[Group[RowView]]:
        """Its rows by division."""
        return grouped(self.rows, [view.row.division for view in self.rows])

    @property
    def columns(self) -> tuple[Metric, ...]:
        """Metrics of its table."""
        return columns([view.row for view in self.rows])

    @property
    def runs(self) -> int:
        """How many there are."""
        return sum(len(view.row.runs) for view in self.rows)

    @property
    def competing(self) -> list[RowView]:
        """Rows of the methods that are no reference."""
        return [view for view in self.rows if view.row.division in METHODS]


def scenarios(table: Table) -> list[ScenarioView]:
    """Return what the page shows of each scenario."""
    found = []
    for scenario, members in groupby(table.rows, key=lambda row: row.scenario):
        rows = list(members)
        layout = rows[0].runs[0].scores.layout
        tasks = {"retained": layout.retained, "target": layout.target, "held out": layout.held_out}
        views = [_row(row, rows) for row in rows]
        competing = [row for row in rows if row.division in METHODS]
        found.append(
            ScenarioView(
                scenario,
                {group: tuple(map(printable, names)) for group, names in tasks.items()},
                layout.steps,
                tuple(views),
                tuple(families(competing)),
            )
        )
    return found


def _row(row: Row, rows: Sequence[Row]) -> RowView:
    seeds = _of_seeds(row, rows)
    return RowView(
        row,
        *_rank(row, rows),
        (*(number(row.estimates[metric.name], metric) for metric in columns(rows)), *_costs(row)),
        tuple(_metric(metric, row.estimates[metric.name], seeds[metric.name]) for metric in shown([row])),
        tuple(_stages(row)),
        _drawn(row, seeds),
        _description(row.method) if row.method in built_in_methods() else None,
    )


@cache
def _description(method: str) -> Description:
    return describe(method, load_method(method))


def _drawn(row: Row, seeds: Mapping[str, Sequence[float | None]]) -> dict[str, Any]:
    """Return the curves, the matrix of each seed, and `OTHERS` with the values of each seed."""
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
            [*_triple(row.estimates[metric.name]), *map(rounded, seeds[metric.name])] for metric in OTHERS
        ],
    }


def _triple(one: Estimate) -> list[float | None]:
    return [rounded(value) for value in (one.value, one.low, one.high)]


# ---- numbers -----------------------------------------------------------------------------------------------


def number(one: Estimate, metric: Metric) -> Number:
    """Return the value of a metric for a cell."""
    if one.value is None:
        return Number(MISSING, note=f"missing: {metric.missing}")
    text, order = number_text(one.value, ".2f"), number_text(one.value, ".6f")
    if one.low is None or one.high is None:
        return Number(text, order, "without an interval")
    ends = [round(100 * min(max(round(end, 9), 0.0), 1.0)) for end in (one.low, one.value, one.high)]
    note = f"95 % interval from {number_text(one.low, '.2f')} to {number_text(one.high, '.2f')}"
    return Number(text, order, note, tuple(ends))


def _costs(row: Row) -> tuple[Number, Number]:
    """Return the relative cost and the bytes kept."""
    relative, kept = row.costs["relative_cost"], row.costs["bytes_kept"]
    cost = Number(MISSING, note="missing: the time of a step, or the steps of sft, are not known")
    size = Number(MISSING, note="missing: a record does not say it")
    if relative is not None:
        cost = Number(number_text(relative, ".2f") + "\N{MULTIPLICATION SIGN}", number_text(relative, ".6f"))
    if kept is not None:
        digits, unit = scaled(kept)
        text = f"{digits} {unit}B" if unit else digits
        size = Number(text, number_text(kept, ".0f"), f"{number_text(kept, ',.0f')} bytes")
    return cost, size


def _rank(row: Row, rows: Sequence[Row]) -> tuple[str, str]:
    """Return the rank of a row as it is shown, and in words."""
    if row.rank is None:
        reference = row.division == DIVISIONS[-1]
        return MISSING, "no rank: a reference does not compete" if reference else "no rank"
    count, same = rank_mates(row, rows)
    place = f"rank {row.rank} of {count}"
    if not same:
        return str(row.rank), place
    shown = ", ".join(same[:NAMED]) + (f" and {len(same) - NAMED} more" if len(same) > NAMED else "")
    return f"{row.rank}=", f"{place}, shared with {shown}"


def _metric(metric: Metric, one: Estimate, seeds: Sequence[float | None]) -> MetricView:
    words = "" if one.value is None else interval(one)
    return MetricView(
        metric, number(one, metric), words, tuple(number_text(value, ".2f", MISSING) for value in seeds)
    )


def _of_seeds(row: Row, rows: Sequence[Row]) -> dict[str, list[float | None]]:
    """Return the value of every metric for each seed, None where the row has none either."""
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
    layout = row.runs[0].scores.layout
    success = np.mean([run.scores.rates().success for run in row.runs], axis=0)
    stages = []
    for stage, line in enumerate(success):
        values = [finite(value) for value in line]
        stages.append(
            Stage(
                printable(f"after {layout.target[stage - 1]}") if stage else "pretrained",
                tuple(number_text(value, ".2f", MISSING) for value in values),
                tuple(None if value is None else round(round(value, 9) * SHADES) for value in values),
                len(layout.retained) + stage - 1 if stage else None,
            )
        )
    return stages
