"""Intervals and paired differences by a bootstrap that follows how a benchmark row comes about.

A row's number varies because another seed would have given another sequence of policies, and because other
initial states would have met it. Each replicate therefore draws

1. seeds with replacement, each a whole run from the pretrained policy to the last stage: the tasks of one run
   share a policy and are never drawn apart;
2. for each run drawn and each task, episodes with replacement. All stages and evaluation points of the run
   get the same ones, and so do runs of other methods with this seed: they met the same initial states.
   Where fewer episodes are run, at the points before the end of a stage, the rate is the mean over those
   drawn among them;
3. for each run drawn, stage and kind of question, a binomial number of right answers, since records hold
   counts only.

Tasks are fixed: a scenario is those tasks. Fixed too is what was chosen on the selection episodes of a run,
as the points of `retention_at_matched_adaptation`: these episodes are not drawn again, and the interval says
nothing of the luck of the choice. Intervals are percentile intervals of 95 %.

What they cannot do: with one seed only episodes vary, so the interval says nothing of other seeds. With few
seeds it is too narrow when these differ more than episodes do: in simulations of 6 tasks with 20 episodes the
intervals held the truth in 92 % (3 seeds), 95 % (5) and 95 % (10) of the cases when the success of seeds had
a standard deviation of 0.05, and in 78 %, 86 % and 90 % when it was 0.15. If all episodes ended alike the
interval has no width, though the rate is not known exactly.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clbench.metrics import Metric, load_metric
from clbench.scores import Array, Layout, Rates, Scores, combine, rates_of

Runs = Mapping[int, Scores]
"""Runs of one method on one scenario, by seed."""

REPLICATES = 2000
"""Draws behind an interval."""
LEVEL = 95.0
"""Per cent of the replicates inside the interval."""


@dataclass(frozen=True)
class Estimate:
    """A value with its interval; None where it cannot be computed."""

    value: float | None
    """The value computed from all episodes, each counted once."""
    low: float | None
    """Lower end of the interval."""
    high: float | None
    """Upper end of the interval."""


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
        runs: The runs by seed. One seed: only episodes and answers are resampled.
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
    draw = _Draw.make(len(runs), next(iter(runs.values())).layout, generator, replicates)
    needed = _needed(wanted, sorted(runs), references)
    exact, resampled = _rates(runs, needed, draw, generator)
    return {metric.name: interval(_value(metric, exact), metric.over_runs(resampled)) for metric in wanted}


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

    Both get the same draws of seeds and episodes, so that what is hard for both cancels. Right answers are
    drawn apart, since records do not tell which questions they were: differences of answers are a little
    too wide.

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
    if runs[seeds[0]].layout != others[seeds[0]].layout:
        raise ValueError("Methods are compared on the same tasks, episodes, evaluation points and questions.")
    draw = _Draw.make(len(seeds), runs[seeds[0]].layout, generator, replicates)
    needed = _needed([wanted], seeds, references)
    exact, resampled = _rates({seed: runs[seed] for seed in seeds}, needed, draw, generator)
    other_exact, other_resampled = _rates({seed: others[seed] for seed in seeds}, needed, draw, generator)
    return interval(
        _value(wanted, exact) - _value(wanted, other_exact),
        wanted.over_runs(resampled) - wanted.over_runs(other_resampled),
    )


def bootstrap(
    quantity: Callable[[Mapping[str, Rates]], Array],
    runs: Mapping[str, Sequence[Scores]],
    generator: np.random.Generator,
    *,
    replicates: int = REPLICATES,
) -> Estimate:
    """Return any quantity of the success rates of several methods, with its interval.

    Args:
        quantity: Maps the rates of each method, with batch axes (..., runs), to values (...).
        runs: Runs of each method: the same seeds in the same order. All get the same draws.
        generator: Source of the draws.
        replicates: How many draws.

    Raises:
        ValueError: The runs are of different tasks, episodes, evaluation points or questions.
    """
    (first, ours), *others = runs.items()
    draw = _Draw.make(len(ours), ours[0].layout, generator, replicates)
    numbered = dict(enumerate(ours))
    references = {name: list(theirs) for name, theirs in others}
    exact, drawn = (
        quantity({first: rates, **rates.references})
        for rates in _rates(numbered, references, draw, generator)
    )
    return interval(float(exact), drawn)


@dataclass(frozen=True, eq=False)
class _Draw:
    """Which runs and which of their episodes the replicates hold."""

    runs: NDArray[np.int64]
    """Indices of the runs drawn, (replicates, runs)."""
    counts: Array
    """How often each episode was drawn, (replicates, runs, tasks, episodes)."""

    @classmethod
    def make(cls, runs: int, layout: Layout, generator: np.random.Generator, replicates: int) -> _Draw:
        """Return a draw of `replicates`."""
        shape = (replicates, runs, len(layout.tasks), len(layout.episodes))
        chosen = generator.integers(runs, size=shape[:2])
        episodes = generator.integers(shape[-1], size=(math.prod(shape[:-1]), shape[-1]))
        # Counted in one call: the episodes of each cell get numbers of their own.
        episodes += np.arange(len(episodes))[:, None] * shape[-1]
        counts = np.bincount(episodes.ravel(), minlength=episodes.size)
        return cls(chosen, counts.reshape(shape).astype(np.float64))

    def rates(self, runs: list[Scores], generator: np.random.Generator) -> Rates:
        """Return the rates of `runs` as drawn, with the batch axes (replicates, runs)."""
        parts = [run.rates(self.counts[self.runs == number]) for number, run in enumerate(runs)]
        # The parts stand one run after the other; back to where each was drawn.
        order = np.argsort(np.argsort(self.runs, axis=None, kind="stable"))
        rates = combine(parts, lambda arrays: np.concatenate(arrays)[order])
        share = rates.correct / np.maximum(rates.asked, 1)
        correct = generator.binomial(rates.asked.astype(np.int64), share).astype(np.float64)
        rates = replace(rates, correct=correct)
        return rates.each(lambda array: array.reshape(*self.runs.shape, *array.shape[1:]))


def _needed(
    metrics: Iterable[Metric], seeds: list[int], references: Mapping[str, Runs] | None
) -> dict[str, list[Scores]]:
    """Return the references that `metrics` need and that have all `seeds`, in the order of these."""
    names = sorted({name for metric in metrics for name in metric.references})
    found = {name: references[name] for name in names if name in references} if references else {}
    return {name: [runs[seed] for seed in seeds] for name, runs in found.items() if set(seeds) <= set(runs)}


def _rates(
    runs: Runs, references: dict[str, list[Scores]], draw: _Draw, generator: np.random.Generator
) -> tuple[Rates, Rates]:
    """Return the rates of the runs as they are, (runs,), and as drawn, (replicates, runs)."""
    ordered = [runs[seed] for seed in sorted(runs)]
    exact = rates_of(ordered, references)
    drawn = draw.rates(ordered, generator)
    drawn_references = {name: draw.rates(them, generator) for name, them in references.items()}
    return exact, replace(drawn, references=drawn_references)


def _value(metric: Metric, rates: Rates) -> float:
    return float(metric.over_runs(rates))


def interval(value: float, replicates: Array) -> Estimate:
    """Return a value with the interval that its replicates span."""
    if not math.isfinite(value):
        return Estimate(None, None, None)
    # A metric that has no value in some replicates has no honest interval.
    if not np.isfinite(replicates).all():
        return Estimate(value, None, None)
    low, high = np.percentile(replicates, [50 - LEVEL / 2, 50 + LEVEL / 2])
    return Estimate(value, float(low), float(high))
