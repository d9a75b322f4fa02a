"""Figures that several claims use."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from clbench.scoring.intervals import NO_ESTIMATE, Estimate
from clbench.scoring.layout import Array, average
from clbench.scoring.rates import Rates
from clbench.scoring.reading import is_number
from clbench.scoring.scores import Scores

from .evidence import SHARE, Evidence, Figure, Of

SCENARIO_RATE = 1.0
"""Rung of the ladder with the scenario's own learning rate."""


def retention_drop(evidence: Evidence, method: str) -> Figure:
    """Return the drop in success on the retained skills from the pretrained policy to the end."""

    def drop(of: Of) -> Array:
        kept = average(of[method].retained)
        return average(kept[..., 0] - kept[..., -1])

    what = f"retained success, pretrained - {method} after the last target"
    return evidence.figure(what, drop, method, span=(-1, 1))


def retention_difference(evidence: Evidence, method: str, other: str) -> Figure:
    """Return the difference in success on the retained skills after the last target."""

    def difference(of: Of) -> Array:
        first, second = (average(of[label].retained)[..., -1] for label in (method, other))
        return average(first - second)

    what, note = f"retained success, {method} - {other}", _settings(evidence, method, other)
    return evidence.figure(what, difference, method, other, span=(-1, 1), note=note)


TOLD = ("replay", "tau_start", "loss_scale", "orthogonal", "schedule", "step_factor")
"""Hyper-parameters that show how the runs with a label differ from the published method."""


def _settings(evidence: Evidence, *methods: str) -> str:
    """Return the settings of methods that readers must know, for the note of a figure."""
    told = []
    for label in methods:
        run = evidence.first_run(label)
        values = run.record.run.settings if run else {}
        named = [f"{name} {values[name]:g}" for name in TOLD if is_number(values.get(name))]
        told += [f"{label}: {', '.join(named)}"] if named else []
    return "; ".join(told)


def share_of_steps(evidence: Evidence, method: str, other: str) -> Figure:
    """Return the steps to the criterion of `method` divided by those of `other`.

    It is the geometric mean over targets and seeds.

    A target that is never learned counts with the budget's steps, and a target that was known with one step.
    """

    def ratio(of: Of) -> Array:
        first, second = (np.log(np.maximum(of[label].steps, 1.0)) for label in (method, other))
        return np.exp(average(average(first - second)))

    what, note = f"steps to the criterion, {method} / {other}", _settings(evidence, method, other)
    return evidence.figure(what, ratio, method, other, ratio=True, note=note)


def question_drop(evidence: Evidence, method: str) -> Figure:
    """Return the drop in question accuracy from the pretrained policy to the end."""

    def drop(of: Of) -> Array:
        return average(of[method].answered[..., 0] - of[method].answered[..., -1])

    what = f"question accuracy, pretrained - {method} after the last target"
    return evidence.figure(what, drop, method, span=(-1, 1), form=".3f")


def loses_no_answers(drop: Figure) -> bool:
    """Return whether the drop in question accuracy was measured, and is not certainly above 0.01."""
    return not drop.is_unknown and not drop.low > 0.01


def answer_curve(evidence: Evidence, method: str) -> list[Figure]:
    """Return the drop in question accuracy after each evaluated step of the first target."""
    first = evidence.first_run(method)
    steps = first.scores.layout.steps if first else ()

    def drop(point: int) -> Callable[[Of], Array]:
        def at(of: Of) -> Array:
            return average(of[method].answered[..., 0] - of[method].answer_curves[..., 0, point])

        return at

    what = "question accuracy, pretrained - {} after {} steps of the first target"
    return [
        evidence.figure(what.format(method, step), drop(point), method, span=(-1, 1), form=".3f")
        for point, step in enumerate(steps)
    ]


def learning_curve(evidence: Evidence, method: str) -> tuple[tuple[int, ...], list[float]]:
    """Return the evaluated steps of the first target, and the mean success on it after each."""
    runs = evidence.runs.get(method, {})
    if not runs:
        return (), []
    rates = [run.scores.rates() for run in runs.values()]
    curves = np.mean([one.learning_curves[0] for one in rates], axis=0)
    return next(iter(runs.values())).scores.layout.steps, [float(value) for value in curves]


def early_success(evidence: Evidence, method: str, other: str) -> Figure:
    """Return the difference in success on the targets, averaged over the evaluated steps of a stage.

    The distances of the points halve towards the beginning, so that the mean tells how early a target is
    learned.
    """

    def difference(of: Of) -> Array:
        first, second = (average(average(of[label].learning_curves)) for label in (method, other))
        return average(first - second)

    what = f"success on the targets, mean over the evaluated steps, {method} - {other}"
    return evidence.figure(what, difference, method, other, span=(-1, 1))


IMPOSSIBLE = frozenset({"carry_back"})
"""Targets that no policy can do in some perturbed episodes: with a block of twice the mass the expert of
carry_back fails in 49 of 49 episodes, and plain fine-tuning loses 0.41 on it and 0.01 on the others."""


def perturbation_loss(evidence: Evidence, method: str) -> Figure:
    """Return the success on each new target minus its success in perturbed episodes, see `IMPOSSIBLE`."""
    what, possible = f"success on new targets, plain - perturbed, {method}", _possible(evidence)
    return possible.figure(what, lambda of: average(_lost_by_perturbation(of[method])), method, span=(-1, 1))


def perturbation_gain(evidence: Evidence, method: str, other: str) -> Figure:
    """Return how much less success on new targets `method` loses in perturbed episodes than `other`."""

    def gain(of: Of) -> Array:
        return average(_lost_by_perturbation(of[other]) - _lost_by_perturbation(of[method]))

    what = f"loss in perturbed episodes, {other} - {method}"
    return _possible(evidence).figure(what, gain, method, other, span=(-1, 1))


def _lost_by_perturbation(rates: Rates) -> Array:
    """Return the mean loss over the targets whose perturbed episodes are known, NaN without any."""
    of_targets = rates.perturbed[..., 1:, rates.layout.columns("target")]
    lost = rates.learned - np.diagonal(of_targets, axis1=-2, axis2=-1)
    known = np.isfinite(lost)
    total: Array = np.where(known, lost, 0.0).sum(axis=-1)
    return total / np.where(known.any(axis=-1), known.sum(axis=-1), np.nan)


def _possible(evidence: Evidence) -> Evidence:
    """Return the evidence without the perturbed episodes of `IMPOSSIBLE`."""
    every = (run for seeds in evidence.runs.values() for run in seeds.values())
    found = {name for run in every for name in run.scores.layout.target}
    if not found & IMPOSSIBLE:
        return evidence
    runs = {
        label: {seed: replace(run, scores=_without_impossible(run.scores)) for seed, run in seeds.items()}
        for label, seeds in evidence.runs.items()
    }
    return replace(evidence, runs=runs)


def _without_impossible(scores: Scores) -> Scores:
    columns = [place for place, name in enumerate(scores.layout.tasks) if name in IMPOSSIBLE]
    perturbed = scores.perturbed.copy()
    perturbed[:, columns] = np.nan
    return replace(scores, perturbed=perturbed)


def drift_ratio(evidence: Evidence, method: str) -> Figure:
    """Return how far hidden states move, relative to sft, as the geometric mean over seeds.

    The recorded drift is a squared distance.
    """

    def ratio(of: Of) -> Array:
        part, whole = (of[label].activation_drift[..., -1, -1] for label in (method, "sft"))
        with np.errstate(divide="ignore"):  # a policy that stays the same has a drift of 0
            return np.exp(average(np.log(part / np.where(whole > 0, whole, np.nan))) / 2)

    what = f"distance that training moves the hidden states of questions, {method} / sft"
    return evidence.figure(what, ratio, method, "sft", ratio=True)


RANDOM = "aegis+direction=random"
"""AEGIS's control."""


def anchor_ratio(evidence: Evidence) -> Figure:
    """Return the distance at which AEGIS keeps a batch from its anchor, divided by that of the control.

    The distance is the quantity that AEGIS acts on, on the robot's batches at the end of the first stage.
    The control has a random direction, and sheds nearly no energy; plain fine-tuning has no anchor.
    """
    what = f"distance of a batch to the anchor, aegis / {RANDOM}"
    return evidence.diagnostic_ratio("aegis", RANDOM, what, partial(_distance, place=-1))


ENDS = {"before the first step": 0, "at the end of the first stage": -1}
"""Places among the distances of the first stage, by their names in a sentence."""


def anchor_distance(evidence: Evidence, method: str, end: str) -> Figure:
    """Return the distance of a batch to AEGIS's anchor at one of `ENDS`, mean over seeds."""
    what = f"distance of a batch to the anchor {end}, {method}"
    return evidence.pooled(method, what, partial(_distance, place=ENDS[end]), (0, math.inf))


def _distance(diagnostics: Mapping[str, Any], place: int) -> float:
    """Return one of the distances of a batch to the anchor in the first stage, NaN if there is none.

    Records have the squared distance.
    """
    found = diagnostics.get("1")
    values = found.get("anchor_distance") if isinstance(found, dict) else None
    value: Any = values[place] if isinstance(values, list) and values else None
    return math.sqrt(value) if is_number(value) and value > 0 else math.nan


def median_stage(evidence: Evidence, method: str) -> Figure:
    """Return the median of the steps to the criterion over targets and seeds, without an interval."""
    runs = evidence.runs.get(method, {})
    steps = np.array([run.scores.rates().steps for run in runs.values()])
    is_known = steps.size > 0 and bool(np.isfinite(steps).all())  # stages of a fixed length have none
    found = Estimate(float(np.median(steps)), None, None) if is_known else NO_ESTIMATE
    missing, note = (() if runs else (method,)), "" if is_known or not runs else "not in these records"
    what = f"steps to the criterion of {method}, median"
    return Figure(what, (method,), found, tuple(runs), missing, note, ".0f")


def share_between(evidence: Evidence, method: str, afterwards: bool = False) -> Figure:
    """Return the share of ConSFT's weights between 0.01 and 0.9 before the last tenth of the schedule.

    Weights below this range are near the floor, most of them alike, and weights above it are those of plain
    fine-tuning. In the last tenth and after the schedule the method is plain fine-tuning for small losses by
    design.

    Args:
        evidence: Records of the scenario.
        method: Label of the method.
        afterwards: Whether to take the weights of the last tenth and after it instead.
    """

    def share(diagnostics: Mapping[str, Any]) -> float:
        chosen = [table[-1:] if afterwards else table[:-1] for table in _weights(diagnostics)]
        total = sum(float(table.sum()) for table in chosen)
        return sum(float(table[:, 1:-1].sum()) for table in chosen) / total if total > 0 else math.nan

    part = "last tenth of the schedule and after it" if afterwards else "first nine tenths of the schedule"
    return evidence.pooled(
        method, f"share of the weights of {method} between 0.01 and 0.9, {part}", share, SHARE
    )


def share_afterwards(evidence: Evidence, method: str) -> Figure:
    """Return the share of ConSFT's weights in the last tenth of the schedule and after it.

    A stage to a criterion may last longer than the schedule, so that this part may be the larger one.
    """

    def share(diagnostics: Mapping[str, Any]) -> float:
        tables = _weights(diagnostics)
        total = sum(float(table.sum()) for table in tables)
        return sum(float(table[-1].sum()) for table in tables) / total if total > 0 else math.nan

    what = f"share of the weights of {method} in the last tenth of the schedule and after it"
    return evidence.pooled(method, what, share, SHARE)


def _weights(diagnostics: Mapping[str, Any]) -> list[Array]:
    """Return the histograms of the weights of each stage, (tenths of the schedule, bins)."""
    stages = (stage for stage in diagnostics.values() if isinstance(stage, dict))
    tables = (np.asarray(stage.get("omega_counts", []), dtype=np.float64) for stage in stages)
    return [table for table in tables if table.ndim == 2 and table.shape[1] > 2]
