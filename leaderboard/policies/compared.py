"""Does forgetting depend on the policy? The same methods and seeds with two kinds of policies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from clbench.records.paths import table_parts
from clbench.scoring.intervals import Estimate, estimate, paired_difference, row_generator
from clbench.spec.policies import DEFAULT_POLICY

from ..board.rows import Row
from ..board.summary import tables_of

Comparisons: TypeAlias = "Mapping[str, tuple[Comparison, ...]]"
"""Comparisons of each table of another policy than the default one, by its name."""

METRICS_COMPARED = ("final_average", "adaptation", "retention", "kept_targets", "kept_share")
"""Metrics that are compared."""


@dataclass(frozen=True)
class Comparison:
    """One method with the default policy and with another one, over the seeds of both."""

    method: str
    seeds: int
    """Number of seeds that both have."""
    estimates: Mapping[str, tuple[Estimate, Estimate, Estimate]]
    """By metric: with the default policy, with the other one, and their difference, paired by seed."""


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
        for scenario, policy in (table_parts(name),)
        if policy != DEFAULT_POLICY
    }


def _compare(row: Row, other: Row) -> Comparison | None:
    seeds = sorted(set(row.scores) & set(other.scores))
    if not seeds or row.runs[0].scores.layout != other.runs[0].scores.layout:
        return None
    ours, theirs = ({seed: one.scores[seed] for seed in seeds} for one in (row, other))

    def generator(what: str) -> np.random.Generator:
        return row_generator(f"{other.scenario} {row.method}", what)

    alone = [
        estimate(METRICS_COMPARED, runs, generator(what))
        for what, runs in (("ours", ours), ("theirs", theirs))
    ]
    estimates = {
        name: (
            alone[0][name],
            alone[1][name],
            paired_difference(name, theirs, ours, generator(f"{name} difference")),
        )
        for name in METRICS_COMPARED
    }
    return Comparison(row.method, len(seeds), estimates)
