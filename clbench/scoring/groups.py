"""Groups of rows of the leaderboard that are not told apart, shown by letters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, count

import numpy as np
from numpy.typing import NDArray

from clbench.base.errors import InputError
from clbench.scoring.intervals import MANY, Runs, studentised_range_quantile
from clbench.scoring.layout import Array
from clbench.scoring.metric import TIE, Metric
from clbench.scoring.metrics import METRICS, load_metric, measure
from clbench.scoring.rates import check_same
from clbench.scoring.scores import rates_of

UNKNOWN_DEVIATION = 0.2
"""Standard deviation between seeds as a share of the range of a metric, assumed where no row has a second
seed. To be on the safe side, it is above the greatest deviation of the final average on the boards, 0.15
(stop_gradient on FetchKnowledge-v1). A metric without two bounds then tells no rows apart."""


def deviation_of_differences(metric: str, rows: Iterable[Runs]) -> float | None:
    """Return the standard deviation, from seed to seed, of the difference between two rows.

    It is the root mean square over all pairs of rows, each over its common seeds. With it,
    `student_quantile(n - 1) * deviation / sqrt(n)` is half of the expected width of the interval of one
    difference over n seeds. Telling two of several rows apart takes more, see `least_difference`.

    Args:
        metric: Name of a metric that needs no reference.
        rows: Runs by seed of each row.

    Returns:
        None if no two rows have two common seeds.

    Raises:
        UnknownNameError: The metric is unknown.
        InputError: It needs a reference, or the runs are of different tasks, episodes, evaluation points or
            questions.
    """
    rows = list(rows)
    _check(load_metric(metric), rows)
    values = [{seed: measure(metric, run) for seed, run in runs.items()} for runs in rows]
    total, degrees = 0.0, 0
    for one, other in combinations(values, 2):
        pairs = [(one[seed], other[seed]) for seed in one.keys() & other.keys()]
        differences = np.array([a - b for a, b in pairs if a is not None and b is not None])
        if len(differences) > 1:
            total += float(((differences - differences.mean()) ** 2).sum())
            degrees += len(differences) - 1
    return math.sqrt(total / degrees) if degrees else None


def least_difference(deviation: float, rows: int, seeds: int) -> float:
    """Return the difference beyond which Tukey's test tells two of several equally noisy rows apart.

    A true difference of this size shows in somewhat less than half of the boards.

    Args:
        deviation: Standard deviation of the difference of two rows, see `deviation_of_differences`.
        rows: Number of rows, two or more.
        seeds: Number of seeds that all rows have, two or more.
    """
    factor = studentised_range_quantile(rows, (rows - 1) * (seeds - 1)) / math.sqrt(2)
    return factor * deviation / math.sqrt(seeds)


def _check(metric: Metric, rows: Iterable[Runs]) -> None:
    """Refuse a metric that needs a reference, and rows that cannot be compared.

    Raises:
        InputError: One of these.
    """
    if metric.references:
        raise InputError(
            f"{metric.name} compares a row with {' and '.join(metric.references)}, so it cannot "
            "order rows. Choose a metric that needs no reference, such as final_average."
        )
    layouts = [run.layout for runs in rows for run in runs.values()]
    if layouts:
        check_same(layouts)


# ---- groups ------------------------------------------------------------------------------------------------


def groups(metric: str, rows: Mapping[str, Runs]) -> dict[str, str]:
    """Return the groups of each row, the best row first: two rows share a letter if they are not told apart.

    A row with the letters "ab" belongs to two groups. It is not told apart from the other members of either,
    but some members of one are told apart from some of the other: similarity is not transitive. Ranks would
    hide this. They would also depend on noise: of two rows with one value, the noisier row would not differ
    from the best row and would rank high, and the other row would not. Here both are placed by their value,
    and the noisier row has more letters.

    Rows are compared over their common seeds, which share the pretrained policy and the initial states. A
    difference tells two rows apart if it exceeds the largest of three standard errors, times Tukey's factor
    for this number of rows:

    1. from all rows together: the variation of runs around the means of their row and seed. With few seeds
       this error is far more certain than the next one, and a row whose runs agree by chance gains nothing;
    2. from the two rows alone: the variation of their difference between seeds, if there are several. Some
       rows may vary more than others;
    3. from the episodes: the jackknife over them, since all rows may agree by chance.

    About 5 % of the boards of equal methods thus have more than one group, and up to 12 % where one method
    varies far more than the others: `docs/guide/statistics.md` has the figures. Rows without a common seed
    are compared by the variation of runs around the mean of their row, and so are all rows if no two have
    two common seeds. Where no row has a second seed, a deviation of `UNKNOWN_DEVIATION` is assumed: only
    distant rows are told apart.

    Args:
        metric: Name of a metric.
        rows: Runs by seed of each row.

    Returns:
        Letters by row, the best row first; it is in group a. Rows without a value have none.

    Raises:
        UnknownNameError: The metric is unknown.
        InputError: It needs a reference or says nothing about better or worse, or the runs are of different
            tasks, episodes, evaluation points or questions.
    """
    names, board = _board_of(metric, rows)
    return dict(zip(names, letter_display(board.apart()), strict=True))


def differences_needed(metric: str, rows: Mapping[str, Runs], base: str) -> dict[str, float]:
    """Return by how much each other row would have to differ from row `base` to be told apart from it.

    Args:
        metric: Name of a metric.
        rows: Runs by seed of each row.
        base: Name of one of the rows.

    Returns:
        The differences of the rows that have a value, none if `base` has no value.

    Raises:
        UnknownNameError: The metric is unknown.
        InputError: As for `groups`.
    """
    names, board = _board_of(metric, rows)
    if base not in names:
        return {}
    place = names.index(base)
    pairs = {name: sorted((place, other)) for other, name in enumerate(names) if other != place}
    return {name: board.compare(*pair)[1] for name, pair in pairs.items()}


def _board_of(metric: str, rows: Mapping[str, Runs]) -> tuple[list[str], _Board]:
    """Return the names of the rows with a value, the best first, and a `_Board` that compares them."""
    wanted = load_metric(metric)
    if wanted.higher_is_better is None:
        known = ", ".join(
            name for name, one in METRICS.items() if one.higher_is_better is not None and not one.references
        )
        raise InputError(
            f"Rows cannot be ordered by {metric}, for which neither high nor low values are better. Metrics "
            f"that order rows: {known}."
        )
    _check(wanted, rows.values())
    sign = 1.0 if wanted.higher_is_better else -1.0
    seeds = sorted({seed for runs in rows.values() for seed in runs})
    entries = []
    for name, runs in rows.items():
        if not runs:
            continue
        value, of_seeds, without_episode = _measured(wanted, runs, seeds)
        if math.isfinite(value):
            entries.append((-sign * value, name, sign * of_seeds, sign * without_episode))
    entries.sort(key=lambda entry: entry[:2])
    values, without_episode = (np.array([entry[number] for entry in entries]) for number in (2, 3))
    return [entry[1] for entry in entries], _Board(values, without_episode, wanted.high - wanted.low)


def told_apart(values: Array, without_episode: Array) -> NDArray[np.bool_]:
    """Return which rows are told apart by the test of `groups`, (rows, rows), symmetric.

    Rows whose order on their common seeds is not the order of their values are not told apart.

    Args:
        values: Values of the runs, higher is better, the best row first, (rows, seeds). NaN where a row lacks
            a seed.
        without_episode: The same if the first, the second, ... episode of all tasks is left out,
            (rows, seeds, episodes).
    """
    return _Board(values, without_episode).apart()


def letter_display(apart: NDArray[np.bool_]) -> list[str]:
    """Return letters for each row such that two rows share one if, and only if, they are not told apart.

    The algorithm inserts and absorbs: all rows begin in one group. Each pair that is told apart splits the
    groups that have both, and a group inside another one is dropped. Piepho 2004, doi 10.1198/1061860043515.

    Args:
        apart: Which rows are told apart, (rows, rows), symmetric.

    Returns:
        Letters by row, in alphabetic order. Groups are named in the order of their first rows.
    """
    found = [frozenset(range(len(apart)))]
    for pair in combinations(range(len(apart)), 2):
        if not apart[pair]:
            continue
        split = [group for group in found if group.issuperset(pair)]
        found = [group for group in found if not group.issuperset(pair)]
        for part in (group - {row} for group in split for row in pair):
            if not any(part <= group for group in found):
                found.append(part)
    # a to z, and then other small letters: no board has that many groups.
    alphabet = filter(str.islower, map(chr, count(ord("a"))))
    named = list(zip(alphabet, sorted(found, key=sorted), strict=False))
    return ["".join(letter for letter, group in named if row in group) for row in range(len(apart))]


@dataclass(frozen=True, eq=False)
class _Board:
    """Rows to compare; the arrays are the arguments of `told_apart`."""

    values: Array
    without_episode: Array
    reach: float = 1.0
    """Difference between the greatest and the least value of the metric."""

    def apart(self) -> NDArray[np.bool_]:
        """Return which rows are told apart, (rows, rows), symmetric."""
        found = np.zeros((len(self.values), len(self.values)), dtype=np.bool_)
        for better, worse in combinations(range(len(self.values)), 2):
            difference, needed = self.compare(better, worse)
            found[better, worse] = found[worse, better] = difference > needed + TIE
        return found

    def compare(self, better: int, worse: int) -> tuple[float, float]:
        """Return the difference of two rows, and the difference beyond which the test tells them apart."""
        known = np.isfinite(self.values)
        common = known[better] & known[worse]
        number = np.count_nonzero(common)
        if number:
            differences = (self.values[better] - self.values[worse])[common]
            of_all, degrees = self.paired
            own = differences.var(ddof=1) / number if number > 1 else 0.0
            episodes = (self.without_episode[better] - self.without_episode[worse])[common]
            variance = max(2 * of_all / number, own, _jackknife(episodes).sum() / number**2)
            difference = differences.mean()
        else:
            of_all, degrees = self.unpaired
            variance = of_all * (1 / known[better].sum() + 1 / known[worse].sum())
            difference = np.nanmean(self.values[better]) - np.nanmean(self.values[worse])
        factor = studentised_range_quantile(len(self.values), degrees) / math.sqrt(2)
        return float(difference), factor * math.sqrt(variance)

    @cached_property
    def paired(self) -> tuple[float, int]:
        """Variance of a run's value around row and seed, and its degrees of freedom."""
        rows, seeds = np.nonzero(np.isfinite(self.values))
        values = self.values[rows, seeds]
        design = np.concatenate([np.eye(len(self.values))[rows], np.eye(self.values.shape[1])[seeds]], axis=1)
        effects, _, rank, _ = np.linalg.lstsq(design, values)
        degrees = len(values) - int(rank)
        return self._pooled(values - design @ effects, degrees) if degrees else self.unpaired

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
        unknown = (UNKNOWN_DEVIATION * self.reach) ** 2
        return unknown + float(_jackknife(self.without_episode[known]).mean()), MANY


def _jackknife(without_episode: Array) -> Array:
    """Return the jackknife variances (...) of values (..., episodes), each without one of the episodes."""
    return np.asarray(np.nan_to_num((without_episode.shape[-1] - 1) * without_episode.var(axis=-1)))


def _measured(metric: Metric, runs: Runs, seeds: Sequence[int]) -> tuple[float, Array, Array]:
    """Return a row's value, its runs' values (seeds,), and these without each episode (seeds, episodes)."""
    own = [seed for seed in seeds if seed in runs]
    whole = rates_of([runs[seed] for seed in own], {})
    episodes = len(whole.layout.episodes)
    # Weights that add up to the number of episodes; a single one cannot be left out.
    weights = (1 - np.eye(episodes)) * episodes / (episodes - 1) if episodes > 1 else np.ones((1, 1))
    counts = np.broadcast_to(weights[:, None, :], (episodes, len(whole.layout.tasks), episodes))
    of_seeds = np.full(len(seeds), np.nan)
    without_episode = np.full((len(seeds), episodes), np.nan)
    for seed in own:
        without_episode[seeds.index(seed)] = metric.function(runs[seed].rates(counts))
    of_seeds[[seeds.index(seed) for seed in own]] = metric.function(whole)
    return float(metric.over_runs(whole)), of_seeds, without_episode
