"""Ranks under each definition of forgetting, transfer or final average."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from clbench.metrics.definitions import DEFINITIONS
from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS

from ...board.rows import Row
from ...board.summary import GAIN
from ..format import title_of

FAMILIES: Mapping[str, str] = {"forgetting": "forgetting", "transfer": "transfer", "average": "final average"}
"""Titles of the families of `DEFINITIONS` that papers define in several ways."""

OF_CURVES: Mapping[str, tuple[str, ...]] = {
    "transfer": ("forward_transfer", "forward_transfer_libero"),
    "average": ("area_under_curve_libero",),
}
"""Members of these families that `DEFINITIONS` lacks: a success matrix has no learning curves."""


@dataclass(frozen=True)
class Family:
    """Definitions of one subject, side by side."""

    name: str
    """Title of the family."""
    metrics: tuple[Metric, ...]
    """Definitions for which a row has a value."""
    ranks: Mapping[str, tuple[int | None, ...]]
    """Ranks under each definition by method; equal values share a rank, None without a value."""
    depends: frozenset[str]
    """Methods whose rank depends on the definition and not on chance: two definitions put the method and
    another one in opposite orders, and the intervals overlap under neither."""
    disagreement: str
    """Sentence on the two definitions that disagree most."""


def families(rows: Sequence[Row]) -> list[Family]:
    """Return the families of definitions with the ranks of `rows` of one scenario."""
    found = []
    for family, title in FAMILIES.items():
        members = {metric for metric, one in DEFINITIONS.items() if one.family == family}
        members |= set(OF_CURVES.get(family, ()))
        # the gain is a difference of final averages, not a definition of its own
        metrics = [one for name, one in METRICS.items() if name in members and name != GAIN]
        metrics = [one for one in metrics if one.higher_is_better is not None]
        metrics = [one for one in metrics if any(row.estimates[one.name].value is not None for row in rows)]
        if len(metrics) < 2 or len(rows) < 2:
            continue
        by_metric = [_ranks(metric, rows) for metric in metrics]
        ranks = {row.method: tuple(ranks[row.method] for ranks in by_metric) for row in rows}
        found.append(Family(title, tuple(metrics), ranks, *_disagreements(metrics, rows)))
    return found


def _ranks(metric: Metric, rows: Sequence[Row]) -> dict[str, int | None]:
    """Return the rank of each method: one more than the number of better methods."""
    values = {row.method: row.estimates[metric.name].value for row in rows}
    return {
        method: None
        if own is None
        else 1 + sum(metric.is_ahead(other, own) is True for other in values.values())
        for method, own in values.items()
    }


def _disagreements(metrics: Iterable[Metric], rows: Sequence[Row]) -> tuple[frozenset[str], str]:
    """Return the methods whose rank depends on the definition, and which two definitions disagree most."""
    pairs = list(combinations(rows, 2))
    depends: set[str] = set()
    worst, clear, names = 0, 0, ("", "")
    for first, second in combinations(metrics, 2):
        opposed = [
            pair for pair in pairs if {_is_ahead(one, pair) for one in (first, second)} == {True, False}
        ]
        apart = [pair for pair in opposed if all(_apart(*_values(one, pair)) for one in (first, second))]
        depends.update(row.method for pair in apart for row in pair)
        if len(opposed) > worst:
            worst, clear, names = len(opposed), len(apart), (first.name, second.name)
    if not worst:
        return frozenset(), "No two definitions put two methods in opposite orders."
    return frozenset(depends), (
        f"“{title_of(names[0])}” and “{title_of(names[1])}” disagree most. They put {worst} of {len(pairs)} "
        f"pairs of methods in opposite orders; for {clear} of these, the intervals do not overlap under "
        "either definition."
    )


def _is_ahead(metric: Metric, pair: tuple[Row, Row]) -> bool | None:
    return metric.is_ahead(*(one.value for one in _values(metric, pair)))


def _values(metric: Metric, pair: tuple[Row, Row]) -> tuple[Estimate, Estimate]:
    return pair[0].estimates[metric.name], pair[1].estimates[metric.name]


def _apart(one: Estimate, other: Estimate) -> bool:
    """Return whether two intervals do not overlap."""
    if one.low is None or one.high is None or other.low is None or other.high is None:
        return False
    return one.low > other.high or other.low > one.high
