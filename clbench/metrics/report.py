"""The metrics of success matrices: their values, why some are missing, and where the order of methods flips.

All values come from the functions of the registry (`clbench.scoring.metrics`). Trials show which cells a
metric needs: for each missing cell in turn, the metric is computed for a matrix that lacks only this cell.
If the metric then has no value, it needs the cell.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.base.errors import UnknownNameError
from clbench.base.text import counted, did_you_mean, quoted
from clbench.metrics.definitions import DEFINITIONS, FAMILIES, INSTEAD
from clbench.scoring.intervals import interval
from clbench.scoring.layout import Array, Layout
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS, load_metric
from clbench.scoring.rates import Rates, leave_one_out

if TYPE_CHECKING:
    import pandas

PROBES = 64
"""Number of matrices that are tried at once; more are hardly faster, and take more memory."""
REPEATED = "gain"
"""Metric that counts in no flip: it repeats final_average, minus that of sft."""


@dataclass(frozen=True, eq=False)
class Matrices:
    """Success matrices of one or more methods on the same tasks."""

    layout: Layout
    """Groups and order of the tasks."""
    success: Mapping[str, Mapping[str, Array]]
    """Success rates by method and seed, (stages + 1, tasks), NaN where missing. A method or seed without a
    name is the empty text."""
    unit: str
    """Unit in which the rates were given: "share" or "percent"."""
    unit_was_given: bool
    """Whether the user named the unit; if not, it was chosen by the greatest rate."""
    largest: float
    """The greatest rate as it was given."""


@dataclass(frozen=True)
class Value:
    """The value of a metric for one method."""

    value: float | None
    """The value, the mean over seeds; None if something is missing."""
    low: float | None = None
    """Lower end of the 95 % interval over seeds; None with one seed, or if all seeds agree."""
    high: float | None = None
    """Upper end of the interval."""
    reason: str | None = None
    """Why there is no value; None if there is one."""


@dataclass(frozen=True)
class Flip:
    """Two methods that the definitions of one family put in different orders."""

    family: str
    """Family of the definitions."""
    first: str
    """Name of a method."""
    second: str
    """Name of another method."""
    first_is_better: tuple[str, ...]
    """Definitions by which the first is better."""
    second_is_better: tuple[str, ...]
    """Definitions by which the second is better."""


@dataclass(frozen=True, eq=False)
class Report:
    """Every metric of one or more success matrices; `report["final_average"].value` is one of them."""

    matrices: Matrices
    """What was measured."""
    values: Mapping[str, Mapping[str, Value]]
    """The values of all metrics of the registry, by metric and method."""

    @functools.cached_property
    def flips(self) -> tuple[Flip, ...]:
        """Where the order of two methods depends on the definition."""
        return tuple(_flips(self.values))

    @property
    def unit(self) -> str:
        """The unit in which the rates were given, or assumed to be: "share" or "percent"."""
        return self.matrices.unit

    def of(self, metric: str, method: str | None = None) -> Value:
        """Return the value of a metric for a method; without a name, for the only or first method.

        Raises:
            UnknownNameError: There is no such metric or method.
        """
        by_method = self.values[load_metric(metric).name]
        method = None if method is None else str(method)  # a table may name methods by numbers
        if method is not None and method not in by_method:
            if "" in by_method:
                raise UnknownNameError(f"These rates name no method: ask for {metric} without {method!r}.")
            raise unknown("method", method, by_method)
        return by_method[next(iter(by_method)) if method is None else method]

    def __getitem__(self, metric: str) -> Value:
        return self.of(metric)

    def frame(self) -> pandas.DataFrame:
        """Return one row for each metric and method, with value, interval, reason, assumption and source."""
        import pandas

        rows = [
            {
                "family": DEFINITIONS[name].family if name in DEFINITIONS else None,
                "metric": name,
                "method": method,
                "value": value.value,
                "low": value.low,
                "high": value.high,
                "reason": value.reason,
                "assumption": DEFINITIONS[name].assumption if name in DEFINITIONS else None,
                "source": METRICS[name].source,
            }
            for name, by_method in self.values.items()
            for method, value in by_method.items()
        ]
        return pandas.DataFrame(rows)


def measure(matrices: Matrices) -> Report:
    """Return all metrics of the registry for all methods."""
    values = {
        metric.name: {method: _value(metric, method, matrices) for method in matrices.success}
        for metric in METRICS.values()
    }
    return Report(matrices, values)


def _value(metric: Metric, method: str, matrices: Matrices) -> Value:
    """Return the value of a metric for a method, with its interval over seeds, or the reason."""
    if method in metric.references and not metric.compares_itself:
        return Value(None, reason=f"{method} is what the others are compared with.")
    runs = matrices.success[method]
    references = {
        name: _rates(np.stack([matrices.success[name][seed] for seed in runs]), matrices.layout)
        for name in metric.references
        if set(runs) <= set(matrices.success.get(name, ()))
    }
    rates = _rates(np.stack(list(runs.values())), matrices.layout)
    rates = replace(rates, references=references)
    value = float(metric.over_runs(rates))
    if not math.isfinite(value):
        return Value(None, reason=_reason(metric, method, matrices))
    others = metric.over_runs(leave_one_out(rates)) if len(runs) > 1 else np.zeros(0)
    found = interval(value, others, span=(metric.low, metric.high), ratio=metric.ratio)
    return Value(value, found.low, found.high)


def _rates(success: Array, layout: Layout) -> Rates:
    """Return rates of success at the ends of stages, (..., stages + 1, tasks); all else is missing."""
    batch, count, tasks = success.shape[:-2], len(layout.target), len(layout.tasks)

    def missing(*shape: int) -> Array:
        return np.broadcast_to(np.nan, (*batch, *shape))

    points = len(layout.steps)
    of_points = ("answer_curves", "update_sparsity", "activation_drift")
    of_stages = ("shift", "captured", "steps", "met")
    arrays: dict[str, Any] = {
        **dict.fromkeys(of_points, missing(count, points)),
        **dict.fromkeys(of_stages, missing(count)),
        **dict.fromkeys(("asked", "correct"), missing(count + 1, len(layout.kinds))),
    }
    return Rates(
        layout=layout,
        success=success,
        curves=missing(count, points, tasks),
        perturbed=missing(count + 1, tasks),
        relearning_steps=missing(),
        **arrays,
    )


# ---- reasons -----------------------------------------------------------------------------------------------


def needed_cells(
    metric: Metric, layout: Layout, among: NDArray[np.bool_] | None = None, of: str | None = None
) -> NDArray[np.bool_] | None:
    """Return which cells of a matrix a metric needs, (stages + 1, tasks); None if it needs other things.

    Args:
        metric: The metric.
        layout: Layout of the matrix.
        among: The cells that are tried, (stages + 1, tasks); the others count as not needed. None tries all.
        of: Name of the reference whose matrix it is, None for the method's own.
    """
    shape = len(layout.target) + 1, len(layout.tasks)
    if _without_value(metric, layout, np.full((1, *shape), 0.5), of).any():
        return None
    cells = np.argwhere(np.ones(shape) if among is None else among)
    needed = np.zeros(shape, dtype=bool)
    for start in range(0, len(cells), PROBES):
        stages, tasks = cells[start : start + PROBES].T
        matrices = np.full((len(stages), *shape), 0.5)
        matrices[np.arange(len(stages)), stages, tasks] = np.nan
        needed[stages, tasks] = _without_value(metric, layout, matrices, of)
    return needed


def _without_value(metric: Metric, layout: Layout, matrices: Array, of: str | None) -> NDArray[np.bool_]:
    """Return which of `matrices`, (n, stages + 1, tasks), leave a metric without a value, all else given."""
    given, complete = _rates(matrices, layout), _rates(np.full_like(matrices, 0.5), layout)
    references = {name: given if name == of else complete for name in metric.references}
    return np.isnan(metric.function(replace(given if of is None else complete, references=references)))


def _reason(metric: Metric, method: str, matrices: Matrices) -> str:
    """Return why a metric has no value for a method."""
    layout, runs = matrices.layout, matrices.success[method]
    places = _lacking(metric, layout, runs)
    if places is None:
        return metric.missing
    for name in metric.references:
        found = matrices.success.get(name)
        if found is None:
            return f"No method is called {name}.{did_you_mean(name, matrices.success)}"
        absent = [seed for seed in runs if seed not in found]
        if absent:
            words = (f"seed {quoted(seed)}" if seed else "matrix without a seed" for seed in absent)
            return f"Method {name} has no {', no '.join(words)}."
        if name != method:
            others = _lacking(metric, layout, {seed: found[seed] for seed in runs}, name) or ()
            places += [f"method {name}, {place}" for place in others]
    if not places:
        return metric.missing
    more = f" and {counted(len(places) - 1, 'other cell')}" if places[1:] else ""
    instead = f" {INSTEAD[metric.name]}" if metric.name in INSTEAD else ""
    return f"The table lacks {places[0]}{more}.{instead}"


def _lacking(
    metric: Metric, layout: Layout, runs: Mapping[str, Array], of: str | None = None
) -> list[str] | None:
    """Return the missing cells of `runs` that a metric needs, in words; the rest as for `needed_cells`."""
    success = np.stack(list(runs.values()))
    needed = needed_cells(metric, layout, np.isnan(success.mean(axis=0)), of)
    if needed is None:
        return None
    return [
        f"{f'seed {quoted(seed)}, ' if len(runs) > 1 else ''}stage {stage}, {layout.tasks[task]}"
        for seed, matrix in runs.items()
        for stage, task in np.argwhere(needed & np.isnan(matrix))
    ]


# ---- the order of the methods ------------------------------------------------------------------------------


def _flips(values: Mapping[str, Mapping[str, Value]]) -> Iterator[Flip]:
    """Yield the pairs of methods whose order depends on the definition, family by family."""
    methods = list(next(iter(values.values())))
    for family, (first, second) in itertools.product(FAMILIES, itertools.combinations(methods, 2)):
        better: dict[bool, list[str]] = {True: [], False: []}
        names = (name for name, one in DEFINITIONS.items() if one.family == family)
        for name in (name for name in names if name != REPEATED):
            sides = values[name][first].value, values[name][second].value
            ahead = METRICS[name].is_ahead(*sides)
            if ahead is not None:
                better[ahead].append(name)
        if better[True] and better[False]:
            yield Flip(family, first, second, tuple(better[True]), tuple(better[False]))
