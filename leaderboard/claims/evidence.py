"""Evidence: the runs of a scenario, including runs with changed settings, and figures that compare them."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from clbench.scoring.intervals import (
    NO_ESTIMATE,
    UNBOUNDED,
    Estimate,
    Quantity,
    Span,
    estimate_quantity,
    mean_of_seeds,
    row_generator,
)
from clbench.scoring.metrics import load_metric
from clbench.scoring.rates import Rates
from clbench.scoring.reading import is_number

from ..board.costs import step_ratio
from ..board.frontier import FACTOR, apart_from_the_factor, ladder_of, like_the_board, read_ladder
from ..board.runs import ALIKE, Run, read_run, read_runs
from ..board.summary import NotShown

LEAST_SEEDS = 2
"""Fewest seeds that decide: an interval of one seed does not cover other seeds, and is only shown."""

SHARE: Span = (0.0, 1.0)
"""Least and greatest value of a share."""

Of = Mapping[str, Rates]
"""Rates by label of the method: same seeds, same draws, batch axes (..., runs)."""


@dataclass(frozen=True)
class Figure:
    """One measured number."""

    what: str
    """Name of the figure, with its methods."""
    methods: tuple[str, ...]
    """Labels of the methods: the subject first, then the methods it is compared with, then references."""
    estimate: Estimate
    """Value with its interval."""
    seeds: tuple[int, ...] = ()
    """Seeds of the figure; empty if it does not depend on seeds."""
    missing: tuple[str, ...] = ()
    """Labels without runs."""
    note: str = ""
    """Restriction of the figure, in words."""
    form: str = ".2f"
    """Format of the number."""
    span: Span = UNBOUNDED
    """Least and greatest possible value."""
    ratio: bool = False
    """Whether it is a positive ratio, whose interval is that of its logarithm."""

    @property
    def value(self) -> float:
        """The value, NaN if it is missing, so that no comparison with it is true."""
        return math.nan if self.estimate.value is None else self.estimate.value

    @property
    def low(self) -> float:
        """Lower end of the interval, NaN if none describes other seeds."""
        return self._end(self.estimate.low)

    @property
    def high(self) -> float:
        """Upper end of the interval, NaN if none describes other seeds."""
        return self._end(self.estimate.high)

    @property
    def is_unknown(self) -> bool:
        """Whether no interval describes other seeds: a rule that asks for the figure is undecided."""
        return math.isnan(self.low) or math.isnan(self.high)

    def _end(self, end: float | None) -> float:
        return math.nan if end is None or not self.estimate.of_seeds else end


@dataclass(frozen=True, eq=False)
class Evidence:
    """All comparable runs of one scenario."""

    scenario: str
    """Gymnasium id."""
    runs: Mapping[str, Mapping[int, Run]]
    """Runs by label of the method ("lora", "lora+rank=4") and by seed."""
    not_used: tuple[NotShown, ...]
    """Records that are left out, with their reasons."""

    @property
    def began(self) -> datetime | None:
        """When the first of the runs started; None if no record says so."""
        starts = [_start_of(run) for runs in self.runs.values() for run in runs.values()]
        return min((start for start in starts if start), default=None)

    def first_run(self, method: str) -> Run | None:
        """Return the run of a method with the lowest seed, None if it has no runs."""
        return next(iter(self.runs.get(method, {}).values()), None)

    # ---- figures of scores -------------------------------------------------------------------------

    def figure(
        self,
        what: str,
        quantity: Quantity,
        *methods: str,
        span: Span = UNBOUNDED,
        ratio: bool = False,
        note: str = "",
        form: str = ".2f",
    ) -> Figure:
        """Return `quantity` with its interval, over the seeds that all methods have.

        Args:
            what: Name of the figure; it seeds the interval.
            quantity: Function of the rates.
            methods: Labels of all methods that `quantity` reads, the subject first.
            span: Smallest and largest possible value.
            ratio: Whether the values are positive ratios, see `clbench.scoring.intervals.interval`.
            note: Restriction of the figure, in words. If empty, the note says why the figure decides nothing.
            form: Format of the number.
        """
        methods = tuple(dict.fromkeys(methods))
        missing = tuple(label for label in methods if label not in self.runs)
        common = self.common_seeds(methods)
        found = NO_ESTIMATE
        if common and not missing:
            generator = row_generator(self.scenario, what)
            scores = {label: [self.runs[label][seed].scores for seed in common] for label in methods}
            found = estimate_quantity(quantity, scores, generator, span=span, ratio=ratio)
        if not missing and not note:
            if not common:
                note = "the methods have no seed in common"
            elif found.value is None:
                note = "not measured in these records"
            elif len(common) < LEAST_SEEDS:
                note = "one seed: the interval does not cover other seeds and decides nothing"
        return Figure(what, methods, found, common, missing, note, form, span, ratio)

    def common_seeds(self, methods: Iterable[str]) -> tuple[int, ...]:
        """Return the seeds for which all methods have a run."""
        seeds = [set(self.runs.get(label, {})) for label in methods]
        return tuple(sorted(set.intersection(*seeds))) if seeds else ()

    def metric(self, name: str, method: str) -> Figure:
        """Return a metric of one method."""
        metric = load_metric(name)
        what, span = f"{_words(name)} of {method}", (metric.low, metric.high)
        return self.figure(what, measured(name, method), method, *metric.references, span=span)

    def difference(self, name: str, method: str, other: str, form: str = ".2f") -> Figure:
        """Return the difference of a metric between two methods."""
        one, two = measured(name, method), measured(name, other)
        metric = load_metric(name)
        methods, reach = (method, other, *metric.references), metric.high - metric.low
        what = f"{_words(name)}, {method} - {other}"
        return self.figure(what, lambda of: one(of) - two(of), *methods, span=(-reach, reach), form=form)

    # ---- figures of costs and diagnostics ----------------------------------------------------------

    def cost(self, name: str, method: str, what: str) -> Figure:
        """Return the mean of a cost over seeds."""
        return self._mean_of(method, what, lambda run: [getattr(run.record.costs, name)], ",.0f")

    def diagnostic(
        self,
        method: str,
        what: str,
        name: str,
        span: Span,
        form: str = ".2f",
        stage: int | None = None,
    ) -> Figure:
        """Return the mean of a diagnostic over stages and seeds, with its interval over seeds.

        Args:
            method: Label of the method.
            what: Name of the figure.
            name: Name of the diagnostic. A stage without it does not count.
            span: Least and greatest possible value.
            form: Format of the number.
            stage: The only stage that counts; all count if None.
        """

        def values(run: Run) -> list[Any]:
            of_stages = run.record.diagnostics.items()
            chosen = [found for number, found in of_stages if stage is None or number == str(stage)]
            known = [found.get(name) for found in chosen if isinstance(found, dict)]
            return [value for value in known if value is not None]

        return self._mean_of(method, what, values, form, span)

    def pooled(
        self, method: str, what: str, read: Callable[[Mapping[str, Any]], float], span: Span
    ) -> Figure:
        """Return the mean over seeds of what `read` computes from the diagnostics of a run, by stage.

        `read` returns NaN for diagnostics without a usable number.
        """
        return self._mean_of(method, what, lambda run: [read(run.record.diagnostics)], ".2f", span)

    def diagnostic_ratio(
        self, method: str, other: str, what: str, read: Callable[[Mapping[str, Any]], float]
    ) -> Figure:
        """Return the ratio of what `read` computes from the diagnostics of two methods, seed by seed.

        The ratio is averaged over seeds; `read` is as for `pooled`.
        """
        seeds = self.common_seeds((method, other))
        parts, wholes = (
            [read(self.runs[label][seed].record.diagnostics) for seed in seeds] for label in (method, other)
        )
        ratios = [part / whole for part, whole in zip(parts, wholes, strict=True)]
        return self._of_seeds(what, (method, other), seeds, ratios, ".3f", ratio=True)

    def share_of_preparation(self, method: str) -> Figure:
        """Return the share of a run's optimiser steps that its preparation took, mean over seeds."""

        def share(run: Run) -> Sequence[Any]:
            costs = run.record.costs
            steps, taken = costs.optimiser_steps, costs.preparation_steps
            return [taken / steps] if taken is not None and steps else []

        return self._mean_of(
            method, f"share of the optimiser steps that prepare {method}", share, ".1%", SHARE
        )

    def _mean_of(
        self,
        method: str,
        what: str,
        values: Callable[[Run], Sequence[Any]],
        form: str,
        span: Span = UNBOUNDED,
        *,
        ratio: bool = False,
    ) -> Figure:
        runs = self.runs.get(method, {})
        means = [number_mean(values(run)) for run in runs.values()]
        return self._of_seeds(what, (method,), tuple(runs), means, form, span, ratio=ratio)

    def _of_seeds(
        self,
        what: str,
        methods: tuple[str, ...],
        seeds: tuple[int, ...],
        values: Sequence[float],
        form: str,
        span: Span = UNBOUNDED,
        *,
        ratio: bool,
    ) -> Figure:
        """Return the mean of one value for each seed; none without a run, or if a value is not a number."""
        if not values or not np.isfinite(values).all():
            missing = tuple(label for label in methods if not self.runs.get(label))
            note = "" if missing else "not in these records"
            return Figure(what, methods, NO_ESTIMATE, seeds, missing, note, form)
        found = mean_of_seeds(values, span, ratio=ratio)
        return Figure(what, methods, found, seeds, (), "", form, span, ratio)

    def step_time(self, method: str) -> Figure:
        """Return the time of a step of the method, divided by sft's."""
        what = f"time of a step of {method} divided by sft's"
        return self._mean_of(method, what, lambda run: [step_ratio(run)], ".2f", ratio=True)


def number_mean(values: Sequence[Any]) -> float:
    """Return the mean of `values`, NaN if there are none or one is not a usable number."""
    if not values or not all(is_number(value) for value in values):
        return math.nan
    return statistics.fmean(values)


def _start_of(run: Run) -> datetime | None:
    """Return when a run started, None if its record does not say so: nothing checks this part of a record."""
    try:
        start = datetime.fromisoformat(str(run.record.timing.get("started")))
    except ValueError:
        return None
    return start if start.tzinfo else start.replace(tzinfo=UTC)


def _words(name: str) -> str:
    """Return a metric's words in the name of a figure. They seed its interval; titles of pages may change."""
    return name.replace("_", " ")


# ---- quantities --------------------------------------------------------------------------------------------


def measured(name: str, method: str) -> Quantity:
    """Return a metric of `method` as a quantity; the other methods are its references."""
    metric = load_metric(name)
    return lambda of: metric.over_runs(replace(of[method], references=of))


# ---- reading -----------------------------------------------------------------------------------------------


def read_evidence(records: Path, controls: Path) -> Callable[[str], Evidence]:
    """Read all records, and return a function that gives the evidence on a scenario.

    Missing folders count as empty. A run of the ladder has the label that `rung` returns. The ladder's folder
    lies beside that of the records.
    """
    scored, refused = read_runs(records, read_run, ALIKE)
    sifts = (like_the_board(scored), *ALIKE)
    changed, refused_controls = read_runs(controls, partial(read_run, changed=True), sifts)
    rungs, refused_rungs = read_ladder(ladder_of(records), scored)
    labelled = [
        *((run.label, run) for run in (*scored, *changed)),
        *((rung(apart_from_the_factor(run), run.record.run.changes[FACTOR]), run) for run in rungs),
    ]
    named = (("records", refused), ("controls", refused_controls))
    not_used = (
        *(NotShown(f"{name}/{one.path}", one.reason) for name, entries in named for one in entries),
        *refused_rungs,
    )

    def on(scenario: str) -> Evidence:
        runs: dict[str, dict[int, Run]] = {}
        for label, run in labelled:
            if run.table == scenario and run.scores.layout.target and not run.order:
                runs.setdefault(label, {})[run.seed] = run
        ordered = {label: dict(sorted(seeds.items())) for label, seeds in sorted(runs.items())}
        return Evidence(scenario, ordered, not_used)

    return on


def rung(method: str, factor: float) -> str:
    """Return the label of a run of the ladder: the method and its factor, such as "sft@0.3"."""
    return f"{method}@{factor:g}"
