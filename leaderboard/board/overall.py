"""The table over scenarios: for each method that has a row in all of them, the mean of its values."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from clbench.records.paths import table_parts
from clbench.scoring.intervals import NO_ESTIMATE, Estimate
from clbench.scoring.metrics import METRICS
from clbench.spec.policies import DEFAULT_POLICY

from .summary import DIVISIONS, RANKED_BY, RowSummary, letters_of, tables_of


@dataclass(frozen=True)
class OverallRow:
    """One method over all scenarios."""

    method: str
    """Name or "module:Class"."""
    division: str
    """One of `DIVISIONS`."""
    scenarios: tuple[str, ...]
    """Names of the tables that it averages, in the order of the board."""
    letters: tuple[str | None, ...]
    """Letters of its groups in the scenarios, in the order of the board; None where it has no rival."""
    estimates: Mapping[str, Estimate]
    """Mean over scenarios and interval of every metric."""
    to_criterion: bool
    """Whether the stages of all scenarios end when the target is learned."""


def overall(rows: Iterable[RowSummary]) -> tuple[OverallRow, ...]:
    """Return a row for each method that has one in every scenario, by division and falling final average.

    There are no rows if there is only one scenario. Only rows of the default policy count.
    """
    by_method: dict[tuple[str, str], dict[str, RowSummary]] = {}
    tables = tables_of(row for row in rows if table_parts(row.scenario)[1] == DEFAULT_POLICY)
    for scenario, members in tables.items():
        for row in members:
            by_method.setdefault((row.division, row.method), {})[scenario] = row
    if len(tables) < 2:
        return ()
    whole = [_overall_row(found, tables) for found in by_method.values() if len(found) == len(tables)]
    return tuple(sorted(whole, key=_place))


def _place(row: OverallRow) -> tuple[int, float, str]:
    value = row.estimates[RANKED_BY].value
    return DIVISIONS.index(row.division), math.inf if value is None else -value, row.method


def _overall_row(found: Mapping[str, RowSummary], tables: Mapping[str, Sequence[RowSummary]]) -> OverallRow:
    rows = list(found.values())
    estimates = {
        name: mean_estimate([row.estimates[name] for row in rows], ratio=metric.ratio)
        for name, metric in METRICS.items()
    }
    return OverallRow(
        rows[0].method,
        rows[0].division,
        tuple(found),
        tuple(letters_of(row, tables[row.scenario]) or None for row in rows),
        estimates,
        all(row.to_criterion for row in rows),
    )


def mean_estimate(parts: Sequence[Estimate], *, ratio: bool = False) -> Estimate:
    """Return the mean of independent estimates; if one is missing, there is no mean.

    The mean of positive ratios (`ratio`) is geometric, unless a value or an end of an interval is 0.

    The interval is recovered from the parts' intervals, whose distances from their values add up in squares:
    Zou and Donner 2008, doi 10.1002/sim.3095 (MOVER). Two scenarios with tasks in common, such as Fetch-v1
    and FetchKnowledge-v1, share demonstrations and initial states. The interval does not cover that, nor does
    the interval of a single scenario.
    """
    numbers = [end for one in parts for end in (one.value, one.low, one.high) if end is not None]
    if ratio and min(numbers, default=0.0) > 0:
        return mean_estimate([one.transformed(math.log) for one in parts]).transformed(math.exp)
    values = [one.value for one in parts if one.value is not None]
    if not values or len(values) < len(parts):
        return NO_ESTIMATE
    mean = statistics.fmean(values)
    low = [one.value - one.low for one in parts if one.value is not None and one.low is not None]
    high = [one.high - one.value for one in parts if one.value is not None and one.high is not None]
    if len(low) < len(parts) or len(high) < len(parts):
        return Estimate(mean, None, None)
    below, above = (math.hypot(*reach) / len(parts) for reach in (low, high))
    return Estimate(mean, mean - below, mean + above, all(one.of_seeds for one in parts))
