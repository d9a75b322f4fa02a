"""Success rates, the input of every metric."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from clbench.base.errors import InputError
from clbench.scoring.layout import Array, Layout


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """Arrays that scores and rates have in common, with any batch axes in front, NaN where missing."""

    layout: Layout
    """Meaning of the axes."""
    asked: Array
    """Questions asked at the end of each stage, (..., stages + 1, kinds)."""
    correct: Array
    """Questions answered correctly, (..., stages + 1, kinds)."""
    answer_curves: Array
    """Share of all questions answered correctly at the points of each stage, (..., targets, points)."""
    update_sparsity: Array
    """Share of the parameters that have hardly changed since pretraining, (..., targets, points)."""
    activation_drift: Array
    """Distance of the hidden states from the pretrained policy's, (..., targets, points)."""
    shift: Array
    """Change of the policy on each stage's target in the stage, (..., targets)."""
    captured: Array
    """Share of episodes after each stage in which its target is done instead of a skill, (..., targets)."""
    steps: Array
    """Optimiser steps to the criterion, all of the budget if never met, (..., targets); NaN without one."""
    met: Array
    """Whether each stage met its criterion, 0 or 1, (..., targets); NaN without a criterion."""
    relearning_steps: Array
    """Optimiser steps to relearn the skill that succeeds least, (...)."""


def _arrays(cls: type[Measured]) -> tuple[str, ...]:
    return tuple(entry.name for entry in fields(cls) if entry.name not in ("layout", "references"))


MEASURED = _arrays(Measured)
"""Names of the arrays that scores and rates have in common."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rates(Measured):
    """Success rates, the input of every metric: arrays with any batch axes in front, NaN where missing."""

    success: Array
    """Success rate at the end of each stage, (..., stages + 1, tasks)."""
    curves: Array
    """Success rate at the points of each stage, (..., targets, points, tasks); the last one is its end."""
    perturbed: Array
    """Success rate in perturbed episodes on the skills and each stage's target, (..., stages + 1, tasks)."""
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

    @property
    def starts(self) -> Array:
        """Success rate on target k before stage k, (..., targets)."""
        return np.diagonal(self.target[..., :-1, :], axis1=-2, axis2=-1)

    @property
    def answered(self) -> Array:
        """Share of all questions answered correctly at the end of each stage, (..., stages + 1)."""
        return share_of_correct(self.asked, self.correct)

    @property
    def have_curves(self) -> bool:
        """Whether stages have learning curves: with a criterion, only the end of a stage is evaluated."""
        return not self.layout.to_criterion

    @property
    def learning_curves(self) -> Array:
        """Success rate on target k at the points of stage k, (..., targets, points)."""
        curves = self.curves[..., self.layout.columns("target")]
        return np.swapaxes(np.diagonal(curves, axis1=-3, axis2=-1), -1, -2)

    @property
    def retained_curves(self) -> Array:
        """Success rate on the retained skills at each point, (..., targets, points, retained)."""
        return self.curves[..., self.layout.columns("retained")]

    def each(self, change: Callable[[Array], Array]) -> Rates:
        """Return rates with `change` applied to all arrays, the references' included."""
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in _arrays(Rates)}
        references = {name: rates.each(change) for name, rates in self.references.items()}
        return replace(self, references=references, **changed)

    def mean_over_runs(self) -> Rates:
        """Return rates averaged over the last batch axis, the runs: (..., runs) becomes (...)."""
        # counted from the front: after the batch axes some arrays have two axes and some have three
        axis = self.success.ndim - 3
        return self.each(lambda array: np.mean(array, axis=axis))


def share_of_correct(asked: Array, correct: Array) -> Array:
    """Return the share of correct answers (...) from counts (..., kinds), NaN if a kind was not asked."""
    complete = (asked > 0).all(axis=-1) & (asked.sum(axis=-1) > 0)
    return np.where(complete, correct.sum(axis=-1) / np.maximum(asked.sum(axis=-1), 1), np.nan)


def stacked(rates: Sequence[Rates], axis: int = 0) -> Rates:
    """Return rates with one layout as one, along a new batch axis and without their references."""
    joined: dict[str, Any] = {
        name: np.stack([getattr(part, name) for part in rates], axis) for name in _arrays(Rates)
    }
    return Rates(layout=rates[0].layout, **joined)


def leave_one_out(rates: Rates) -> Rates:
    """Return the rates of all runs but one, for each one: (runs,), two or more, becomes (runs, runs - 1)."""
    numbers = np.arange(len(rates.success))
    others = np.array([np.delete(numbers, one) for one in numbers])
    return rates.each(lambda array: array[others])


def check_same(layouts: Iterable[Layout]) -> None:
    """Refuse runs whose layouts differ."""
    if len(set(layouts)) != 1:
        raise InputError("Runs with different tasks, episodes, evaluation points or questions do not mix.")
