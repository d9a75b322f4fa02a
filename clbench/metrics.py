"""Metrics: named, versioned functions from the success rates of runs to one number.

A new metric is one function with the decorator `metric`; intervals, tables and tests find it by themselves.

In the formulas R[l][s] is the success rate on task s at the end of stage l, stage 0 is the pretrained policy,
target k is learned in stage k, and K is the last stage.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from clbench.record import Record, RecordError
from clbench.task import Group, unknown

Array = NDArray[np.float64]

MOST = 10**9
"""More steps, episodes or questions than any run has: a number beyond it is damage."""


@dataclass(frozen=True)
class Layout:
    """What the axes of a run's scores stand for. Runs can be put together if their layouts are equal."""

    retained: tuple[str, ...]
    """Names of the skills that are pretrained and never trained again."""
    target: tuple[str, ...]
    """Names of the tasks that are learned, in order."""
    held_out: tuple[str, ...]
    """Names of the tasks that are never trained."""
    episodes: tuple[int, ...]
    """Numbers of the report episodes, rising."""
    steps: tuple[int, ...]
    """Steps inside a stage at which its target is evaluated, rising, all above 0."""
    kinds: tuple[str, ...]
    """Kinds of questions, sorted."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """The columns of every score table: retained, then target, then held out."""
        return self.retained + self.target + self.held_out

    def columns(self, group: Group) -> slice:
        """Return the task columns of `group`."""
        before = {"retained": (), "target": self.retained, "held_out": self.retained + self.target}[group]
        return slice(len(before), len(before) + len(getattr(self, group)))


@dataclass(frozen=True, eq=False)
class Scores:
    """What a record says about success, as arrays: 0 or 1 for each report episode, NaN where missing."""

    layout: Layout
    """What the axes stand for."""
    success: Array
    """Success at the end of each stage, (stages + 1, tasks, episodes)."""
    curves: Array
    """Success on target k during stage k, (targets, points, episodes)."""
    asked: Array
    """Questions asked at the end of each stage, (stages + 1, kinds)."""
    correct: Array
    """Questions answered rightly, (stages + 1, kinds)."""

    @classmethod
    def from_record(cls, record: Record) -> Scores:
        """Return the scores in `record`. The end of a stage is the last step at which it was evaluated.

        Raises:
            RecordError: The record contradicts itself: tasks, stages or values that cannot be.
        """
        retained, target, held_out = (_names(record, group) for group in ("retained", "target", "held_out"))
        tasks = retained + target + held_out
        if len(set(tasks)) != len(tasks):
            raise RecordError("scenario: a task name occurs twice.")
        rows = _report_rows(record, tasks, stages=len(target))
        on_the_way = [row for row in rows if row[0] > 0 and row[1] > 0 and row[2] == target[row[0] - 1]]
        kinds, asked, correct = _answers(record, stages=len(target))
        layout = Layout(
            retained,
            target,
            held_out,
            episodes=tuple(sorted({episode for *_, episode, _ in rows})),
            steps=tuple(sorted({step for _, step, *_ in on_the_way})),
            kinds=kinds,
        )
        success = np.full((len(target) + 1, len(tasks), len(layout.episodes)), np.nan)
        curves = np.full((len(target), len(layout.steps), len(layout.episodes)), np.nan)
        last_step = {stage: step for stage, step, *_ in sorted(rows, key=lambda row: row[:2])}
        for stage, step, task, episode, value in rows:
            if step == last_step[stage]:
                success[stage, tasks.index(task), layout.episodes.index(episode)] = value
        for stage, step, _, episode, value in on_the_way:
            curves[stage - 1, layout.steps.index(step), layout.episodes.index(episode)] = value
        return cls(layout, success, curves, asked, correct)

    def rates(self, counts: Array | None = None) -> Rates:
        """Return the success rates with the batch axes of `counts`.

        Args:
            counts: How often each episode is in, the same for all stages and points, (..., tasks, episodes).
                They add up to the number of episodes. Once each, without batch axes, if None.
        """
        layout, number = self.layout, len(self.layout.episodes)
        if counts is None:
            counts = np.ones((len(layout.tasks), number))
        batch, of_targets = counts.shape[:-2], counts[..., layout.columns("target"), :]
        return Rates(
            layout,
            success=np.einsum("lte,...te->...lt", self.success, counts) / number,
            curves=np.einsum("kpe,...ke->...kp", self.curves, of_targets) / number,
            asked=np.broadcast_to(self.asked, batch + self.asked.shape),
            correct=np.broadcast_to(self.correct, batch + self.correct.shape),
        )


def _names(record: Record, group: Group) -> tuple[str, ...]:
    names = record.scenario.get(group)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RecordError(f"scenario: {group} must be a list of task names.")
    return tuple(names)


def _report_rows(
    record: Record, tasks: tuple[str, ...], stages: int
) -> list[tuple[int, int, str, int, float]]:
    """Return (stage, step, task, episode, success) of the report episodes, each checked."""
    columns = (record.episodes[name] for name in ("stage", "step", "task", "split", "episode", "success"))
    rows = []
    for number, (stage, step, task, split, episode, success) in enumerate(zip(*columns, strict=True)):
        if split != "report":
            continue
        numbers = (stage, step, episode)
        if any(type(value) is not int or not 0 <= value <= MOST for value in numbers) or stage > stages:
            raise RecordError(f"episodes: row {number} has an impossible stage, step or episode.")
        if task not in tasks:
            raise RecordError(f"episodes: row {number} is of a task that is not in the scenario: {task!r}.")
        if success not in (0, 1):
            raise RecordError(f"episodes: row {number} has the success {success!r}, neither true nor false.")
        rows.append((stage, step, task, episode, float(success)))
    if not rows:
        raise RecordError("episodes: there is no report episode.")
    if len({row[:4] for row in rows}) != len(rows):
        raise RecordError("episodes: an episode is there twice.")
    return rows


def _answers(record: Record, stages: int) -> tuple[tuple[str, ...], Array, Array]:
    """Return the kinds of questions, and the questions asked and answered rightly, (stages + 1, kinds)."""
    rows = list(zip(*record.answers.values(), strict=True))
    for number, (stage, kind, asked, correct) in enumerate(rows):
        if any(type(value) is not int for value in (stage, asked, correct)) or not isinstance(kind, str):
            raise RecordError(f"answers: row {number} must hold whole numbers and the name of a kind.")
        if not (0 <= stage <= stages and 0 <= correct <= asked <= MOST):
            raise RecordError(f"answers: row {number} has impossible numbers.")
    if len({row[:2] for row in rows}) != len(rows):
        raise RecordError("answers: a kind is there twice in one stage.")
    kinds = tuple(sorted({row[1] for row in rows}))
    counts = np.zeros((2, stages + 1, len(kinds)))
    for stage, kind, asked, correct in rows:
        counts[:, stage, kinds.index(kind)] = asked, correct
    return kinds, counts[0], counts[1]


@dataclass(frozen=True, eq=False)
class Rates:
    """Success rates, the input of every metric: arrays with any batch axes in front, NaN where missing."""

    layout: Layout
    """What the axes stand for."""
    success: Array
    """Success rate at the end of each stage, (..., stages + 1, tasks)."""
    curves: Array
    """Success rate on target k during stage k, (..., targets, points)."""
    asked: Array
    """Questions asked at the end of each stage, (..., stages + 1, kinds)."""
    correct: Array
    """Questions answered rightly, (..., stages + 1, kinds)."""
    references: Mapping[str, Rates] = field(default_factory=dict)
    """Rates of reference methods with the same seeds, by the method's name."""

    @property
    def retained(self) -> Array:
        """Success rate on the retained skills, (..., stages + 1, retained)."""
        return self.success[..., self.layout.columns("retained")]

    @property
    def target(self) -> Array:
        """Success rate on the targets, (..., stages + 1, targets)."""
        return self.success[..., self.layout.columns("target")]

    @property
    def held_out(self) -> Array:
        """Success rate on the held-out tasks, (..., stages + 1, held out)."""
        return self.success[..., self.layout.columns("held_out")]

    @property
    def learned(self) -> Array:
        """Success rate on target k at the end of stage k, (..., targets)."""
        return np.diagonal(self.target[..., 1:, :], axis1=-2, axis2=-1)

    def each(self, change: Callable[[Array], Array]) -> Rates:
        """Return rates whose arrays, those of the references included, went through `change`."""
        return replace(
            self,
            success=change(self.success),
            curves=change(self.curves),
            asked=change(self.asked),
            correct=change(self.correct),
            references={name: rates.each(change) for name, rates in self.references.items()},
        )


def combine(rates: Sequence[Rates], join: Callable[[Sequence[Array]], Array]) -> Rates:
    """Return rates whose arrays are those of `rates`, put together by `join`; references stay behind.

    Raises:
        ValueError: The layouts differ.
    """
    _check_same(part.layout for part in rates)
    return Rates(
        rates[0].layout,
        success=join([part.success for part in rates]),
        curves=join([part.curves for part in rates]),
        asked=join([part.asked for part in rates]),
        correct=join([part.correct for part in rates]),
    )


def rates_of(runs: Sequence[Scores], references: Mapping[str, Sequence[Scores]]) -> Rates:
    """Return the success rates of `runs`, with the batch axis (runs,).

    Args:
        runs: One or more runs.
        references: Runs of reference methods by name: the same seeds in the same order.

    Raises:
        ValueError: The layouts differ.
    """
    _check_same(run.layout for run in (*runs, *chain.from_iterable(references.values())))
    rates = combine([run.rates() for run in runs], np.stack)
    return replace(rates, references={name: rates_of(them, {}) for name, them in references.items()})


def _check_same(layouts: Iterable[Layout]) -> None:
    if len(set(layouts)) != 1:
        raise ValueError("Runs with different tasks, episodes, evaluation points or questions do not mix.")


Function = Callable[[Rates], Array]


@dataclass(frozen=True)
class Metric:
    """A named, versioned definition of one number. A changed definition is a new version."""

    name: str
    """Name of its function and of its column everywhere."""
    function: Function
    """Maps rates with batch axes (...) to values (...), NaN where something is missing."""
    description: str
    """What it tells, in one sentence."""
    formula: str
    """How it is computed, in words and in the letters of this module's docstring."""
    source: str
    """Paper or convention that it comes from."""
    low: float
    """Least possible value."""
    high: float
    """Greatest possible value."""
    higher_is_better: bool | None
    """None if it says nothing of better or worse."""
    units: str
    """What is counted."""
    references: tuple[str, ...]
    """Methods without whose records, of the same seeds, it has no value."""
    pooled: bool
    """Whether seeds are averaged before it is computed; if not, it is the mean of the seeds' values."""
    version: int
    """Number of the definition."""

    def over_runs(self, rates: Rates) -> Array:
        """Return the value (...) over the runs of `rates`, whose last batch axis is the run: (..., runs)."""
        if any(name not in rates.references for name in self.references):
            return np.full(rates.success.shape[:-3], np.nan)
        if self.pooled:
            return self.function(rates.each(lambda array: np.mean(array, axis=-3)))
        return np.asarray(self.function(rates).mean(axis=-1))


METRICS: dict[str, Metric] = {}
"""All metrics by name, in the order of their definition."""


def metric(
    *,
    formula: str,
    source: str,
    low: float = 0.0,
    high: float = 1.0,
    higher_is_better: bool | None = True,
    units: str = "success rate",
    references: tuple[str, ...] = (),
    pooled: bool = False,
    version: int = 0,
) -> Callable[[Function], Function]:
    """Return a decorator that enters a function as a metric: its name, and its docstring's first line.

    The arguments are the fields of `Metric`.
    """

    def enter(function: Function) -> Function:
        METRICS[function.__name__] = Metric(
            name=function.__name__,
            function=function,
            description=(function.__doc__ or "").partition("\n")[0],
            formula=formula,
            source=source,
            low=low,
            high=high,
            higher_is_better=higher_is_better,
            units=units,
            references=references,
            pooled=pooled,
            version=version,
        )
        return function

    return enter


def load_metric(name: str) -> Metric:
    """Return the metric called `name`.

    Raises:
        LookupError: No metric has this name; the nearest one is named.
    """
    if name not in METRICS:
        raise unknown("metric", name, METRICS)
    return METRICS[name]


def measure(name: str, scores: Scores, references: Mapping[str, Scores] | None = None) -> float | None:
    """Return the value of the metric `name` for one run, None where something that it needs is missing.

    Args:
        name: Name of the metric.
        scores: The run.
        references: Runs of reference methods with the same scenario and seed, by the method's name.
    """
    rates = rates_of([scores], {key: [run] for key, run in (references or {}).items()})
    value = float(load_metric(name).over_runs(rates))
    return value if math.isfinite(value) else None


def _mean(values: Array) -> Array:
    """Return the mean along the last axis, NaN where there is nothing to average."""
    return values.mean(axis=-1) if values.shape[-1] else np.full(values.shape[:-1], np.nan)


@metric(
    formula="mean of R[K][s] over the retained skills and the targets",
    source="GEM, arXiv 1706.08840 (ACC)",
)
def final_average(rates: Rates) -> Array:
    """Success after the last target on everything that was ever trained."""
    return _mean(np.concatenate([rates.retained[..., -1, :], rates.target[..., -1, :]], axis=-1))


@metric(formula="mean of R[k][k] over the targets k", source="the diagonal of the matrix of arXiv 1706.08840")
def adaptation(rates: Rates) -> Array:
    """Success on each target right after it was learned."""
    return _mean(rates.learned)


@metric(formula="mean of R[K][s] over the retained skills s", source="clbench")
def retention(rates: Rates) -> Array:
    """Success on the retained skills after the last target."""
    return _mean(rates.retained[..., -1, :])


@metric(
    formula="mean over the retained skills and all targets but the last of the highest R[l][s], from where s "
    "is known (stage 0 for skills, stage k for target k) to stage K-1, minus R[K][s]",
    source="Chaudhry et al. 2018, arXiv 1801.10112; the retained skills counted in",
    low=-1.0,
    higher_is_better=False,
)
def forgetting(rates: Rates) -> Array:
    """Drop from the best success before the last stage to the success after it.

    The highest of several noisy rates is too high by a part of their noise, so that a policy that does not
    change at all has a small positive value with few episodes. `backward_transfer` has no such bias.
    """
    # The last target has no stage between learning it and the end.
    known = np.concatenate([rates.retained, rates.target[..., :-1]], axis=-1)
    learned_in = np.array([0] * rates.retained.shape[-1] + list(range(1, rates.target.shape[-1])))
    if not known.shape[-1] or known.shape[-2] == 1:
        return np.full(known.shape[:-2], np.nan)
    seen = np.arange(known.shape[-2] - 1)[:, None] >= learned_in
    best = np.where(seen, known[..., :-1, :], -np.inf).max(axis=-2)
    return _mean(best - known[..., -1, :])


@metric(
    formula="mean of R[K][k] - R[k][k] over all targets k but the last",
    source="GEM, arXiv 1706.08840 (BWT)",
    low=-1.0,
)
def backward_transfer(rates: Rates) -> Array:
    """Change of the success on earlier targets by learning the later ones."""
    return _mean(rates.target[..., -1, :-1] - rates.learned[..., :-1])


@metric(
    formula="mean over the targets of (A - B) / (1 - B); A is the area under the learning curve divided by "
    "the stage's steps, B the same for a policy that learns the target from scratch; the curve starts with "
    "R[k-1][k], the one from scratch with 0",
    source="Continual World, arXiv 2105.10919 (FT)",
    low=-math.inf,
    units="share of the area that learning from scratch leaves",
    references=("from_scratch",),
    pooled=True,
)
def forward_transfer(rates: Rates) -> Array:
    """How much faster targets are learned than from scratch.

    Conventions, where the source leaves room:

    1. Trapezoid rule through the evaluation points and a point at step 0. A stage starts with the policy of
       the stage before, so that its point at step 0 is R[k-1][k]: what the policy can do at once is transfer.
    2. The policy from scratch starts untrained, and nobody evaluates that one: its success at step 0 is taken
       as 0. For manipulation this is true to a few in a thousand; where it is not, the value is too high by
       at most half the first interval's share of the stage times the untrained policy's success. To begin
       both curves at the first common point instead would leave out the very part where transfer shows.
    3. Curves are averaged over seeds before the ratio, as in the source's code.
    4. The value is capped by 1 and not bounded below. Point 2 keeps the divisor above 0.
    """
    starts = np.diagonal(rates.target[..., :-1, :], axis1=-2, axis2=-1)
    area = _area(rates.layout.steps, rates.curves, starts)
    curves_from_scratch = rates.references["from_scratch"].curves
    area_from_scratch = _area(rates.layout.steps, curves_from_scratch, np.zeros_like(starts))
    return _mean((area - area_from_scratch) / (1 - area_from_scratch))


def _area(steps: tuple[int, ...], curves: Array, starts: Array) -> Array:
    """Return the area (..., targets) under the curves (..., targets, points), divided by the last step."""
    if not steps:
        return np.full(starts.shape, np.nan)
    heights = np.concatenate([starts[..., None], curves], axis=-1)
    return np.asarray(np.trapezoid(heights, np.array([0, *steps]) / steps[-1], axis=-1))


@metric(
    formula="right answers divided by questions, of all kinds together, at the end of stage K",
    source="clbench",
    units="share of right answers",
)
def question_retention(rates: Rates) -> Array:
    """Share of the questions about the scene that are answered rightly after the last target."""
    asked, correct = rates.asked[..., -1, :].sum(axis=-1), rates.correct[..., -1, :].sum(axis=-1)
    return np.where(asked > 0, correct / np.maximum(asked, 1), np.nan)


@metric(formula="mean of R[K][s] over the held-out tasks s", source="arXiv 2603.11653 (ZS)")
def zero_shot(rates: Rates) -> Array:
    """Success after the last target on tasks that were never trained."""
    return _mean(rates.held_out[..., -1, :])
