"""Intervals and paired differences, with the two sources of variation that a row of the benchmark has.

Another seed would give another sequence of policies, and other initial states would give other outcomes. A
seed is one whole run, from the pretrained policy to the last stage: its tasks share a policy. The numbers of
several seeds vary for both reasons. Therefore:

1. With two or more seeds the interval is Student's over the seeds. Its standard error comes from the
   jackknife, which leaves out one whole seed at a time. Its degrees of freedom are the number of seeds minus
   one. If a quantity has a least and a greatest value, the interval is Wilson's score interval: see
   `interval_of_seeds`.
2. With one seed the variation between seeds is unknown, and the interval covers only episodes. Its ends are
   percentiles of replicates in which every run keeps its policy and meets episodes drawn with replacement,
   for each task. All stages and evaluation points of a run get the same draws, and so do runs of other
   methods with this seed: they met the same initial states. Fewer episodes are run before the end of a stage.
   There the rate is the mean over those of them that are drawn. Right answers are drawn from a binomial
   distribution for each stage and kind of question, since records hold only counts. Such an interval says
   nothing about other seeds: `Estimate.of_seeds` is False, and nothing is concluded from it.
3. Where several seeds agree exactly, they may do so by chance. The standard error is then that of these
   replicates, with Student's quantile of the seeds; it is 0 if all outcomes are equal.

Metrics of `OF_WHOLE_RUNS`, such as the steps to the criterion, do not depend on the drawn episodes. Unless
seeds differ, they have no interval.

Tasks are fixed: a scenario consists of them. All seeds share demonstrations, scenes and questions: intervals
do not cover other ones. Choices on a run's validation episodes are fixed too: the interval does not cover the
luck of the choice.
`docs/guide/statistics.md` reports the coverage of these 95 % intervals and their limits.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from clbench.base.errors import InputError
from clbench.scoring.layout import Array
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import load_metric
from clbench.scoring.rates import Rates, check_same, leave_one_out, stacked
from clbench.scoring.scores import Scores, rates_of

Runs = Mapping[int, Scores]
"""Runs of one method on one scenario, by seed."""

Span = tuple[float, float]
"""The least and the greatest value that a quantity can have; they may be infinite."""
UNBOUNDED: Span = (-math.inf, math.inf)

Quantity = Callable[[Mapping[str, Rates]], Array]
"""Maps the rates of each method, with batch axes (..., runs), to values (...)."""

REPLICATES = 2000
"""Draws behind an interval of episodes."""
LEVEL = 95.0
"""Nominal coverage of the intervals in per cent."""
OF_WHOLE_RUNS = (
    "answer_curves",
    "update_sparsity",
    "activation_drift",
    "shift",
    "captured",
    "steps",
    "met",
    "relearning_steps",
)
"""Arrays of `Rates` that no draw of test episodes changes. Unless seeds differ, nothing is known about how
much they vary: seeds may agree by chance, or at a least value."""
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
    of_seeds: bool = True
    """Whether the interval describes other seeds; with one seed it does not."""

    def is_above(self, bar: float) -> bool:
        """Return whether the interval describes other seeds and is above `bar`."""
        return self.of_seeds and self.low is not None and self.low > bar

    def is_below(self, bar: float) -> bool:
        """Return whether the interval describes other seeds and is below `bar`."""
        return self.of_seeds and self.high is not None and self.high < bar


NO_ESTIMATE = Estimate(None, None, None)
"""The estimate of a value that cannot be computed."""


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
        runs: The runs by seed. With one seed, the interval covers only episodes and answers.
        generator: Source of the draws.
        references: Runs of reference methods by name and seed. A reference that lacks a seed of `runs`
            counts as missing: metrics that need it have no value.
        replicates: Number of draws.

    Raises:
        UnknownNameError: A metric is unknown.
        InputError: The runs are of different tasks, episodes, evaluation points or questions.
    """
    wanted = [load_metric(name) for name in metrics]
    if not runs:
        return {metric.name: NO_ESTIMATE for metric in wanted}
    seeds = sorted(runs)
    methods = {"": [runs[seed] for seed in seeds]}
    # Metrics with the same references share their draws; most have none, and draws of episodes cost most.
    samples = {
        names: _Samples(methods, needed_references([one], seeds, references), generator, replicates)
        for names, one in {one.references: one for one in wanted}.items()
    }

    return {one.name: samples[one.references].estimate_metric(one) for one in wanted}


def paired_difference(
    metric: str,
    runs: Runs,
    others: Runs,
    generator: np.random.Generator,
    *,
    replicates: int = REPLICATES,
) -> Estimate:
    """Return the value of `metric` for `runs` minus that for `others`, over the seeds that both have.

    Seeds are left out, and episodes drawn, for both at once, so that shared difficulty cancels. Right
    answers are drawn separately, since records do not name the questions: with one seed, intervals of
    differences of answers are a little too wide.

    Args:
        metric: Name of a metric that needs no reference.
        runs: Runs of one method by seed.
        others: Runs of the other method by seed.
        generator: Source of the draws.
        replicates: Number of draws.

    Raises:
        UnknownNameError: The metric is unknown.
        InputError: The runs are of different tasks, episodes, evaluation points or questions.
    """
    wanted = load_metric(metric)
    seeds = sorted(set(runs) & set(others))
    if not seeds:
        return NO_ESTIMATE
    reach = wanted.high - wanted.low
    return estimate_quantity(
        lambda of: wanted.over_runs(of["one"]) - wanted.over_runs(of["other"]),
        {"one": [runs[seed] for seed in seeds], "other": [others[seed] for seed in seeds]},
        generator,
        span=(-reach, reach),
        replicates=replicates,
    )


def estimate_quantity(
    quantity: Quantity,
    runs: Mapping[str, Sequence[Scores]],
    generator: np.random.Generator,
    *,
    span: Span = UNBOUNDED,
    ratio: bool = False,
    replicates: int = REPLICATES,
) -> Estimate:
    """Return any quantity of the success rates of several methods, with its interval.

    Args:
        quantity: Maps the rates of each method, with batch axes (..., runs), to values (...).
        runs: Runs of each method: the same seeds in the same order. All get the same draws.
        generator: Source of the draws.
        span: Least and greatest possible value.
        ratio: Whether the values are positive ratios, see `interval`.
        replicates: Number of draws.

    Raises:
        InputError: A method has no run or another number of runs than the others, or the runs are of
            different tasks, episodes, evaluation points or questions.
    """
    return _Samples(runs, {}, generator, replicates).estimate(quantity, span, ratio=ratio)


def interval(
    value: float,
    without_one: Array,
    other_episodes: Callable[[], Array] | None = None,
    span: Span = UNBOUNDED,
    *,
    ratio: bool = False,
) -> Estimate:
    """Return a value with its interval.

    Args:
        value: The value of all seeds.
        without_one: The values if one seed is left out, (seeds,); with one seed there are none, (0,).
        other_episodes: Returns the values with episodes drawn anew, (replicates,). It is called only if the
            seeds do not vary; without it there is then no interval.
        span: Least and greatest possible value.
        ratio: Whether the values are positive ratios, for which 2 is as far from 1 as 1/2. The interval is
            then computed for their logarithms, and `span` does not count. 0 has no logarithm: if a value is
            0, the interval is computed for the values themselves.
    """
    if ratio and min([value, *without_one]) > 0:
        found = interval(
            math.log(value), np.log(without_one), other_episodes and (lambda: np.log(other_episodes()))
        )
        low, high = (None if end is None else math.exp(end) for end in (found.low, found.high))
        return replace(found, value=value, low=low, high=high)
    if not math.isfinite(value):
        return NO_ESTIMATE
    # A metric that has no value without one of the seeds, or with other episodes, has no honest interval.
    if not np.isfinite(without_one).all():
        return Estimate(value, None, None)
    degrees = len(without_one) - 1
    # Equal values may differ in the last bits.
    if np.abs(without_one - value).max(initial=0.0) > 1e-12 * max(1.0, abs(value)):
        low, high = interval_of_seeds(value, math.sqrt(degrees) * float(without_one.std()), degrees, span)
    else:
        replicates = other_episodes() if other_episodes else np.array([math.nan])
        if not np.isfinite(replicates).all():
            return Estimate(value, None, None)
        if degrees < 1:
            low, high = np.percentile(replicates, [50 - LEVEL / 2, 50 + LEVEL / 2])
        else:
            low, high = interval_of_seeds(value, float(replicates.std()), degrees, span)
    return Estimate(value, min(float(low), value), max(float(high), value), of_seeds=degrees > 0)


def mean_of_seeds(
    values: Sequence[float],
    span: Span,
    other_episodes: Callable[[], Array] | None = None,
    *,
    ratio: bool = False,
) -> Estimate:
    """Return the mean of one or more values, one for each seed, with its interval.

    The other arguments are as for `interval`: without `other_episodes`, one seed has no interval, and with
    `ratio`, the mean is geometric.
    """
    geometric = ratio and min(values) > 0

    def mean(some: Sequence[float]) -> float:
        if geometric:
            return math.exp(math.fsum(map(math.log, some)) / len(some))
        return math.fsum(some) / len(some)

    rest = [[*values[:place], *values[place + 1 :]] for place in range(len(values))]
    others = np.array([mean(part) for part in rest if part])
    return interval(mean(values), others, other_episodes, span, ratio=geometric)


def interval_of_seeds(value: float, error: float, degrees: int, span: Span) -> Span:
    """Return the ends of the interval of a value, given its standard error over seeds.

    Without two bounds the interval is Student's: the value plus and minus quantile times error. Near a bound,
    Student's interval passes the bound, and it is too short on the other side: if most seeds agree at the
    bound, their error is small by chance. Between two bounds the interval is therefore Wilson's score
    interval, 1927, doi 10.1080/01621459.1927.10502953. It contains each x with |value - x| <=
    quantile * e(x). The error e(x) is `error` at the value, and its square is proportional to (x - low)
    (high - x), as for rates. The ends stay inside the span without clipping. Wilson's interval with an error
    between clusters, here seeds, is recommended by Franco et al. 2019, doi 10.1093/jssam/smy019, after
    simulations.

    A mean of seeds varies at most as much as one episode: e(x)^2 <= (x - low) (high - x). If the error is
    larger, as that of a metric whose values are cut at a bound may be, the interval is Student's, cut at the
    bounds.

    Args:
        value: The value, within the span.
        error: Its standard error; with 0 the interval has no width.
        degrees: Degrees of freedom of the standard error.
        span: Least and greatest possible value.
    """
    low, high = span
    width, reach = high - low, student_quantile(degrees) * error
    if reach <= 1e-12 * width < math.inf:  # 0 except for the last bits
        return value, value
    place = min(max((value - low) / width, 0.0), 1.0)
    spread = place * (1 - place)
    if width == math.inf or (error / width) ** 2 > spread * (1 + 1e-9):
        return max(value - reach, low), min(value + reach, high)
    reach /= width
    # The ends are the roots x of spread (x - place)^2 = reach^2 x (1 - x).
    middle, half = 2 * spread * place + reach**2, reach * math.hypot(reach, 2 * spread)
    below, above = ((middle + side) / (2 * (spread + reach**2)) for side in (-half, half))
    return low + width * below, low + width * above


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
        shape: Shape of the cells.
        episodes: Number of episodes, and of draws for each cell.
        generator: Source of the draws.
    """
    drawn = generator.integers(episodes, size=(math.prod(shape), episodes))
    # Counted in one call: the episodes of each cell get numbers of their own.
    drawn += np.arange(len(drawn))[:, None] * episodes
    counts = np.bincount(drawn.ravel(), minlength=drawn.size)
    return counts.reshape(*shape, episodes).astype(np.float64)


# ---- rates of the runs, and their replicates ---------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Samples:
    """Runs of several methods with the same seeds, and the replicates drawn from them."""

    methods: Mapping[str, Sequence[Scores]]
    """Runs of each method by its name, in the order of the seeds."""
    references: Mapping[str, Sequence[Scores]]
    """Runs of reference methods, in the same order."""
    generator: np.random.Generator
    """Source of the draws."""
    replicates: int
    """Number of draws."""

    def __post_init__(self) -> None:
        every = (*self.methods.values(), *self.references.values())
        if {len(runs) for runs in every} != {self.count} or not self.count:
            raise InputError(
                "All methods need runs of the same seeds, in the same order, and at least one run."
            )
        check_same(run.layout for runs in every for run in runs)

    @property
    def count(self) -> int:
        """Number of seeds."""
        return len(next(iter(self.methods.values()), ()))

    def estimate(self, quantity: Quantity, span: Span, *, ratio: bool = False) -> Estimate:
        """Return a quantity with its interval; `ratio` is as for `interval`."""
        return interval(
            float(quantity(self.whole)),
            quantity(self.without_one) if self.count > 1 else np.zeros(0),
            lambda: quantity(self.other_episodes),
            span,
            ratio=ratio,
        )

    def estimate_metric(self, metric: Metric) -> Estimate:
        """Return a metric of the only method with its interval."""
        (name,) = self.methods
        span = (metric.low, metric.high)
        return self.estimate(lambda rates: metric.over_runs(rates[name]), span, ratio=metric.ratio)

    @cached_property
    def whole(self) -> dict[str, Rates]:
        """The runs as they are, (runs,)."""
        return {name: rates_of(runs, self.references) for name, runs in self.methods.items()}

    @cached_property
    def without_one(self) -> dict[str, Rates]:
        """All runs but one, for each one, (runs, runs - 1)."""
        return {name: leave_one_out(rates) for name, rates in self.whole.items()}

    @cached_property
    def other_episodes(self) -> dict[str, Rates]:
        """The runs with episodes and answers drawn anew, (replicates, runs)."""
        layout = next(iter(self.methods.values()))[0].layout
        shape = (self.replicates, self.count, len(layout.tasks))
        counts = draw_episodes(shape, len(layout.episodes), self.generator)
        methods = {name: self._drawn(runs, counts) for name, runs in self.methods.items()}
        references = {name: self._drawn(runs, counts) for name, runs in self.references.items()}
        return {name: replace(rates, references=references) for name, rates in methods.items()}

    def _drawn(self, runs: Sequence[Scores], counts: Array) -> Rates:
        """Return the rates of `runs` over `counts` of the episodes, (replicates, runs, tasks, episodes)."""
        parts = [run.rates(counts[:, number]) for number, run in enumerate(runs)]
        rates = stacked(parts, axis=1)
        share = rates.correct / np.maximum(rates.asked, 1)
        correct = self.generator.binomial(rates.asked.astype(np.int64), share)
        of_runs = {name: np.full_like(getattr(rates, name), np.nan) for name in OF_WHOLE_RUNS}
        return replace(rates, correct=correct.astype(np.float64), **of_runs)


# ---- quantiles ---------------------------------------------------------------------------------------------


@cache
def student_quantile(degrees: int) -> float:
    """Return the number that the absolute value of Student's t exceeds in 5 % of the cases.

    Args:
        degrees: Degrees of freedom, one or more.
    """
    from scipy import special  # imports in 0.1 s; scipy.stats, whose t.ppf calls it, in 0.6 s

    return float(special.stdtrit(degrees, 0.5 + LEVEL / 200))


@cache
def studentised_range_quantile(count: int, degrees: int) -> float:
    """Return the number that Tukey's studentised range exceeds in 5 % of the cases.

    It is the range of `count` normal numbers, divided by an estimate of their standard deviation with these
    degrees of freedom.

    Args:
        count: Number of normal numbers, two or more.
        degrees: Degrees of freedom, one or more.
    """
    from scipy import stats

    return float(stats.studentized_range.ppf(LEVEL / 100, count, degrees))
