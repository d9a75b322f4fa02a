"""The metrics of the leaderboard: clbench's own, and those of papers that its tables show.

In the formulas R[l][s] is the success rate on task s at the end of stage l, stage 0 is the pretrained policy,
target k is learned in stage k, and K is the last stage.
"""

from __future__ import annotations

import math

import numpy as np

from clbench.scoring.layout import Array, average
from clbench.scoring.metric import DIFFERENCE, metric
from clbench.scoring.rates import Rates
from clbench.spec.references import BASELINE, FROM_SCRATCH


@metric(
    formula="mean of R[K][s] over the retained skills and the targets",
    source="clbench; ACC of GEM, arXiv 1706.08840, with the retained skills counted in",
    missing="A success after the last target on a retained skill or a target is missing.",
)
def final_average(rates: Rates) -> Array:
    """Success after the last target on everything that was ever trained."""
    return average(np.concatenate([rates.retained[..., -1, :], rates.target[..., -1, :]], axis=-1))


@metric(
    formula="mean of R[k][k] over the targets k",
    source="the diagonal of the matrix of arXiv 1706.08840",
    missing="There are no targets, or the success on one right after it was learned is missing.",
)
def adaptation(rates: Rates) -> Array:
    """Success on each target right after it was learned."""
    return average(rates.learned)


@metric(
    formula="mean of R[K][s] over the retained skills s",
    source="clbench",
    missing="There are no retained skills, or the success on one after the last target is missing.",
)
def retention(rates: Rates) -> Array:
    """Success on the retained skills after the last target."""
    return average(rates.retained[..., -1, :])


@metric(
    formula="mean of R[K][k] over all targets k but the last",
    source="clbench",
    missing="There are fewer than two targets, or a success on an earlier one is missing.",
)
def kept_targets(rates: Rates) -> Array:
    """Success on the earlier targets after the last one."""
    return average(rates.target[..., -1, :-1])


@metric(
    formula="mean of R[K][s] over the retained skills and all targets but the last",
    source="clbench",
    missing="There is neither a retained skill nor an earlier target, or a success on one after the last "
    "target is missing.",
)
def kept(rates: Rates) -> Array:
    """Success on the retained skills and the earlier targets after the last one."""
    return average(np.concatenate([rates.retained[..., -1, :], rates.target[..., -1, :-1]], axis=-1))


@metric(
    formula="mean over the stages l from 1 of the mean of R[l][s] over the retained skills s",
    source="clbench",
    missing="There are no retained skills or no targets, or a success on a skill at the end of a stage is "
    "missing.",
)
def kept_skills_over_stages(rates: Rates) -> Array:
    """Success on the retained skills at the ends of all stages."""
    return average(average(rates.retained[..., 1:, :]))


@metric(
    formula="mean over the stages l from 2 of the mean of R[l][k] over the targets k before l",
    source="clbench",
    missing="There are fewer than two targets, or a success on an earlier one is missing.",
)
def kept_targets_over_stages(rates: Rates) -> Array:
    """Success on the earlier targets at the ends of all later stages."""
    count = len(rates.layout.target)
    before = np.tri(count, k=-1)[1:]
    shares = before / np.maximum(before.sum(axis=-1, keepdims=True), 1)
    # a target that was not learned yet may be missing without harm
    known = np.where(shares > 0, rates.target[..., 2:, :], 0.0)
    return average((known * shares).sum(axis=-1))


@metric(
    formula="mean over the stages l from 1 (from 2 without retained skills) of the mean of R[l][s] over the "
    "retained skills and the targets before l",
    source="clbench",
    version=1,
    missing="Nothing is known before any stage, neither a retained skill nor an earlier target, or a success "
    "on it at the end of the stage is missing.",
)
def kept_over_stages(rates: Rates) -> Array:
    """Success at the ends of all stages on everything that was known before the stage."""
    after, _, count = _known(rates)
    return average(after / count)


@metric(
    formula="mean over the stages l from 1 (from 2 without retained skills) of the sum of R[l][s] divided by "
    "the sum of R[l-1][s], both over the retained skills and the targets before l",
    source="clbench",
    version=1,
    high=math.inf,
    units="share of what was known",
    missing="Nothing is known before any stage, neither a retained skill nor an earlier target, or a success "
    "on it is missing, or all are 0 before a stage.",
)
def kept_share(rates: Rates) -> Array:
    """Share of the success before a stage that remains at its end, averaged over the stages."""
    after, before, _ = _known(rates)
    return average(after / np.where(before > 0, before, np.nan))


def _known(rates: Rates) -> tuple[Array, Array, Array]:
    """Return the sums of success on what was known before each stage, at its end and before it.

    Without retained skills nothing was known before the first stage: it does not count.

    Returns:
        The sums at the end of each stage and before it, both (..., stages), and the number of tasks known
        before each stage, (stages,).
    """
    skills, count = len(rates.layout.retained), len(rates.layout.target)
    learned = np.tri(count, k=-1)
    after = rates.retained[..., 1:, :].sum(axis=-1) + _where(learned, rates.target[..., 1:, :])
    before = rates.retained[..., :-1, :].sum(axis=-1) + _where(learned, rates.target[..., :-1, :])
    first = 0 if skills else 1
    return after[..., first:], before[..., first:], skills + np.arange(first, count, dtype=float)


def _where(chosen: Array, values: Array) -> Array:
    """Return the sum along the last axis of the values that are chosen (1 or 0)."""
    return np.asarray(np.where(chosen > 0, values, 0.0).sum(axis=-1))


@metric(
    formula="final_average minus the final_average of sft with the same seed",
    source="clbench",
    low=-1.0,
    units=DIFFERENCE,
    references=(BASELINE,),
    compares_itself=True,
    missing=f"There is no {BASELINE} of the same seeds, or a final average is missing.",
)
def gain(rates: Rates) -> Array:
    """Final average minus the final average of plain fine-tuning, seed by seed."""
    return final_average(rates) - final_average(rates.references[BASELINE])


@metric(
    formula="mean over the targets of the optimiser steps until the criterion was met; a stage that never "
    "met it counts as the full budget of steps",
    source="clbench",
    high=math.inf,
    higher_is_better=False,
    units="optimiser steps",
    missing="The scenario has no criterion.",
)
def steps_to_criterion(rates: Rates) -> Array:
    """Optimiser steps until a target was learned."""
    return average(rates.steps)


@metric(
    formula="share of the targets whose stage met the criterion within the budget's steps",
    source="clbench",
    units="share of the targets",
    missing="The scenario has no criterion.",
)
def criterion_met(rates: Rates) -> Array:
    """Share of the targets whose stage met the criterion; all targets count in the other metrics."""
    return average(rates.met)


@metric(
    formula="geometric mean over targets and seeds of the steps that from_scratch takes to the criterion "
    "divided by the steps that the method takes, each at least 1",
    source="clbench; the speed of forward transfer, arXiv 2105.10919, without a ceiling",
    high=math.inf,
    units="times as fast",
    references=(FROM_SCRATCH,),
    ratio=True,
    missing="The scenario has no criterion, no stage of a run met it, or there is no "
    f"{FROM_SCRATCH} of the same seeds.",
    version=1,
)
def speed(rates: Rates) -> Array:
    """Speed of learning the targets, relative to learning from scratch.

    A stage that never meets its criterion counts as the full budget of steps. If from_scratch has such a
    stage, the value is too low; if the method has one, it is too high.
    """
    ratios = np.maximum(rates.references[FROM_SCRATCH].steps, 1.0) / np.maximum(rates.steps, 1.0)
    return np.where(average(rates.met) > 0, np.exp(average(np.log(ratios))), np.nan)


@metric(
    formula="mean over the retained skills s of the success on s after the last target in perturbed episodes",
    source="clbench",
    missing="The run has no perturbed episodes; `clbench run --perturb` adds them.",
)
def perturbed_retention(rates: Rates) -> Array:
    """Success on the retained skills after the last target, with perturbed start poses, masses and views.

    The episodes are the same as for `retention`, number by number: the difference is the loss caused by
    the perturbation. The success of the pretrained policy shows how much of that loss was there before any
    target.
    """
    return average(rates.perturbed[..., -1, rates.layout.columns("retained")])


@metric(
    formula="mean over the targets k of the success on target k at the end of stage k in perturbed episodes",
    source="clbench; the spatial overfitting of ConSFT, arXiv 2605.08879, Sec. 5.5",
    missing="The run has no perturbed episodes; `clbench run --perturb` adds them.",
)
def perturbed_adaptation(rates: Rates) -> Array:
    """Success on each target after it was learned, with perturbed start poses, masses and views.

    The episodes are the same as for `adaptation`, number by number: the difference is what the policy has
    learned for the demonstrated starts alone.
    """
    of_targets = rates.perturbed[..., 1:, rates.layout.columns("target")]
    return average(np.diagonal(of_targets, axis1=-2, axis2=-1))


@metric(
    formula="mean over the retained skills and all targets but the last of the highest R[l][s], from where s "
    "is known (stage 0 for skills, stage k for target k) to stage K-1, minus R[K][s]",
    source="Chaudhry et al. 2018, arXiv 1801.10112; the retained skills counted in",
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
    missing="A success that it needs is missing, or nothing is known before the last stage.",
)
def forgetting(rates: Rates) -> Array:
    """Drop from the best success before the last stage to the success after it.

    The highest of several noisy rates is biased upwards, so with few episodes even a policy that never
    changes has a small positive value. `backward_transfer` has no such bias.
    """
    # The last target has no stage between learning it and the end.
    known = np.concatenate([rates.retained, rates.target[..., :-1]], axis=-1)
    learned_in = np.array([0] * rates.retained.shape[-1] + list(range(1, rates.target.shape[-1])))
    if not known.shape[-1] or known.shape[-2] == 1:
        return np.full(known.shape[:-2], np.nan)
    seen = np.arange(known.shape[-2] - 1)[:, None] >= learned_in
    best = np.where(seen, known[..., :-1, :], -np.inf).max(axis=-2)
    return average(best - known[..., -1, :])


@metric(
    formula="mean of R[K][k] - R[k][k] over all targets k but the last",
    source="GEM, arXiv 1706.08840 (BWT)",
    low=-1.0,
    units=DIFFERENCE,
    missing="There are fewer than two targets, or a success on an earlier one is missing.",
)
def backward_transfer(rates: Rates) -> Array:
    """Change in success on the earlier targets from learning the later ones."""
    return average(rates.target[..., -1, :-1] - rates.learned[..., :-1])


@metric(
    formula="mean over the targets of (A - B) / (1 - B); A is the area under the learning curve divided by "
    "the stage's steps, B the same for a policy that learns the target from scratch; the curve starts with "
    "R[k-1][k], the one from scratch with 0",
    source="Continual World, arXiv 2105.10919 (FT)",
    low=-math.inf,
    units="share of the area that learning from scratch leaves",
    references=(FROM_SCRATCH,),
    pooled=True,
    missing="Stages end at a criterion, a point of a learning curve is missing, or there is no "
    f"{FROM_SCRATCH} of the same seeds.",
)
def forward_transfer(rates: Rates) -> Array:
    """How much faster targets are learned than from scratch.

    Conventions, where the source leaves room:

    1. Trapezoid rule through the evaluation points and a point at step 0. A stage starts with the policy of
       the stage before, so that its point at step 0 is R[k-1][k]: success without a step counts as transfer.
    2. The policy from scratch starts untrained and is not evaluated then: it is taken to have no success at
       step 0. For manipulation this is true to a few in a thousand. Where it is not, the value is too high by
       at most half the first interval's share of the stage times the untrained policy's success. Curves that
       begin at the first common point instead would leave out the very part in which transfer shows.
    3. Curves are averaged over seeds before the ratio, as in the source's code.
    4. The value is capped by 1 and not bounded below. Point 2 keeps the divisor above 0.
    """
    area = _area(rates.layout.steps, rates.learning_curves, rates.starts)
    curves_from_scratch = rates.references[FROM_SCRATCH].learning_curves
    area_from_scratch = _area(rates.layout.steps, curves_from_scratch, np.zeros_like(rates.starts))
    gained = (area - area_from_scratch) / (1 - area_from_scratch)
    return average(np.where(rates.have_curves, gained, np.nan))


def _area(steps: tuple[int, ...], curves: Array, starts: Array) -> Array:
    """Return the area (..., targets) under the curves (..., targets, points), divided by the last step."""
    heights = np.concatenate([starts[..., None], curves], axis=-1)
    return np.asarray(np.trapezoid(heights, np.array([0, *steps]) / steps[-1], axis=-1))


@metric(
    formula="correct answers divided by questions, of all kinds together, at the end of stage K",
    source="clbench",
    units="share of correct answers",
    missing="No question was asked after the last target.",
)
def question_retention(rates: Rates) -> Array:
    """Share of the questions about the scene that are answered correctly after the last target."""
    return rates.answered[..., -1]


@metric(
    formula="mean of R[K][s] over the held-out tasks s",
    source="arXiv 2603.11653 (ZS)",
    missing="There are no held-out tasks, or the success on one after the last target is missing.",
)
def zero_shot(rates: Rates) -> Array:
    """Success after the last target on tasks that were never trained."""
    return average(rates.held_out[..., -1, :])


@metric(
    formula="share of the parameters p with |p - q| / (|q| + 1e-8) < 1e-3 at the end of stage K; q is the "
    "pretrained value of p. Parameters without a gradient count as unchanged: the answer head, and the rows "
    "of words that no instruction has (29 % on Fetch-v1; plain fine-tuning moves nearly all others)",
    source="ConSFT, arXiv 2605.08879, Eq. 8",
    higher_is_better=None,
    units="share of parameters",
    missing="It was not measured after the last target, for example because a method changes the set of "
    "parameters.",
)
def update_sparsity(rates: Rates) -> Array:
    """Share of the parameters that hardly changed between the pretrained policy and the final one."""
    return _at_the_end(rates.update_sparsity)


@metric(
    formula="squared 2-Wasserstein distance between the hidden states of the policy and of the pretrained "
    "policy on the test questions, mean over layers, at the end of stage K",
    source="AEGIS, arXiv 2604.16067; its penalty is computed on the training batch, this metric on questions",
    high=math.inf,
    higher_is_better=False,
    units="squared distance",
    missing="It was not measured after the last target.",
)
def activation_drift(rates: Rates) -> Array:
    """Distance between the hidden states after the last target and those of the pretrained policy."""
    return _at_the_end(rates.activation_drift)


@metric(
    formula="mean over the stages k of the mean of (v[k] - v[k-1])^2 over the valid actions of 256 samples "
    "of target k's demonstrations; v[k] is what the policy predicts in its loss at the end of stage k, in "
    "normalised actions: a flow policy the velocity, a discrete-diffusion policy the action",
    source="the flow policy's analogue of the KL divergence on the new task, which predicts forgetting in "
    "RL's Razor, arXiv 2509.04259",
    high=math.inf,
    higher_is_better=None,
    units="squared prediction",
    missing="It was not measured at the end of a stage.",
)
def shift(rates: Rates) -> Array:
    """Change of the predicted actions on each new target's data while the target is learned."""
    return average(rates.shift)


@metric(
    formula="mean over the stages k of the share of episodes at the end of stage k, in target k's scenes, in "
    "which target k is done although the instruction asks for a retained skill, the skills in turn",
    source="clbench",
    higher_is_better=False,
    missing="The scenario has no criterion or retains no skill, or the record is older than this metric.",
)
def instruction_capture(rates: Rates) -> Array:
    """Share of episodes in which the policy does the latest target although it was asked for a skill."""
    return average(rates.captured)


@metric(
    formula="optimiser steps of plain fine-tuning on the skill's demonstrations until the criterion is met, "
    "from a copy of the policy at the end of stage K; the skill is the one with the fewest successes in its "
    "validation episodes then; if it never meets the criterion, all steps of a stage",
    source="clbench; savings in relearning, Ebbinghaus 1885",
    high=math.inf,
    higher_is_better=False,
    units="optimiser steps",
    missing="The scenario has no criterion or retains no skill, it is a tuning run, or plain fine-tuning of "
    "the final policy failed.",
)
def relearning_steps(rates: Rates) -> Array:
    """Optimiser steps to relearn the retained skill that succeeds least, after the last target."""
    return rates.relearning_steps


def _at_the_end(values: Array) -> Array:
    """Return the last of values (..., targets, points), NaN without targets."""
    return values[..., -1, -1] if values.shape[-2] else np.full(values.shape[:-2], np.nan)
