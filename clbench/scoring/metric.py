"""The registry of metrics: named, versioned functions from the success rates of runs to one number.

A new metric is one function with the decorator `metric`: intervals, tables and tests then find it. The
metrics of the leaderboard are in `clbench.scoring.ours`, definitions of other papers in
`clbench.scoring.published`; `clbench.scoring.metrics` loads both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from clbench.scoring.layout import Array
from clbench.scoring.rates import Rates

Function = Callable[[Rates], Array]

DIFFERENCE = "difference of success rates"
"""Unit of a metric that subtracts success rates from each other."""

TIE = 1e-9
"""Greatest difference of equal values: quotients of whole numbers may differ in the last bit."""


@dataclass(frozen=True, kw_only=True)
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
    missing: str
    """Condition under which it has no value, in one sentence."""
    low: float = 0.0
    """Least possible value."""
    high: float = 1.0
    """Greatest possible value."""
    higher_is_better: bool | None = True
    """Whether a higher value is better; None if neither is."""
    units: str = "success rate"
    """Unit of the value."""
    references: tuple[str, ...] = ()
    """Methods whose records of the same seeds it needs."""
    compares_itself: bool = False
    """Whether a reference method also has a value, compared with itself."""
    pooled: bool = False
    """Whether the rates are averaged over seeds first; if not, the value is the mean of the seeds' values."""
    ratio: bool = False
    """Whether the value is a positive ratio: its mean over seeds is geometric, and so is its interval."""
    version: int = 0
    """Number of the definition."""

    def over_runs(self, rates: Rates) -> Array:
        """Return the value (...) over the runs of `rates`, whose last batch axis is the run: (..., runs)."""
        if any(name not in rates.references for name in self.references):
            return np.full(rates.success.shape[:-3], np.nan)
        if self.pooled:
            return self.function(rates.mean_over_runs())
        values = self.function(rates)
        return np.asarray(np.exp(np.log(values).mean(axis=-1)) if self.ratio else values.mean(axis=-1))

    def is_ahead(self, value: float | None, other: float | None) -> bool | None:
        """Return whether a value is better than another; None if neither is, or one is missing."""
        if value is None or other is None or self.higher_is_better is None or abs(value - other) <= TIE:
            return None
        return bool(value > other) == self.higher_is_better

    @property
    def direction(self) -> str:
        """Whether higher or lower is better, in words."""
        if self.higher_is_better is None:
            return "neither high nor low is better"
        return "higher is better" if self.higher_is_better else "lower is better"


REGISTRY: dict[str, Metric] = {}
"""Metrics by name, in the order of their definition: those whose module was imported."""


def metric(**facts: Any) -> Callable[[Function], Function]:
    """Return the decorator that enters a function into the registry as a metric.

    The metric has the name of the function, and the first line of its docstring as its description.

    Args:
        facts: Fields of `Metric`, apart from these: at least formula, source and missing.
    """

    def register(function: Function) -> Function:
        name, description = function.__name__, (function.__doc__ or "").partition("\n")[0]
        REGISTRY[name] = Metric(name=name, function=function, description=description, **facts)
        return function

    return register
