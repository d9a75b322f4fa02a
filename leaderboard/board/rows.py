"""Rows of the leaderboard, one for each method and scenario, in the order of the table.

They are made only from the records.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from clbench.records.fingerprints import machine_of
from clbench.records.paths import check_folder
from clbench.records.record import ScenarioInfo
from clbench.runs.tuning import CONTROL_OF, tuned
from clbench.scoring.groups import groups
from clbench.scoring.intervals import Estimate, Runs, estimate, row_generator
from clbench.scoring.metric import TIE
from clbench.scoring.metrics import METRICS, measure
from clbench.spec.references import BASELINE

from .agreement import (
    LEAST_ROWS,
    LEAST_SEEDS,
    PREDICTORS,
    Concordance,
    Prediction,
    concordance,
    prediction_of,
)
from .certainty import TiedGain, tied_gains
from .costs import costs_of
from .frontier import Curve, frontiers_of, ladder_of, read_ladder
from .orders import Orders, orders_of
from .runs import ALIKE, Run, Sifted, read_run, read_runs, sift_by, unlike_the_pin
from .summary import (
    DIVISIONS,
    ELSEWHERE,
    RANKED_BY,
    REFERENCE,
    RowSummary,
    Summary,
    competing,
    grouped,
    mean_of,
)
from .tiers import TIERS


@dataclass(frozen=True, kw_only=True)
class Row(RowSummary):
    """One method on one scenario, with its records."""

    runs: tuple[Run, ...]
    """Its runs with the targets in the published order, by rising seed. Everything but `orders` is made from
    them."""
    orders: Orders
    """Its results with the targets in this and in other orders."""
    height: float | None
    """Value that orders the rows of a division, higher first (`_heights`); None without a final average."""

    @property
    def scores(self) -> Runs:
        """Scores of its runs by seed."""
        return _scores(self.runs)


@dataclass(frozen=True, kw_only=True)
class Board(Summary):
    """Everything that the leaderboard shows."""

    scenarios: Mapping[str, ScenarioInfo] = field(default_factory=dict)
    """`Record.scenario`, which the rows of a scenario share, by its id."""
    rows: tuple[Row, ...] = ()
    frontiers: Mapping[str, tuple[Curve, ...]] = field(default_factory=dict)
    """Methods at the learning rates of the ladder, by scenario; only scenarios with records."""
    predictions: Mapping[str, tuple[Prediction, ...]] = field(default_factory=dict)
    """What orders the methods as their forgetting does, by scenario."""
    tied: Mapping[str, Mapping[str, tuple[TiedGain, ...]]] = field(default_factory=dict)
    """Gains over plain fine-tuning at settings that tuning rated as highly as the chosen one, by scenario and
    competing method; none for a method of a scenario without such a setting."""


def compute_board(records: Path, only: Container[str] | None = None) -> Board:
    """Return the board of the records anywhere below the folder `records`.

    Args:
        records: Folder of the records.
        only: Paths of the records that count, relative to the folder; None for all.

    Raises:
        NoRecordsError: The folder does not exist.
    """
    check_folder(records)
    runs, not_shown = runs_of_rows(records, only)
    by_table = grouped((run.table, run) for run in sorted(runs, key=lambda run: run.table))
    found = [_scenario_rows(members) for members in by_table.values()]
    found.sort(key=lambda rows: not rows[0].to_criterion)  # stages to a criterion first
    by_name = {rows[0].scenario: rows for rows in found}
    ladder, without = read_ladder(ladder_of(records), runs) if only is None else ([], [])
    return Board(
        scenarios={run.table: run.published for run in runs},
        rows=tuple(chain.from_iterable(found)),
        starts={name: pretrained_success(rows) for name, rows in by_name.items()},
        machines={run.table: machine_of(run.record.fingerprint) or "" for run in runs if unlike_the_pin(run)},
        unpaired={name: others for name, rows in by_name.items() if (others := unpaired(rows))},
        agreements={name: agreement(rows) for name, rows in by_name.items()},
        not_shown=tuple(sorted([*not_shown, *without], key=lambda entry: entry.path)),
        frontiers=frontiers_of(ladder),
        predictions={name: tuple(predictions(rows)) for name, rows in by_name.items()},
        tied={
            name: tied_gains(name, {row.method: row.scores for row in competing(rows)}, ladder)
            for name, rows in by_name.items()
        },
    )


def runs_of_rows(records: Path, only: Container[str] | None = None) -> Sifted:
    """Return the runs of the board's rows, and the files that are no such run.

    Args:
        records: Folder of the records. A missing folder counts as empty.
        only: As for `compute_board`.
    """
    runs, refused = read_runs(records, read_run, ALIKE, only)
    runs, alone = _beside_rows(runs)
    return runs, [*refused, *alone]


def _beside_rows(runs: list[Run]) -> Sifted:
    """Keep the runs of methods that have a row: one with the targets in the published order."""
    with_row = {(run.table, run.label) for run in runs if not run.order}
    alone = "its method has no run with the targets in the published order, which a row needs."
    return sift_by(runs, lambda run: "" if (run.table, run.label) in with_row else alone)


def _scenario_rows(runs: list[Run]) -> list[Row]:
    """Return the rows of the runs of one scenario, by division, the best first: see `_heights`."""
    by_seed = sorted((run for run in runs if not run.order), key=lambda run: run.seed)
    by_method = grouped((run.label, run) for run in by_seed)
    rows = []
    for division in DIVISIONS:
        members = {method: runs for method, runs in by_method.items() if runs[0].division == division}
        estimates = {method: _estimates(method, by_method) for method in members}
        scores = {method: _scores(runs) for method, runs in members.items()}
        letters = groups(RANKED_BY, scores if division != REFERENCE else {})
        finals = {method: estimates[method][RANKED_BY].value for method in members}
        heights = _heights(finals, scores, _scores(by_method.get(BASELINE, ())))
        order = sorted(members, key=lambda method: (_falling(heights[method]), method))
        rows += [
            _row(method, estimates[method], letters.get(method), heights[method], by_method, runs)
            for method in order
        ]
    return rows


def _row(
    method: str,
    estimates: Mapping[str, Estimate],
    letters: str | None,
    height: float | None,
    by_method: Mapping[str, list[Run]],
    runs: Iterable[Run],
) -> Row:
    """Return the row of a method; `runs` are all of the scenario, in any order."""
    members = by_method[method]
    first = members[0]
    orders = orders_of(run for run in runs if run.label == method)
    return Row(
        scenario=first.table,
        method=method,
        division=first.division,
        letters=letters,
        tier=min((run.tier for run in members), key=TIERS.index),
        seeds=tuple(run.seed for run in members),
        to_criterion=first.scores.layout.to_criterion,
        estimates=estimates,
        costs=costs_of(members, by_method.get(BASELINE, [])),
        order_sensitivity=orders.sensitivity,
        tried=_tried(first.table, method),
        runs=tuple(members),
        orders=orders,
        height=height,
    )


def _tried(table: str, method: str) -> int | None:
    found = tuned(table).get(method)
    return len(found.tried) if found else None


def pretrained_success(rows: Iterable[Row]) -> float | None:
    """Return the mean success of the pretrained policy on the retained skills, over the seeds of a row.

    The row is that of plain fine-tuning or, without one, the first one of a method that fine-tunes.
    """
    begins = competing(rows)
    row = next((row for row in begins if row.method == BASELINE), begins[0] if begins else None)
    if row is None:
        return None
    return mean_of(run.record.retained_at_start() for run in row.runs)


def unpaired(rows: Iterable[Row]) -> dict[str, list[int]]:
    """Return the seeds of runs that began with another pretrained policy than plain fine-tuning, by method.

    On processors with other instructions, pretraining ends with other weights. Differences by seed then
    compare runs that have only their initial states in common.
    """
    begins: dict[str, dict[int, Any]] = {
        row.method: {run.seed: run.record.fingerprint.get("pretrained") for run in row.runs}
        for row in rows
        if row.division not in ELSEWHERE
    }
    usual = begins.get(BASELINE, {})
    found = {
        method: [seed for seed, policy in seeds.items() if policy != usual.get(seed, policy)]
        for method, seeds in begins.items()
    }
    return {method: seeds for method, seeds in found.items() if seeds}


def mean_difference(metric: str, runs: Runs, others: Runs) -> float | None:
    """Return a metric of `runs` minus that of `others`, averaged over the common seeds; None without any.

    Args:
        metric: Name of a metric that needs no reference.
        runs: Runs of one method by seed.
        others: Runs of the other method by seed, on the same tasks and episodes.
    """
    pairs = [
        [measure(metric, them[seed]) for them in (runs, others)]
        for seed in sorted(runs.keys() & others.keys())
    ]
    return mean_of(one - other for one, other in pairs if one is not None and other is not None)


def _heights(
    finals: Mapping[str, float | None], rows: Mapping[str, Runs], baseline: Runs
) -> dict[str, float | None]:
    """Return the values that order the rows of a division, by method; None without a final average.

    The value is the final average minus that of plain fine-tuning over the seeds that both have: seeds differ
    so much that final averages over different seeds say little. A row that shares no seed with plain
    fine-tuning has None if other rows share one; if none does, the value is the final average for all rows.
    """
    known = [method for method, final in finals.items() if final is not None]
    gains = {method: mean_difference(RANKED_BY, rows[method], baseline) for method in known}
    if all(gain is None for gain in gains.values()):
        return dict(finals)
    return {method: gains.get(method) for method in finals}


def _falling(height: float | None) -> float:
    return math.inf if height is None else -height


def _estimates(method: str, by_method: Mapping[str, list[Run]]) -> dict[str, Estimate]:
    """Return the estimates of every metric of a method, compared with the references of its scenario."""
    never_itself = {
        name for metric in METRICS.values() if not metric.compares_itself for name in metric.references
    }
    runs = by_method[method]
    # A reference is compared with itself only where that means something; an agent is compared with none.
    references = {
        name: _scores(them)
        for name, them in by_method.items()
        if runs[0].division not in ELSEWHERE and (name != method or name not in never_itself)
    }
    generator = row_generator(runs[0].table, method)
    return estimate(METRICS, _scores(runs), generator, references=references)


def _scores(runs: Iterable[Run]) -> Runs:
    return {run.seed: run.scores for run in runs}


@dataclass(frozen=True)
class Standing:
    """A row among the rows of its division that have a final average."""

    place: int
    """One more than the number of rows with a greater height; it ignores noise."""
    count: int
    """Number of rows."""
    alike: tuple[str, ...]
    """Methods of the other rows that are not told apart from it, the best first."""


def standing_of(row: Row, rows: Iterable[Row]) -> Standing | None:
    """Return the standing of `row` among all `rows` of its scenario; None if it is in no group."""
    if row.letters is None:
        return None
    division = [other for other in rows if other.division == row.division and other.letters is not None]
    better = [other for other in division if _falling(other.height) < _falling(row.height) - TIE]
    alike = [other for other in division if other is not row and set(other.letters or "") & set(row.letters)]
    return Standing(1 + len(better), len(division), tuple(other.method for other in alike))


def agreement(rows: Iterable[Row]) -> Concordance | None:
    """Return how alike the seeds order the competing rows of a scenario; see `concordance`.

    Only a scenario whose seeds have orders of their own has an agreement.
    """
    values = values_by_seed(row for row in rows if row.runs[0].published.balanced)
    return concordance(np.array(list(values.values()))) if values else None


def values_by_seed(rows: Iterable[Row], metric: str = RANKED_BY) -> dict[str, list[float]]:
    """Return a metric of each competing row with each of the baseline's seeds, by method.

    Rows that lack one of these seeds, or a value, are left out. So are controls: each is a method of the
    board with one thing changed, and would count as one more method. Without the baseline, there is none.

    Args:
        rows: Rows of a scenario.
        metric: Name of a metric that needs no reference.
    """
    members = [row for row in competing(rows) if row.method not in CONTROL_OF]
    seeds = next((row.seeds for row in members if row.method == BASELINE), ())
    found = {}
    for row in members:
        if seeds and set(seeds) <= set(row.seeds):
            values = [measure(metric, row.scores[seed]) for seed in seeds]
            if None not in values:
                found[row.method] = [value for value in values if value is not None]
    return found


def predictions(rows: Iterable[Row]) -> list[Prediction]:
    """Return how well each predictor orders the competing rows of a scenario as forgetting does.

    The seeds are the baseline's. A row without one of them, or without a value, is left out.
    """
    to_criterion = [row for row in rows if row.to_criterion]
    kept = values_by_seed(to_criterion, "kept_share")
    found = []
    for name, (metric, sign) in PREDICTORS.items():
        values = values_by_seed(to_criterion, metric)
        pairs = np.array([np.transpose([values[one], kept[one]]) for one in values if one in kept])
        if len(pairs) >= LEAST_ROWS and pairs.shape[1] >= LEAST_SEEDS:
            found.append(prediction_of(name, pairs * (sign, -1.0)))
    return [one for one in found if one is not None]
