"""The registry of metrics: named, versioned functions from the success rates of runs to one number.

A new metric is one function with the decorator `metric`: intervals, tables and tests then find it. The
metrics of the leaderboard are in `clbench.scoring.ours`, definitions of other papers in
`clbench.scoring.published`; `clbench.scoring.metrics` loads both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from clbench.scoring.layout import Array
from clbench.scoring.rates import Rates

Function = Callable[[Rates], Array]

DIFFERENCE = "difference of success rates"
"""Unit of a metric that takes success rates from each other."""


@dataclass(frozen=True)
class Metric:
    """A named, versioned definition of one number. A changed definition is a new version."""

    name: str
    """Name of its function and of its column everywhere."""
    function: Function
    """Maps rates with batch axes (...) to values (...), NaN where something is missing."""
    description: str
    """Meaning in one sentence."""
    formula: str
    """Formula, in words and in the letters of `clbench.scoring.ours`."""
    source: str
    """Paper or convention that defines it."""
    low: float
    """Least possible value."""
    high: float
    """Greatest possible value."""
    higher_is_better: bool | None
    """None if neither is better."""
    units: str
    """Unit of the value."""
    missing: str
    """Condition under which it has no value, in one sentence."""
    references: tuple[str, ...]
    """Methods whose records of the same seeds it needs."""
    compares_itself: bool
    """Whether a reference method has a value too, compared with itself."""
    pooled: bool
    """Whether the rates are averaged over seeds first; if not, the value is the mean of the seeds' values."""
    ratio: bool
    """Whether the value is a positive ratio: its mean over seeds is geometric, and so is its interval."""
    version: int
    """Number of the definition."""

    def over_runs(self, rates: Rates) -> Array:
        """Return the value (...) over the runs of `rates`, whose last batch axis is the run: (..., runs)."""
        if any(name not in rates.references for name in self.references):
            return np.full(rates.success.shape[:-3], np.nan)
        if self.pooled:
            return self.function(rates.mean_over_runs())
        values = self.function(rates)
        return np.asarray(np.exp(np.log(values).mean(axis=-1)) if self.ratio else values.mean(axis=-1))

    @property
    def direction(self) -> str:
        """Whether higher or lower is better, in words."""
        if self.higher_is_better is None:
            return "neither high nor low is better"
        return "higher is better" if self.higher_is_better else "lower is better"


REGISTRY: dict[str, Metric] = {}
"""Metrics by name, in the order of their definition: those whose module was imported."""


def metric(
    *,
    formula: str,
    source: str,
    missing: str,
    low: float = 0.0,
    high: float = 1.0,
    higher_is_better: bool | None = True,
    units: str = "success rate",
    references: tuple[str, ...] = (),
    compares_itself: bool = False,
    pooled: bool = False,
    ratio: bool = False,
    version: int = 0,
) -> Callable[[Function], Function]:
    """Return a decorator that registers a function as a metric, with its name and its docstring's first line.

    The arguments are the fields of `Metric`.
    """

    def enter(function: Function) -> Function:
        REGISTRY[function.__name__] = Metric(
            name=function.__name__,
            function=function,
            description=(function.__doc__ or "").partition("\n")[0],
            formula=formula,
            source=source,
            low=low,
            high=high,
            higher_is_better=higher_is_better,
            units=units,
            missing=missing,
            references=references,
            compares_itself=compares_itself,
            pooled=pooled,
            ratio=ratio,
            version=version,
        )
        return function

    return enter
