"""What ConSFT claims about targets: earlier ones are kept (C7), and new ones work elsewhere, too (C8)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from clbench.base.text import listed

from .arms import (
    ARMS,
    arms_that_count,
    change_of_arms,
    if_all_counted,
    inactive_reasons,
    inactive_sentences,
    rises_above,
    without_an_arm,
)
from .claim import (
    ANYWHERE,
    Finding,
    Verdict,
    best_first,
    cannot_be_shown,
    claim,
    decided,
    not_told_apart,
)
from .consft import CONSFT
from .consft_controls import CONTROLS, sft_at_the_rate_of
from .evidence import Evidence, Figure
from .figures import perturbation_gain, perturbation_loss


@claim(
    "C7",
    CONSFT,
    reported="the abstract says that pretrained skills are kept while targets are acquired in sequence; that "
    "earlier targets are kept is our reading, and no number was found",
    rule="Holds if the lower end of backward transfer is at least -0.10 for one of the arms of C2 that "
    "count; does not hold if the upper ends of both arms, counting or not, are below -0.10. Cannot be shown "
    "here if no arm counts.",
    settled="2026-11-27T20:50Z",
    margin="0.10 of the success on earlier targets",
    uncounted="our reading of the paper",
)
def keeps_earlier_targets(evidence: Evidence) -> Finding:
    """Learns several targets in sequence and keeps the earlier ones."""
    own = {arm: evidence.metric("backward_transfer", arm) for arm in ARMS}
    references = tuple(evidence.metric("backward_transfer", name) for name in ("sft", "experience_replay"))
    every = list(own.values())
    counting, of_all = arms_that_count(evidence), _keeps_targets(every, every)
    arms = [own[arm] for arm in counting]
    if not arms:
        return without_an_arm(evidence, every, references, of_all)
    figures = best_first(arms)
    over_sft, *over_controls = _gains_in_transfer(evidence, figures[0].methods[0])
    not_counted = [
        figure
        for arm in ARMS
        if arm not in counting
        for figure in (own[arm], evidence.difference("backward_transfer", arm, "sft"))
    ]
    verdict = _keeps_targets(arms, every)
    return Finding(
        verdict,
        figures,
        (over_sft, *over_controls, *not_counted, *references),
        (
            *inactive_sentences(evidence),
            *if_all_counted(counting, verdict, of_all),
            _what_keeps_targets(over_sft, over_controls),
        ),
        change_of_arms(verdict, arms, every, -0.10),
        about=ARMS,
    )


def _keeps_targets(counting: Sequence[Figure], every: Sequence[Figure]) -> Verdict:
    """Return the verdict on the backward transfer of the arms that count and of all."""
    return decided(
        holds=any(one.low >= -0.10 for one in counting), fails=all(one.high < -0.10 for one in every)
    )


def _gains_in_transfer(evidence: Evidence, arm: str) -> Iterator[Figure]:
    """Yield the gain of an arm over sft, over sft at the arm's step factor, and over its controls."""
    controls = (label for label in CONTROLS if label in evidence.runs)
    for other in ("sft", *sft_at_the_rate_of(evidence, arm), *controls):
        yield evidence.difference("backward_transfer", arm, other)


def _what_keeps_targets(over_sft: Figure, over_controls: Sequence[Figure]) -> str:
    """Return what sft and the controls say about an arm's gain in backward transfer."""
    reaching = [one.methods[1] for one in over_controls if one.low <= 0]
    compared = {one.methods[1] for one in over_controls if not one.is_unknown}
    missing = [label for label in CONTROLS if label not in compared]
    if over_sft.low > 0 and missing and not reaching:
        return (
            "sft at its best learning rate certainly keeps fewer; whether weighing samples is the cause is "
            f"not known without an interval for {listed(missing)}."
        )
    if over_sft.low > 0 and reaching:
        do = "does" if len(reaching) == 1 else "do"
        return (
            f"sft at its best learning rate certainly keeps fewer, but {listed(reaching)} {do} not: weighing "
            "samples need not be the cause."
        )
    return not_told_apart(
        over_sft,
        explains="weighing samples need not keep any earlier target",
        does_not="weighing samples keeps earlier targets",
    )


@claim(
    "C8",
    CONSFT,
    reported="one case on a real robot: sft closes the gripper too high, ConSFT does not (Sec. 5.5)",
    rule="The loss is the success on each new target minus its success in perturbed episodes, in which the "
    "gripper starts elsewhere and the block weighs half or twice as much. carry_back does not count: it "
    "begins with the block in the gripper, which no expert can hold if it weighs twice as much. "
    "Holds if the lower end of sft's loss minus the method's is above 0.05 for one of the arms of C2 that "
    "count; does not hold if the upper ends of both arms, counting or not, are below 0.05. Cannot be shown "
    "here if no arm counts, or if the upper end of sft's own loss is below 0.05.",
    settled="2026-11-27T20:50Z",
    margin="0.05 of the success",
    scenarios=ANYWHERE,
)
def prevents_spatial_overfitting(evidence: Evidence) -> Finding:
    """Prevents overfitting to the positions in the demonstrations."""
    of_sft = perturbation_loss(evidence, "sft")
    every = [perturbation_gain(evidence, arm, "sft") for arm in ARMS]
    reasons = [NOTHING_TO_PREVENT] if of_sft.high < 0.05 else []
    counting = arms_that_count(evidence)
    arms = [figure for arm, figure in zip(ARMS, every, strict=True) if arm in counting]
    if not arms:
        return without_an_arm(evidence, every, (of_sft,), None, *reasons)
    if reasons:
        every_reason = [*inactive_reasons(evidence, counting), *reasons]
        return cannot_be_shown(best_first(every), (of_sft,), every_reason, about=ARMS)
    verdict = rises_above(0.05, arms, every)
    return Finding(
        verdict,
        best_first(arms),
        (of_sft, *(figure for arm, figure in zip(ARMS, every, strict=True) if arm not in counting)),
        inactive_sentences(evidence),
        change_of_arms(verdict, arms, every, 0.05),
        about=ARMS,
    )


NOTHING_TO_PREVENT = (
    "sft certainly loses less than 0.05 in perturbed episodes: there is nothing to prevent.",
    "Starts farther from the demonstrated ones, at which sft fails.",
)
"""A reason why C8 cannot be shown, and what would remove it."""
