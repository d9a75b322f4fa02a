"""Does forgetting depend on the policy? The same methods and seeds with two kinds of policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from clbench.records.paths import parts_of
from clbench.scoring.intervals import Estimate, bootstrap, row_generator
from clbench.scoring.layout import Array
from clbench.scoring.metrics import load_metric
from clbench.scoring.rates import Rates
from clbench.scoring.scores import Scores
from clbench.spec.policies import DEFAULT_POLICY

from ..board.rows import Row
from ..board.summary import tables_of

Comparisons: TypeAlias = "Mapping[str, tuple[Comparison, ...]]"
"""Comparisons of each table of another policy than the default one, by its name."""

COMPARED = ("final_average", "adaptation", "retention", "kept_targets", "kept_share")
"""Metrics that are compared."""


@dataclass(frozen=True)
class Comparison:
    """One method with the default policy and with another one, over the seeds of both."""

    method: str
    seeds: int
    """Number of seeds that both have."""
    estimates: Mapping[str, tuple[Estimate, Estimate, Estimate]]
    """By metric: with the default policy, with the other one, and the second less the first, seed by seed."""


def compare_policies(rows: Sequence[Row], others: Sequence[Row]) -> tuple[Comparison, ...]:
    """Return the comparison of each method that both tables have.

    Args:
        rows: Rows of a scenario with the default policy.
        others: Rows of the same scenario with another policy, in the order of the result.
    """
    known = {row.method: row for row in rows}
    found = [_compare(known[row.method], row) for row in others if row.method in known]
    return tuple(one for one in found if one is not None)


def by_table(rows: Sequence[Row]) -> Comparisons:
    """Return the comparisons of each table of another policy, by its name."""
    tables = tables_of(rows)
    return {
        name: compare_policies(tables.get(scenario, ()), members)
        for name, members in tables.items()
        for scenario, policy in (parts_of(name),)
        if policy != DEFAULT_POLICY
    }


def _compare(row: Row, other: Row) -> Comparison | None:
    seeds = sorted(set(row.scores) & set(other.scores))
    if not seeds or row.runs[0].scores.layout != other.runs[0].scores.layout:
        return None
    runs = [[one.scores[seed] for seed in seeds] for one in (row, other)]
    estimates = {name: _estimates(name, f"{other.scenario} {row.method}", *runs) for name in COMPARED}
    return Comparison(row.method, len(seeds), estimates)


def _estimates(
    name: str, place: str, ours: list[Scores], theirs: list[Scores]
) -> tuple[Estimate, Estimate, Estimate]:
    """Return a metric of runs with the default policy, of runs with another one, and the difference."""
    metric = load_metric(name)

    def difference(of: Mapping[str, Rates]) -> Array:
        return metric.over_runs(of["theirs"]) - metric.over_runs(of["ours"])

    def generator(what: str) -> np.random.Generator:
        return row_generator(place, f"{name} {what}")

    def alone(what: str, runs: list[Scores]) -> Estimate:
        return bootstrap(
            lambda of: metric.over_runs(of[what]),
            {what: runs},
            generator(what),
            span=(metric.low, metric.high),
        )

    both = {"ours": ours, "theirs": theirs}
    apart = bootstrap(difference, both, generator("difference"), span=(-metric.high, metric.high))
    return alone("ours", ours), alone("theirs", theirs), apart
