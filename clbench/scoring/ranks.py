"""Ranks: rows of the leaderboard in order; rows that cannot be told apart share one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from clbench.base.errors import InputError
from clbench.scoring.intervals import MANY, Runs, needed_references, studentised_range_quantile
from clbench.scoring.layout import Array
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import load_metric, measure
from clbench.scoring.scores import rates_of

UNKNOWN_DEVIATION = 0.15
"""Standard deviation between seeds, assumed where no row has a second seed. It is twice the greatest in the
committed records, to be on the safe side."""


def deviation_of_differences(metric: str, rows: Iterable[Runs]) -> float | None:
    """Return the standard deviation of the difference of two rows from seed to seed.

    It is the root mean square over all pairs of rows, each over its common seeds. With it,
    `student_quantile(n - 1) * deviation / sqrt(n)` is half of the expected width of the interval of a
    difference over n seeds: rows that are nearer cannot be told apart.

    Args:
        metric: Name of a metric that needs no reference.
        rows: Runs by seed of each row.

    Returns:
        None if no two rows have two common seeds.
    """
    values = [{seed: measure(metric, run) for seed, run in runs.items()} for runs in rows]
    total, degrees = 0.0, 0
    for one, other in combinations(values, 2):
        pairs = [(one[seed], other[seed]) for seed in one.keys() & other.keys()]
        differences = np.array([a - b for a, b in pairs if a is not None and b is not None])
        if len(differences) > 1:
            total += float(((differences - differences.mean()) ** 2).sum())
            degrees += len(differences) - 1
    return math.sqrt(total / degrees) if degrees else None


# ---- tie groups --------------------------------------------------------------------------------------------


def tie_groups(
    metric: str, rows: Mapping[str, Runs], *, references: Mapping[str, Runs] | None = None
) -> dict[str, int]:
    """Return the rank of each row by `metric`, the best first: rows that cannot be told apart share one.

    From the best value down, a row joins the group of the row above unless it is told apart from the first
    row of that group; then it begins the next one. A group's rank counts the rows above it, as in sport: 1,
    1, 3. So each rank after the first stands for a tested statement: this row is worse than the first row of
    the group above. It need not be worse than the last row of that group: two rows may both be like the one
    between them, and unlike each other.

    Rows are compared over their common seeds, which share pretrained policy and initial states. A difference
    tells them apart if it exceeds the largest of three standard errors, times Tukey's factor for so many
    rows:

    1. from all rows together: the variation of runs around the means of their row and seed;
    2. from the two rows alone: the variation of their difference between seeds, if there are several;
    3. from the episodes: the jackknife over them, since seeds may agree by chance.

    So at most 5 % of the boards of equal methods are split; `docs/guide/statistics.md` has the figures. Rows
    without a common seed are compared by the variation of runs around the mean of their row. Where no row has
    a second seed, a deviation of `UNKNOWN_DEVIATION` is assumed: only distant rows are told apart.

    Args:
        metric: Name of a metric.
        rows: Runs by seed of each row.
        references: Runs of reference methods by name and seed.

    Returns:
        Ranks by row, the best row first. Rows without a value have none.

    Raises:
        UnknownNameError: The metric is unknown.
        InputError: It says nothing of better or worse, or the runs are of different tasks, episodes,
            evaluation points or questions.
    """
    wanted = load_metric(metric)
    if wanted.higher_is_better is None:
        raise InputError(f"{metric} says nothing of better or worse: no row is ranked by it.")
    sign = 1.0 if wanted.higher_is_better else -1.0
    seeds = sorted({seed for runs in rows.values() for seed in runs})
    if len({run.layout for runs in rows.values() for run in runs.values()}) > 1:
        raise InputError("Only runs of the same tasks, episodes, evaluation points and questions compare.")
    entries = []
    for name, runs in rows.items():
        if not runs:
            continue
        others = {
            key: them for key, them in (references or {}).items() if key != name or wanted.compares_itself
        }
        value, of_seeds, without_episode = _measured(wanted, runs, seeds, others)
        if math.isfinite(value):
            entries.append((-sign * value, name, sign * of_seeds, sign * without_episode))
    entries.sort(key=lambda entry: entry[:2])
    if not entries:
        return {}
    found = ranks(np.stack([entry[2] for entry in entries]), np.stack([entry[3] for entry in entries]))
    return {entry[1]: rank for entry, rank in zip(entries, found, strict=True)}


def ranks(values: Array, without_episode: Array) -> list[int]:
    """Return the ranks of several rows, the best first, by the rule of `tie_groups`.

    Args:
        values: Higher is better, NaN where a row lacks a seed, (rows, seeds).
        without_episode: The same if the first, the second, ... episode of all tasks is left out,
            (rows, seeds, episodes).
    """
    board, found, first = _Board(values, without_episode), [1], 0
    for row in range(1, len(values)):
        if board.tells_apart(first, row):
            first = row
        found.append(first + 1)
    return found


@dataclass(frozen=True, eq=False)
class _Board:
    """Rows to rank; the arrays are the arguments of `ranks`."""

    values: Array
    without_episode: Array

    def tells_apart(self, better: int, worse: int) -> bool:
        """Return whether one row is certainly better than another."""
        known = np.isfinite(self.values)
        common = known[better] & known[worse]
        count = np.count_nonzero(common)
        if count:
            differences = (self.values[better] - self.values[worse])[common]
            of_all, degrees = self.paired
            own = differences.var(ddof=1) / count if count > 1 else 0.0
            episodes = (self.without_episode[better] - self.without_episode[worse])[common]
            variance = max(2 * of_all / count, own, _jackknife(episodes).sum() / count**2)
            difference = differences.mean()
        else:
            of_all, degrees = self.unpaired
            variance = of_all * (1 / known[better].sum() + 1 / known[worse].sum())
            difference = np.nanmean(self.values[better]) - np.nanmean(self.values[worse])
        factor = studentised_range_quantile(len(self.values), degrees) / math.sqrt(2)
        # Values are quotients of whole numbers: equal ones may differ in the last bit.
        return bool(difference > factor * math.sqrt(variance) + 1e-9)

    @cached_property
    def paired(self) -> tuple[float, int]:
        """Variance of a run's value around row and seed, and its degrees of freedom."""
        rows, seeds = np.nonzero(np.isfinite(self.values))
        values = self.values[rows, seeds]
        design = np.concatenate([np.eye(len(self.values))[rows], np.eye(self.values.shape[1])[seeds]], axis=1)
        effects, _, rank, _ = np.linalg.lstsq(design, values)
        return self._pooled(values - design @ effects, len(values) - int(rank))

    @cached_property
    def unpaired(self) -> tuple[float, int]:
        """Variance of a run's value around its row, and its degrees of freedom."""
        deviations = self.values - np.nanmean(self.values, axis=1, keepdims=True)
        known = np.isfinite(deviations)
        return self._pooled(deviations[known], int(known.sum()) - len(deviations))

    def _pooled(self, deviations: Array, degrees: int) -> tuple[float, int]:
        if degrees:
            return float((deviations**2).sum()) / degrees, degrees
        known = np.isfinite(self.values)
        return UNKNOWN_DEVIATION**2 + float(_jackknife(self.without_episode[known]).mean()), MANY


def _jackknife(without_episode: Array) -> Array:
    """Return the jackknife variances (...) of values (..., episodes), each without one of the episodes."""
    return np.asarray(np.nan_to_num((without_episode.shape[-1] - 1) * without_episode.var(axis=-1)))


def _measured(
    metric: Metric, runs: Runs, seeds: Sequence[int], references: Mapping[str, Runs]
) -> tuple[float, Array, Array]:
    """Return a row's value, its runs' values (seeds,), and these without each episode (seeds, episodes)."""
    own = [seed for seed in seeds if seed in runs]
    needed = needed_references([metric], own, references)
    ordered = [runs[seed] for seed in own]
    whole = rates_of(ordered, needed)
    episodes = len(whole.layout.episodes)
    # Weights that add up to the number of episodes; a single one cannot be left out.
    weights = (1 - np.eye(episodes)) * episodes / (episodes - 1) if episodes > 1 else np.ones((1, 1))
    counts = np.broadcast_to(weights[:, None, :], (episodes, len(whole.layout.tasks), episodes))
    of_seeds = np.full(len(seeds), np.nan)
    without_episode = np.full((len(seeds), episodes), np.nan)
    for number, run in enumerate(ordered):
        place = seeds.index(own[number])
        rates = replace(
            run.rates(counts), references={name: them[number].rates(counts) for name, them in needed.items()}
        )
        without_episode[place] = metric.over_runs(rates.each(lambda array: array[:, None]))
    of_seeds[[seeds.index(seed) for seed in own]] = metric.over_runs(whole.each(lambda array: array[:, None]))
    return float(metric.over_runs(whole)), of_seeds, without_episode
