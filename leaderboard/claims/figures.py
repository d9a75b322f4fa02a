"""Figures that several claims use."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from clbench.scoring.layout import Array, average
from clbench.scoring.rates import Rates

from .evidence import Evidence, Figure, Of


def retained(rates: Rates) -> Array:
    """Return the success on the retained skills at all points (..., targets, points)."""
    return average(rates.retained_curves)


def sparsity(rates: Rates) -> Array:
    """Return the update sparsity at all points (..., targets, points)."""
    return rates.update_sparsity


def retention_drop(evidence: Evidence, method: str) -> Figure:
    """Return the drop in success on the retained skills from the pretrained policy to the end."""

    def drop(of: Of) -> Array:
        kept = average(of[method].retained)
        return average(kept[..., 0] - kept[..., -1])

    return evidence.figure(f"retained success, pretrained - {method} after the last target", drop, method)


def question_drop(evidence: Evidence, method: str) -> Figure:
    """Return the drop in question accuracy from the pretrained policy to the end."""

    def drop(of: Of) -> Array:
        return average(_accuracy(of[method], 0) - _accuracy(of[method], -1))

    what = f"question accuracy, pretrained - {method} after the last target"
    return evidence.figure(what, drop, method, form=".3f")


def answer_curve(evidence: Evidence, method: str) -> list[Figure]:
    """Return the drop in question accuracy after each evaluated step of the first target."""
    runs = evidence.runs.get(method, {})
    steps = next(iter(runs.values())).scores.layout.steps if runs else ()

    def drop(point: int) -> Callable[[Of], Array]:
        def at(of: Of) -> Array:
            return average(_accuracy(of[method], 0) - of[method].answer_curves[..., 0, point])

        return at

    what = "question accuracy, pretrained - {} after {} steps of the first target"
    return [
        evidence.figure(what.format(method, step), drop(point), method, form=".3f")
        for point, step in enumerate(steps)
    ]


def _accuracy(rates: Rates, stage: int) -> Array:
    """Return the share of correct answers at the end of a stage, NaN where no question was asked."""
    asked, correct = rates.asked[..., stage, :].sum(axis=-1), rates.correct[..., stage, :].sum(axis=-1)
    return np.where(asked > 0, correct / np.maximum(asked, 1), np.nan)


def sparsity_after(evidence: Evidence, method: str) -> tuple[Figure, Figure]:
    """Return the update sparsity at the end of the first stage and of the last."""

    def after(stage: int) -> Callable[[Of], Array]:
        return lambda of: average(of[method].update_sparsity[..., stage, -1])

    first, last = (
        evidence.figure(
            f"update sparsity of {method} after the {name} target", after(stage), method, form=".3f"
        )
        for name, stage in (("first", 0), ("last", -1))
    )
    return first, last


def matched_retention(evidence: Evidence, method: str, other: str) -> Figure:
    """Return the difference in retention where both methods have learned the target about as well as sft."""
    return evidence.matched_difference("retention", retained, method, other)


def drift_ratio(evidence: Evidence, method: str) -> Figure:
    """Return the activation drift divided by sft's, seed by seed."""

    def ratio(of: Of) -> Array:
        part, whole = (of[label].activation_drift[..., -1, -1] for label in (method, "sft"))
        return average(part / np.where(whole > 0, whole, np.nan))

    return evidence.figure(f"activation drift, {method} / sft", ratio, method, "sft")


def gain_over_random(evidence: Evidence) -> Figure:
    """Return the gain in forward transfer of the vector over a random vector of equal norms."""
    return evidence.difference("forward_transfer", "fast_dvla", "fast_dvla+direction=random", form=".3f")
