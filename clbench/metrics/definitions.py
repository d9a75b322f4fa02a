"""What the metrics that a success matrix allows assume, in families that answer the same question."""

from __future__ import annotations

from dataclasses import dataclass

FAMILIES = {
    "average": "How well does the policy do everything?",
    "learning": "How well does it learn each target?",
    "kept": "How well does it still do what it knew?",
    "forgetting": "How much did it lose?",
    "transfer": "How well does it do what it has not learned yet?",
}
"""The question of each family. Within a family, definitions differ in what they count and how often."""


@dataclass(frozen=True)
class Definition:
    """What to know about a definition besides its formula."""

    family: str
    """The family that it belongs to."""
    assumption: str
    """What it assumes, in one sentence."""


def _family(family: str, **assumptions: str) -> dict[str, Definition]:
    return {name: Definition(family, assumption) for name, assumption in assumptions.items()}


DEFINITIONS = {
    **_family(
        "average",
        final_average="Only the end counts; retained skills and targets count alike, one by one.",
        performance_continual_world="Only the end counts; retained skills do not.",
        average_incremental_accuracy="All stages count alike, so that the first target counts most often.",
        accuracy_diaz_rodriguez="All pairs of a stage and a target count alike: late stages count more.",
        worst_case_accuracy="An earlier target counts with its lowest success after any later stage.",
        gain="Only the end counts; it is compared with the method sft, seed by seed.",
    ),
    **_family(
        "learning",
        adaptation="A target counts right after its stage, however little of it is kept.",
        intransigence="The method joint shows how well each target can be learned.",
    ),
    **_family(
        "kept",
        retention="Only the end and the retained skills count.",
        kept_targets="Only the end and the earlier targets count, however well they were learned.",
        kept="Only the end counts; retained skills and earlier targets count alike, one by one.",
        kept_skills_over_stages="All stages count alike; only the retained skills do.",
        kept_targets_over_stages="All stages count alike; only the targets before each do.",
        kept_over_stages="All stages count alike, with all that was known before each.",
        kept_share="What was known before a stage is 1; a policy that learned little can keep all of it.",
        minimum_accuracy="An earlier target counts with its lowest success after any later stage.",
    ),
    **_family(
        "forgetting",
        forgetting="From the best since it was known; retained skills count; noise makes the best too high.",
        forgetting_chaudhry="From the best of all stages but the last, also of those before it was learned.",
        forgetting_mammoth="From the best since it was learned, the end included: it is never negative.",
        forgetting_avalanche="From right after it was learned to the end; the last target does not count.",
        forgetting_continual_world="From right after it was learned to the end; the last target counts as 0.",
        negative_backward_transfer_libero="The mean over all later stages; the last target counts as 0.",
        negative_backward_transfer_clare="The mean over all later stages; the last target does not count.",
        negative_backward_transfer_arfm="From right after it was learned to the end; a gain counts as 0.",
        isolated_forgetting_cora="The loss in each later stage, as a share of the best success of this run.",
        backward_transfer="From right after it was learned to the end; a loss is negative.",
        backward_transfer_diaz_rodriguez="All pairs of a target and a later stage count; a loss is negative.",
        remembering_diaz_rodriguez="All pairs of a target and a later stage count; a gain is 0.",
        positive_backward_transfer_diaz_rodriguez="All pairs of a target and a later stage; a loss is 0.",
    ),
    **_family(
        "transfer",
        forward_transfer_diaz_rodriguez="Targets before they are learned; a policy that can do them at the "
        "start has it all, since nothing is subtracted.",
        isolated_zero_shot_transfer_cora="The gain of a target in each earlier stage, as a share of its best "
        "success; it needs stage 0.",
        zero_shot="Only the end and the held-out tasks count; nothing is subtracted.",
        zero_shot_change="From stage 0 to the end, on the held-out tasks.",
    ),
}
"""The metrics that a success matrix allows, by name."""

INSTEAD = {
    "forgetting_chaudhry": "`forgetting` is the same over the stages since a target was learned, with the "
    "retained skills counted in.",
}
"""Substitutes for definitions that need cells which few tables have."""
