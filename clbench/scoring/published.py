"""Metrics as other benchmarks, papers and libraries define them, and two of clbench's own on other tasks.

One word has many meanings in this field: here each definition carries the name of its source. As published,
the metrics cover the sequence of learned tasks: the targets, without the retained skills and the held-out
tasks. The last two metrics, `zero_shot_change` and `minimum_retention`, cover those; they are here because
the order of the definitions is that of the columns of leaderboard.csv.

R[l][k] is the success on target k at the end of stage l, and K is the last stage. Between the ends of the
stages only the current target is known, so that earlier and later targets count only at the ends.
"""

from __future__ import annotations

import numpy as np

from clbench.scoring.layout import Array, average
from clbench.scoring.metric import DIFFERENCE, metric
from clbench.scoring.rates import Rates
from clbench.spec.references import JOINT

ALL_TARGETS = "There are no targets, or a success on one at the end of a stage that it needs is missing."
TWO_TARGETS = "There are fewer than two targets, or a success on one at the end of a stage is missing."


def _matrix(rates: Rates) -> Array:
    """Return R[l][k] for the stages l from 1 and the targets k, (..., targets, targets)."""
    return rates.target[..., 1:, :]


def _later(rates: Rates) -> Array:
    """Return 1 where stage l comes after the stage of target k, else 0: (targets, targets)."""
    return np.tri(len(rates.layout.target), k=-1)


def _drops(rates: Rates) -> Array:
    """Return R[k][k] - R[l][k], (..., targets, targets)."""
    return rates.learned[..., None, :] - _matrix(rates)


def _final_drops(rates: Rates) -> Array:
    """Return R[k][k] - R[K][k] for each target k but the last, (..., targets - 1)."""
    return rates.learned[..., :-1] - rates.target[..., -1, :-1]


def _weighted(values: Array, weights: Array) -> Array:
    """Return the sum of values (..., n, n) times weights (n, n), NaN if all weights are 0."""
    if not weights.any():
        return np.full(values.shape[:-2], np.nan)
    return np.asarray((np.where(weights > 0, values, 0.0) * weights).sum(axis=(-2, -1)))


def _mean(values: Array, chosen: Array) -> Array:
    """Return the mean of values (..., n, n) where chosen (n, n) is 1, NaN if it is 1 nowhere."""
    return _weighted(values, chosen / max(chosen.sum(), 1.0))


# ---- matrix of the ends of the stages ----------------------------------------------------------------------


@metric(
    formula="mean over the targets k of R[K][k]",
    source="Continual World, arXiv 2105.10919 (P), whose code averages the last five evaluations; "
    "GEM, arXiv 1706.08840 (ACC)",
    missing="There are no targets, or the success on one after the last of them is missing.",
)
def performance_continual_world(rates: Rates) -> Array:
    """Success after the last target on all targets."""
    return average(rates.target[..., -1, :])


@metric(
    formula="mean over the stages l from 1 of the mean over the targets k up to l of R[l][k]",
    source="iCaRL, arXiv 1611.07725 (average incremental accuracy)",
    missing=ALL_TARGETS,
)
def average_incremental_accuracy(rates: Rates) -> Array:
    """Success on the targets learned so far, averaged over the stages."""
    count = len(rates.layout.target)
    known = np.tri(count)
    weights = known / np.maximum(known.sum(axis=1, keepdims=True), 1) / max(count, 1)
    return _weighted(_matrix(rates), weights)


@metric(
    formula="mean over all targets k but the last of the highest R[l][k] of the stages l from 1 to K-1, "
    "minus R[K][k]",
    source="Chaudhry et al. 2018, arXiv 1801.10112 (F)",
    missing="There are fewer than two targets, or a success on one at the end of a stage is missing, stages "
    "before it was learned included; `forgetting` is the same over the stages since, with the retained "
    "skills counted in.",
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
)
def forgetting_chaudhry(rates: Rates) -> Array:
    """Drop from the best success on a target at any earlier stage, even before it was learned."""
    matrix = _matrix(rates)
    if matrix.shape[-1] < 2:
        return np.full(matrix.shape[:-2], np.nan)
    return average(matrix[..., :-1, :-1].max(axis=-2) - matrix[..., -1, :-1])


@metric(
    formula="mean over all targets k but the last of the highest R[l][k] of the stages l from k to K, minus "
    "R[K][k]",
    source="Mammoth, utils/metrics.py at 07bd157 (forgetting)",
    missing=TWO_TARGETS,
    units=DIFFERENCE,
    higher_is_better=False,
)
def forgetting_mammoth(rates: Rates) -> Array:
    """Drop from the best success on a target since it was learned, the end included: never below 0."""
    matrix = _matrix(rates)
    if matrix.shape[-1] < 2:
        return np.full(matrix.shape[:-2], np.nan)
    best = np.where(np.tri(matrix.shape[-1]) > 0, matrix, -np.inf).max(axis=-2)
    return average((best - matrix[..., -1, :])[..., :-1])


@metric(
    formula="mean over all targets k but the last of R[k][k] - R[K][k]",
    source="Avalanche 0.6.0 (stream forgetting); also F of COOM and NBT of arXiv 2603.11653",
    missing=TWO_TARGETS,
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
)
def forgetting_avalanche(rates: Rates) -> Array:
    """Drop from the success right after a target was learned: backward transfer with the other sign."""
    return average(_final_drops(rates))


@metric(
    formula="mean over all targets k, the last included, of R[k][k] - R[K][k]",
    source="Continual World, arXiv 2105.10919 (F), whose code averages five evaluations for both terms",
    missing=TWO_TARGETS,
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
)
def forgetting_continual_world(rates: Rates) -> Array:
    """Drop from the success right after a target was learned; the last target counts, too, always with 0."""
    if len(rates.layout.target) < 2:
        return average(rates.learned[..., :0])
    return average(_drops(rates)[..., -1, :])


@metric(
    formula="mean over the targets k of J[k][k] - R[k][k]; J is R of joint",
    source="Chaudhry et al. 2018, arXiv 1801.10112 (I), the mean over the tasks",
    missing=f"There is no {JOINT} of the same seeds, or the success on a target right after learning it is "
    "missing.",
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
    references=(JOINT,),
)
def intransigence(rates: Rates) -> Array:
    """How much worse targets are learned than by training on everything met so far."""
    return average(rates.references[JOINT].learned - rates.learned)


@metric(
    formula="mean of R[l][k] over the stages l from 1 and the targets k up to l",
    source="Diaz-Rodriguez et al. 2018, arXiv 1810.13166 (A)",
    missing=ALL_TARGETS,
)
def accuracy_diaz_rodriguez(rates: Rates) -> Array:
    """Success on the targets learned so far, over all pairs of a stage and a target."""
    return _mean(_matrix(rates), np.tri(len(rates.layout.target)))


@metric(
    formula="mean of R[l][k] - R[k][k] over the targets k and the stages l after k",
    source="Diaz-Rodriguez et al. 2018, arXiv 1810.13166 (BWT)",
    missing=TWO_TARGETS,
    low=-1.0,
    units=DIFFERENCE,
)
def backward_transfer_diaz_rodriguez(rates: Rates) -> Array:
    """Change in success on the earlier targets, over all later stages and not only the last one."""
    return _mean(-_drops(rates), _later(rates))


@metric(
    formula="1 - |min(B, 0)|; B is backward_transfer_diaz_rodriguez",
    source="Diaz-Rodriguez et al. 2018, arXiv 1810.13166 (REM)",
    missing=TWO_TARGETS,
    units=f"1 less a {DIFFERENCE}",
)
def remembering_diaz_rodriguez(rates: Rates) -> Array:
    """1 minus the size of the negative part of backward transfer."""
    return 1 - np.abs(np.minimum(backward_transfer_diaz_rodriguez(rates), 0))


@metric(
    formula="max(B, 0); B is backward_transfer_diaz_rodriguez",
    source="Diaz-Rodriguez et al. 2018, arXiv 1810.13166 (BWT+)",
    missing=TWO_TARGETS,
    units=DIFFERENCE,
)
def positive_backward_transfer_diaz_rodriguez(rates: Rates) -> Array:
    """The positive part of backward transfer."""
    return np.maximum(backward_transfer_diaz_rodriguez(rates), 0)


@metric(
    formula="mean of R[l][k] over the stages l from 1 and the targets k after l",
    source="Diaz-Rodriguez et al. 2018, arXiv 1810.13166 (FWT)",
    missing=TWO_TARGETS,
)
def forward_transfer_diaz_rodriguez(rates: Rates) -> Array:
    """Success on targets that are still to come, with nothing subtracted."""
    return _mean(_matrix(rates), _later(rates).T)


@metric(
    formula="mean over all targets k but the last of the lowest R[l][k] of the stages l after k",
    source="De Lange et al. 2023, arXiv 2205.13452 (min-ACC), with an evaluation at the end of each stage",
    missing=TWO_TARGETS,
)
def minimum_accuracy(rates: Rates) -> Array:
    """The lowest success on a target at the end of any later stage."""
    return average(_lowest(rates))


def _lowest(rates: Rates) -> Array:
    """Return the lowest success on each target but the last after it was learned, (..., targets - 1)."""
    if len(rates.layout.target) < 2:
        return rates.learned[..., :0]
    return np.asarray(np.where(_later(rates) > 0, _matrix(rates), np.inf)[..., :-1].min(axis=-2))


@metric(
    formula="R[K][K] / K + (1 - 1 / K) minimum_accuracy",
    source="De Lange et al. 2023, arXiv 2205.13452 (WC-ACC), with an evaluation at the end of each stage",
    missing=TWO_TARGETS,
)
def worst_case_accuracy(rates: Rates) -> Array:
    """Success on the last target, and the lowest on each earlier one since it was learned."""
    lowest = _lowest(rates)
    if not lowest.shape[-1]:
        return average(lowest)
    return average(np.concatenate([lowest, rates.learned[..., -1:]], axis=-1))


@metric(
    formula="mean over the targets k and the stages l after k of (R[l-1][k] - R[l][k]) / M[k]; M[k] is the "
    "highest R[l][k] of all stages l from 0",
    source="CORA, arXiv 2110.10067 (isolated forgetting), without its factor 10",
    missing="There are fewer than two targets, or the success on one before the last is missing or always 0.",
    low=-1.0,
    higher_is_better=False,
    units="share of the highest success",
)
def isolated_forgetting_cora(rates: Rates) -> Array:
    """What each later target costs an earlier one, as a share of the highest success.

    The highest success is taken at the ends of the stages of the one run; CORA's code takes it from every
    evaluation of all runs together.
    """
    return _mean(-_isolated(rates), _later(rates))


@metric(
    formula="mean over the targets k and the stages l before k, from 1, of (R[l][k] - R[l-1][k]) / M[k]; "
    "M[k] is the highest R[l][k] of all stages l from 0",
    source="CORA, arXiv 2110.10067 (isolated zero-shot forward transfer), without its factor 10",
    missing="There are fewer than two targets, or the success on one after the first is missing or always 0.",
    low=-1.0,
    units="share of the highest success",
)
def isolated_zero_shot_transfer_cora(rates: Rates) -> Array:
    """What each target gives a later one, as a share of the highest success.

    The highest success is taken as in `isolated_forgetting_cora`. The policy before the first target is
    pretrained here, untrained in CORA.
    """
    return _mean(_isolated(rates), _later(rates).T)


def _isolated(rates: Rates) -> Array:
    """Return the change of each target's success in each stage as a share of the highest, (..., n, n)."""
    highest = rates.target.max(axis=-2, keepdims=True)
    changes = np.diff(rates.target, axis=-2)
    return np.asarray(changes / np.where(highest > 0, highest, np.nan))


# ---- LIBERO, and metrics called NBT ------------------------------------------------------------------------


@metric(
    formula="mean over the targets k of the mean over the evaluation points of stage k of the success on "
    "target k, R[k-1][k] before the first step included",
    source="LIBERO, arXiv 2306.03310 (FWT)",
    missing="There are no targets, stages end at a criterion, or a point of a learning curve is missing.",
)
def forward_transfer_libero(rates: Rates) -> Array:
    """Success on the target while it is learned, without a baseline.

    LIBERO's points are equally spaced, ours are the scenario's. LIBERO continues from the best checkpoint of
    a stage, chosen on the same episodes that it reports, and holds the curve there; here a stage ends with
    its last step.
    """
    return average(_own_curves(rates))


def _own_curves(rates: Rates) -> Array:
    """Return the mean success on target k over the points of stage k, (..., targets)."""
    own = average(np.concatenate([rates.starts[..., None], rates.learning_curves], axis=-1))
    return np.where(rates.have_curves, own, np.nan)


@metric(
    formula="sum over all targets k but the last of the mean over the stages l after k of R[k][k] - R[l][k], "
    "divided by K",
    source="LIBERO, arXiv 2306.03310 (NBT), without its choice of checkpoints; "
    "LifeLong-RFT, arXiv 2602.10503",
    missing=TWO_TARGETS,
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
)
def negative_backward_transfer_libero(rates: Rates) -> Array:
    """Drop in success on the earlier targets over all later stages; the last target counts as 0."""
    return _weighted(_drops(rates), _over_later(rates) / max(len(rates.layout.target), 1))


@metric(
    formula="mean over all targets k but the last of the mean over the stages l after k of R[k][k] - R[l][k]",
    source="CLARE, arXiv 2601.09512 (NBT)",
    missing=TWO_TARGETS,
    low=-1.0,
    units=DIFFERENCE,
    higher_is_better=False,
)
def negative_backward_transfer_clare(rates: Rates) -> Array:
    """Drop in success on the earlier targets over all later stages; the last target does not count."""
    return _weighted(_drops(rates), _over_later(rates) / max(len(rates.layout.target) - 1, 1))


def _over_later(rates: Rates) -> Array:
    """Return weights of the stages after k that add up to 1 for each target k but the last, (n, n)."""
    later = _later(rates)
    return np.asarray(later / np.maximum(later.sum(axis=0), 1))


@metric(
    formula="mean over all targets k but the last of max(0, R[k][k] - R[K][k])",
    source="ARFM, arXiv 2509.04063 (NBT), read in notes on the paper, not in the paper itself",
    missing=TWO_TARGETS,
    units=DIFFERENCE,
    higher_is_better=False,
)
def negative_backward_transfer_arfm(rates: Rates) -> Array:
    """Drop in success on the earlier targets after the last one; a gain counts as 0."""
    return average(np.maximum(_final_drops(rates), 0))


@metric(
    formula="mean over the targets k of (F[k] + the sum of R[l][k] over the stages l after k) / (K - k + 1); "
    "F[k] is the part of target k in forward_transfer_libero",
    source="LIBERO, arXiv 2306.03310 (AUC)",
    missing="There are no targets, stages end at a criterion, or a success while or after it is missing.",
)
def area_under_curve_libero(rates: Rates) -> Array:
    """Success on a target from its stage to the end, without a baseline.

    The points and the checkpoint differ from LIBERO's as in `forward_transfer_libero`.
    """
    later = _later(rates)
    known = np.where(later > 0, _matrix(rates), 0).sum(axis=-2)
    return average((_own_curves(rates) + known) / (later.sum(axis=0) + 1))


# ---- other tasks -------------------------------------------------------------------------------------------


@metric(
    formula="mean over the held-out tasks s of R[K][s] - R[0][s]",
    source="clbench; the change of ZS of arXiv 2603.11653",
    missing="There are no held-out tasks or no targets, or a success on a held-out task is missing.",
    low=-1.0,
    units=DIFFERENCE,
)
def zero_shot_change(rates: Rates) -> Array:
    """Change in success on tasks that were never trained, from the pretrained policy to the end."""
    change = rates.held_out[..., -1, :] - rates.held_out[..., 0, :]
    return average(change if rates.layout.target else change[..., :0])


@metric(
    formula="mean over the retained skills of the lowest success at any evaluation point of any stage from 1",
    source="clbench; min-ACC of De Lange et al. 2023, arXiv 2205.13452, with the retained skills as the "
    "earlier tasks",
    missing="There are no retained skills or no targets, or they were not evaluated at every point.",
)
def minimum_retention(rates: Rates) -> Array:
    """The lowest success on a retained skill at any evaluation point, also before the end of a stage.

    The lowest of several noisy rates is too low by a part of their noise, all the more since fewer episodes
    are run before the end of a stage.
    """
    if not len(rates.layout.target):
        return average(rates.retained[..., 0, :0])
    return average(rates.retained_curves.min(axis=(-3, -2)))
