"""Intervals and paired differences that follow how a benchmark row comes about.

A row's number varies because another seed would have given another sequence of policies, and because other
initial states would have met it. A seed is one whole run, from the pretrained policy to the last stage: its
tasks share a policy. What the numbers of several seeds differ by comes from both, so that

1. with two or more seeds the interval is Student's over the seeds. Its standard error is that of the
   jackknife, which leaves out one whole seed at a time; its degrees of freedom are the seeds less one. A
   quantity with a least and a greatest value is taken on the scale of the arcsine of the root, as is usual
   for rates: the interval stays inside the range, and reaches farther towards the middle of it, where the
   truth more often is;
2. with one seed, or where the seeds agree exactly, nothing tells how seeds differ, and the interval is of
   episodes: the percentiles of replicates in which every run keeps its policy and meets episodes drawn with
   replacement, for each task. All stages and evaluation points of a run get the same ones, and so do runs of
   other methods with this seed: they met the same initial states. Where fewer episodes are run, at the points
   before the end of a stage, the rate is the mean over those drawn among them. Right answers are drawn from a
   binomial for each stage and kind of question, since records hold counts only.

Tasks are fixed: a scenario is those tasks. Fixed too is what was chosen on the validation episodes of a run,
as the points of `retention_at_matched_adaptation`: the interval says nothing of the luck of the choice. How
often these intervals of 95 % hold the truth, and what they cannot do, stands in `docs/guide/statistics.md`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from clbench.base.errors import InputError
from clbench.scoring.layout import Array
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import load_metric
from clbench.scoring.rates import Rates, combine
from clbench.scoring.scores import Scores, rates_of
from clbench.spec.scenario import Scenario

Runs = Mapping[int, Scores]
"""Runs of one method on one scenario, by seed."""

REPLICATES = 2000
"""Draws behind an interval of episodes."""
LEVEL = 95.0
"""Per cent of the intervals that are to hold the truth."""
SEED_DEVIATION = 0.05
"""Standard deviation of a success rate between seeds that is assumed where none is measured. In the committed
records of Fetch-v0 that of retention, beyond the noise of episodes, is 0.037 (root mean square over methods)
and at most 0.07."""
MANY = 10**6
"""Degrees of freedom of a standard deviation that is known."""


@dataclass(frozen=True)
class Estimate:
    """A value with its interval; None where it cannot be computed."""

    value: float | None
    """The value computed from all episodes, each counted once."""
    low: float | None
    """Lower end of the interval."""
    high: float | None
    """Upper end of the interval."""


class Span(NamedTuple):
    """The least and the greatest value that a quantity can have."""

    low: float = -math.inf
    high: float = math.inf

    def angles(self, values: Array) -> Array:
        """Return the arcsine of the root of where `values` lie in a finite span, else the values."""
        if not math.isfinite(self.high - self.low):
            return values
        return np.asarray(np.arcsin(np.sqrt(np.clip((values - self.low) / (self.high - self.low), 0, 1))))

    def values(self, angles: Array) -> Array:
        """Return the values in the span that have these angles, or are nearest to having them."""
        if not math.isfinite(self.high - self.low):
            return np.clip(angles, self.low, self.high)
        return np.asarray(self.low + (self.high - self.low) * np.sin(np.clip(angles, 0, math.pi / 2)) ** 2)


def row_generator(scenario: str, method: str) -> np.random.Generator:
    """Return the generator of a table row, the same whenever and wherever the row is drawn."""
    digest = hashlib.sha256(f"{scenario}\n{method}".encode(errors="backslashreplace")).digest()
    return np.random.default_rng(int.from_bytes(digest, "big"))


def estimate(
    metrics: Iterable[str],
    runs: Runs,
    generator: np.random.Generator,
    *,
    references: Mapping[str, Runs] | None = None,
    replicates: int = REPLICATES,
) -> dict[str, Estimate]:
    """Return the value and interval of each of `metrics` over `runs`.

    Args:
        metrics: Names of metrics.
        runs: The runs by seed. One seed: the interval is of episodes and answers alone.
        generator: Source of the draws.
        references: Runs of reference methods by name and seed. One that lacks a seed of `runs` counts as
            missing: its metrics have no value.
        replicates: How many draws.

    Raises:
        LookupError: A metric is unknown.
        ValueError: The runs are of different tasks, episodes, evaluation points or questions.
    """
    wanted = [load_metric(name) for name in metrics]
    if not runs:
        return {metric.name: Estimate(None, None, None) for metric in wanted}
    seeds = sorted(runs)
    methods = [[runs[seed] for seed in seeds]]
    # Metrics with the same references share their draws; most have none, and draws of episodes cost most.
    samples = {
        names: _Samples(methods, needed_references([one], seeds, references), generator, replicates)
        for names, one in {one.references: one for one in wanted}.items()
    }

    def over_runs(metric: Metric) -> _Quantity:
        return lambda rates: metric.over_runs(rates[0])

    return {
        one.name: samples[one.references].estimate(over_runs(one), Span(one.low, one.high)) for one in wanted
    }


def paired_difference(
    metric: str,
    runs: Runs,
    others: Runs,
    generator: np.random.Generator,
    *,
    references: Mapping[str, Runs] | None = None,
    replicates: int = REPLICATES,
) -> Estimate:
    """Return the value of `metric` for `runs` minus that for `others`, over the seeds that both have.

    Seeds are left out, and episodes drawn, for both at once, so that what is hard for both cancels. Right
    answers are drawn apart, since records do not tell which questions they were: with one seed, differences
    of answers are a little too wide.

    Args:
        metric: Name of a metric.
        runs: Runs of one method by seed.
        others: Runs of the other method by seed.
        generator: Source of the draws.
        references: Runs of reference methods by name and seed.
        replicates: How many draws.

    Raises:
        LookupError: The metric is unknown.
        ValueError: The runs are of different tasks, episodes, evaluation points or questions.
    """
    wanted = load_metric(metric)
    seeds = sorted(set(runs) & set(others))
    if not seeds:
        return Estimate(None, None, None)
    methods = [[them[seed] for seed in seeds] for them in (runs, others)]
    samples = _Samples(methods, needed_references([wanted], seeds, references), generator, replicates)
    reach = wanted.high - wanted.low
    return samples.estimate(
        lambda rates: wanted.over_runs(rates[0]) - wanted.over_runs(rates[1]), Span(-reach, reach)
    )


def bootstrap(
    quantity: Callable[[Mapping[str, Rates]], Array],
    runs: Mapping[str, Sequence[Scores]],
    generator: np.random.Generator,
    *,
    span: tuple[float, float] = (-math.inf, math.inf),
    replicates: int = REPLICATES,
) -> Estimate:
    """Return any quantity of the success rates of several methods, with its interval.

    Args:
        quantity: Maps the rates of each method, with batch axes (..., runs), to values (...).
        runs: Runs of each method: the same seeds in the same order. All get the same draws.
        generator: Source of the draws.
        span: Least and greatest possible value.
        replicates: How many draws.

    Raises:
        ValueError: The runs are of different tasks, episodes, evaluation points or questions.
    """
    samples = _Samples(list(runs.values()), {}, generator, replicates)
    return samples.estimate(lambda rates: quantity(dict(zip(runs, rates, strict=True))), Span(*span))


def interval(
    value: float,
    without_one: Array,
    other_episodes: Callable[[], Array] | None = None,
    span: tuple[float, float] = (-math.inf, math.inf),
) -> Estimate:
    """Return a value with its interval.

    Args:
        value: The value of all seeds.
        without_one: The values if one seed is left out, (seeds,); with one seed there are none, (0,).
        other_episodes: Returns the values with episodes drawn anew, (replicates,). It is asked only if the
            seeds tell nothing; without it there is no interval then.
        span: Least and greatest possible value.
    """
    if not math.isfinite(value):
        return Estimate(None, None, None)
    # A metric that has no value without one of the seeds, or with other episodes, has no honest interval.
    if not np.isfinite(without_one).all():
        return Estimate(value, None, None)
    # Equal values may differ in the last bits.
    if np.abs(without_one - value).max(initial=0.0) > 1e-12 * max(1.0, abs(value)):
        scale, degrees = Span(*span), len(without_one) - 1
        reach = student_quantile(degrees) * math.sqrt(degrees) * scale.angles(without_one).std()
        low, high = scale.values(scale.angles(np.array(value)) + np.array([-reach, reach]))
    else:
        replicates = other_episodes() if other_episodes else np.array([math.nan])
        if not np.isfinite(replicates).all():
            return Estimate(value, None, None)
        low, high = np.percentile(replicates, [50 - LEVEL / 2, 50 + LEVEL / 2])
    return Estimate(value, min(float(low), value), max(float(high), value))


def needed_references(
    metrics: Iterable[Metric], seeds: Sequence[int], references: Mapping[str, Runs] | None
) -> dict[str, list[Scores]]:
    """Return the references that `metrics` need and that have all `seeds`, in the order of these."""
    names = sorted({name for metric in metrics for name in metric.references})
    found = {name: references[name] for name in names if name in references} if references else {}
    return {name: [runs[seed] for seed in seeds] for name, runs in found.items() if set(seeds) <= set(runs)}


def draw_episodes(shape: tuple[int, ...], episodes: int, generator: np.random.Generator) -> Array:
    """Return how often each episode is drawn, with replacement, in each cell of `shape`: (*shape, episodes).

    Args:
        shape: Of the cells.
        episodes: How many there are, and are drawn for a cell.
        generator: Source of the draws.
    """
    drawn = generator.integers(episodes, size=(math.prod(shape), episodes))
    # Counted in one call: the episodes of each cell get numbers of their own.
    drawn += np.arange(len(drawn))[:, None] * episodes
    counts = np.bincount(drawn.ravel(), minlength=drawn.size)
    return counts.reshape(*shape, episodes).astype(np.float64)


# ---- rates of the runs, as they are and as they might have been --------------------------------------------

_Quantity = Callable[[Sequence[Rates]], Array]
"""Maps the rates of each method, with batch axes (..., runs), to values (...)."""


@dataclass(frozen=True, eq=False)
class _Samples:
    """Runs of several methods with the same seeds, and what might have been in their place."""

    methods: Sequence[Sequence[Scores]]
    """Runs of each method, in the order of the seeds."""
    references: Mapping[str, Sequence[Scores]]
    """Runs of reference methods, in the same order."""
    generator: np.random.Generator
    """Source of the draws."""
    replicates: int
    """How many draws."""

    def __post_init__(self) -> None:
        every = (*self.methods, *self.references.values())
        if len({run.layout for runs in every for run in runs}) != 1:
            raise InputError(
                "Only runs of the same tasks, episodes, evaluation points and questions compare."
            )

    def estimate(self, quantity: _Quantity, span: Span) -> Estimate:
        """Return a quantity with its interval."""
        return interval(
            float(quantity(self.whole)),
            quantity(self.without_one) if len(self.methods[0]) > 1 else np.zeros(0),
            lambda: quantity(self.other_episodes),
            span,
        )

    @cached_property
    def whole(self) -> list[Rates]:
        """The runs as they are, (runs,)."""
        return [rates_of(runs, self.references) for runs in self.methods]

    @cached_property
    def without_one(self) -> list[Rates]:
        """All runs but one, for each one, (runs, runs - 1)."""
        numbers = np.arange(len(self.methods[0]))
        others = np.array([np.delete(numbers, one) for one in numbers])
        return [rates.each(lambda array: array[others]) for rates in self.whole]

    @cached_property
    def other_episodes(self) -> list[Rates]:
        """The runs with episodes and answers drawn anew, (replicates, runs)."""
        layout = self.methods[0][0].layout
        shape = (self.replicates, len(self.methods[0]), len(layout.tasks))
        counts = draw_episodes(shape, len(layout.episodes), self.generator)
        methods = [self._drawn(runs, counts) for runs in self.methods]
        references = {name: self._drawn(runs, counts) for name, runs in self.references.items()}
        return [replace(rates, references=references) for rates in methods]

    def _drawn(self, runs: Sequence[Scores], counts: Array) -> Rates:
        """Return the rates of `runs` over `counts` of the episodes, (replicates, runs, tasks, episodes)."""
        parts = [run.rates(counts[:, number]) for number, run in enumerate(runs)]
        rates = combine(parts, lambda arrays: np.stack(arrays, axis=1))
        share = rates.correct / np.maximum(rates.asked, 1)
        correct = self.generator.binomial(rates.asked.astype(np.int64), share)
        return replace(rates, correct=correct.astype(np.float64))


# ---- quantiles ---------------------------------------------------------------------------------------------


def student_quantile(degrees: int) -> float:
    """Return what Student's t with these degrees of freedom exceeds, up or down, in 5 % of the cases."""
    return studentised_range_quantile(2, degrees) / math.sqrt(2)


@cache
def studentised_range_quantile(count: int, degrees: int) -> float:
    """Return what Tukey's studentised range exceeds in 5 % of the cases.

    It is the range of `count` normal numbers, divided by an estimate of their standard deviation with these
    degrees of freedom. It is integrated numerically, true to four digits: SciPy is no dependency.

    Args:
        count: How many numbers, two or more.
        degrees: Degrees of freedom, one or more.
    """
    step, normal = 0.02, NormalDist()
    places, widths = np.arange(-400, 401), np.arange(801)
    below = np.array([normal.cdf(step * place) for place in range(-1200, 401)])
    density = np.exp(-((step * places) ** 2) / 2) / math.sqrt(2 * math.pi)
    # The greatest number is at one of the places, all others are less than a width below.
    inside = below[places + 1200] - below[places - widths[:, None] + 1200]
    narrower = count * step * (density * inside ** (count - 1)).sum(axis=1)
    reach = 10 / math.sqrt(2 * degrees)
    edges = np.linspace(max(0.0, 1 - reach), 1 + reach, 4001)
    deviations = (edges[1:] + edges[:-1]) / 2
    logarithms = (degrees - 1) * np.log(deviations) - degrees * deviations**2 / 2
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    low, high = 0.0, 1e4
    while high - low > 1e-6 * high:
        middle = (low + high) / 2
        covered = weights @ np.interp(middle * deviations, step * widths, narrower, right=1.0)
        low, high = (middle, high) if covered < LEVEL / 100 else (low, middle)
    return high


# ---- before a run ------------------------------------------------------------------------------------------


def half_width(seeds: int, episodes: int, tasks: int, *, seed_deviation: float = SEED_DEVIATION) -> float:
    """Return half of the width to expect of the interval of a mean success rate.

    Assumed is the worst, a rate of one half. With one seed the interval is of its episodes alone.

    Args:
        seeds: How many seeds are run.
        episodes: Scored episodes of a task.
        tasks: How many tasks the mean is over.
        seed_deviation: Standard deviation of the rate between seeds.
    """
    of_seeds = seed_deviation**2 if seeds > 1 else 0.0
    error = math.sqrt((of_seeds + 0.25 / (episodes * tasks)) / seeds)
    return math.sin(2 * min(_quantile(seeds) * error, math.pi / 4)) / 2


def episodes_needed(
    wished: float, seeds: int, tasks: int, *, seed_deviation: float = SEED_DEVIATION
) -> int | None:
    """Return how many episodes of a task `half_width` needs to be as `wished`.

    Args:
        wished: Half of the width of the interval, above 0.
        seeds: How many seeds are run.
        tasks: How many tasks the mean is over.
        seed_deviation: Standard deviation of the rate between seeds.

    Returns:
        None if no number of episodes is enough: more seeds are needed.
    """
    of_seeds = seed_deviation**2 if seeds > 1 else 0.0
    error = math.asin(min(2 * wished, 1.0)) / 2 / _quantile(seeds)
    of_episodes = seeds * error**2 - of_seeds
    # A half-width that some number reaches exactly is not to need one more.
    return math.ceil(0.25 / (tasks * of_episodes) - 1e-6) if of_episodes > 0 else None


def _quantile(seeds: int) -> float:
    return student_quantile(seeds - 1 if seeds > 1 else MANY)


def expected_precision(scenario: Scenario, seeds: int) -> str:
    """Return a sentence on how wide the intervals of a run of `scenario` will be."""
    episodes = scenario.budget.test_episodes
    retained, target = len(scenario.retained), len(scenario.target)
    counts = {"retention": retained, "adaptation": target, "final average": retained + target}
    widths = {name: half_width(seeds, episodes, tasks) for name, tasks in counts.items() if tasks}
    parts = ", ".join(f"± {width:.2f} for {name}" for name, width in widths.items())
    what, of = (f"{seeds} seeds", "95 %") if seeds > 1 else ("1 seed", "95 %, of this seed alone")
    return f"{what} x {episodes} episodes: near a rate of one half expect about {parts} ({of})."
