"""The claims of Fast-dVLA, each with a rule that was fixed before there were results to judge.

Fast-dVLA has the abstract of CapVector; most claims here are CapVector's.
"""

from __future__ import annotations

import math

from .claim import Finding, Paper, claim, decided
from .evidence import Evidence, Figure
from .figures import gain_over_random

CAPVECTOR = Paper("Fast-dVLA's abstract, which is CapVector's", ("2603.25661", "2605.10903"))
FAST_DVLA = Paper("Fast-dVLA's body", ("2603.25661",))

LATER = {"F6": (FAST_DVLA, "A discrete-diffusion policy decodes 2.65 to 4.1 times faster at equal success.")}
"""Claims that are not judged yet."""


@claim(
    "F1",
    CAPVECTOR,
    reported="LIBERO 87.5 with the auxiliary objective, 82.1 without, after 5,000 steps; 28 % more compute",
    rule="Holds if the lower end of the difference in forward transfer between co_training and sft is above "
    "0; does not hold if the upper end is not.",
)
def auxiliary_objective_helps(evidence: Evidence) -> Finding:
    """Plain fine-tuning adapts poorly; an auxiliary objective helps but is expensive."""
    transfer = evidence.difference("forward_transfer", "co_training", "sft", form=".3f")
    return Finding(
        decided(holds=transfer.low > 0, fails=transfer.high <= 0),
        (
            transfer,
            evidence.difference("adaptation", "co_training", "sft"),
            evidence.step_time("co_training"),
        ),
    )


@claim(
    "F2",
    CAPVECTOR,
    reported="LIBERO 90.1 with the vector, 87.5 with the auxiliary objective, 82.1 with neither, after 5,000 "
    "steps (Table 1)",
    rule="Holds if the lower ends of the differences in forward transfer to sft and to a random vector of "
    "equal norms are above 0; does not hold if the upper end of the difference to sft is not above 0, or if "
    "the random vector does as well, so that the interval of the difference to it reaches 0.",
)
def vector_carries_the_capability(evidence: Evidence) -> Finding:
    """The difference of two short trainings is a vector; merged, it replaces the auxiliary objective."""
    gain = evidence.difference("forward_transfer", "fast_dvla", "sft", form=".3f")
    over_random = gain_over_random(evidence)
    return Finding(
        decided(
            holds=gain.low > 0 and over_random.low > 0,
            fails=gain.high <= 0 or over_random.low <= 0,
        ),
        (gain, evidence.difference("adaptation", "fast_dvla", "sft")),
        (over_random, evidence.difference("forward_transfer", "co_training", "sft", form=".3f")),
        (sentence_on_random(over_random),),
    )


def sentence_on_random(over_random: Figure) -> str:
    """Return the sentence that compares the capability vector with a random vector."""
    if math.isnan(over_random.low):
        return "The records cannot show whether a random vector does as well."
    if over_random.low <= 0:
        return "A random vector of equal norms does as well: nothing shows a capability in the vector."
    return "A random vector of equal norms does not do as well: the direction matters."


@claim(
    "F3",
    CAPVECTOR,
    reported="LIBERO 90.1 without and 91.7 with it after 5,000 steps; +0.5 to +0.9 later (Table 1)",
    rule="Holds if the lower end of the difference with and without the regulariser is above 0 in adaptation "
    "or in forward transfer; does not hold if both upper ends are below 0.008, half of the paper's figure.",
)
def regulariser_keeps_the_vector(evidence: Evidence) -> Finding:
    """The orthogonal regulariser keeps the merged capability."""
    both = tuple(
        evidence.difference(name, "fast_dvla", "fast_dvla+orthogonal=0.0", form=".3f")
        for name in ("adaptation", "forward_transfer")
    )
    return Finding(
        decided(
            holds=any(figure.low > 0 for figure in both),
            fails=all(figure.high < 0.016 / 2 for figure in both),
        ),
        both,
    )


@claim(
    "F4",
    CAPVECTOR,
    reported="less than 0.8 % more compute and memory, without the cost of making the vectors",
    rule="Holds if a step takes at most 1.05 times as long as a step of sft; otherwise it does not hold.",
)
def costs_little(evidence: Evidence) -> Finding:
    """The cost is near that of plain fine-tuning."""
    time = evidence.step_time("fast_dvla")
    return Finding(
        decided(holds=time.value <= 1.05, fails=time.value > 1.05),
        (
            time,
            evidence.share_of_preparation("fast_dvla"),
            evidence.cost("bytes_kept", "fast_dvla", "bytes kept of fast_dvla"),
        ),
    )


@claim(
    "F5",
    CAPVECTOR,
    reported="RoboTwin 31.8, 23.7 and 9.4 with vectors of three LIBERO suites, 6.7 without (Table 2)",
    rule="The vector is made from the retained skills and used on the targets: holds if the lower end of the "
    "difference in forward transfer to a random vector is above 0; otherwise it does not hold.",
)
def vector_transfers(evidence: Evidence) -> Finding:
    """The vector transfers to tasks other than those it was made from."""
    over_random = gain_over_random(evidence)
    return Finding(
        decided(holds=over_random.low > 0, fails=over_random.low <= 0),
        (over_random,),
        (evidence.difference("forward_transfer", "fast_dvla+direction=random", "sft", form=".3f"),),
        (sentence_on_random(over_random),),
    )
