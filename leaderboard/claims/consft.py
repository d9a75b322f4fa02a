"""The claims of ConSFT, each with a rule that was fixed before there were results to judge."""

from __future__ import annotations

import math

from .claim import Finding, Paper, claim, compared, compared_gains, decided, either
from .evidence import Evidence
from .figures import matched_retention, retention_drop, sparsity, sparsity_after

CONSFT = Paper("ConSFT", ("2605.08879",))


@claim(
    "C1",
    CONSFT,
    reported="0.49 on prior tasks before sft, 0.09 after; about 70 % of the parameters unchanged (pi0, "
    "LIBERO, Tables 1 and 2)",
    rule="Holds if the lower end of the drop in retained success is above 0.05; does not hold if the upper "
    "end is below 0.05.",
)
def sft_degrades(evidence: Evidence) -> Finding:
    """Fine-tuning without constraint overwrites parameters densely and degrades pretrained skills."""
    drop, joint = retention_drop(evidence, "sft"), retention_drop(evidence, "joint")
    of_sft, of_joint = (sparsity_after(evidence, method) for method in ("sft", "joint"))
    if math.isnan(joint.high) or math.isnan(drop.low):
        sentence = "The records cannot show whether joint loses less."
    elif joint.high >= drop.low:
        sentence = (
            "joint does not lose certainly less: the missing constraint need not be what degrades skills."
        )
    elif of_joint[-1].low <= of_sft[-1].high:
        sentence = (
            "joint changes as many parameters and loses less: dense updates alone do not degrade skills."
        )
    else:
        sentence = "joint loses less and changes fewer parameters."
    return Finding(
        decided(holds=drop.low > 0.05, fails=drop.high < 0.05),
        (drop, *of_sft),
        (*sparsity_after(evidence, "frozen"), *of_joint, retention_drop(evidence, "frozen"), joint),
        (sentence,),
    )


@claim(
    "C2",
    CONSFT,
    reported="over 20 points on average; the visible margins are +25, +20, +10 and +14 (Table 2)",
    rule="Holds if the lower end of the difference in retention at matched adaptation is at least 0.20 for "
    "consft (as published) or for consft_calibrated; does not hold if both upper ends are below 0.20.",
)
def keeps_20_points_more(evidence: Evidence) -> Finding:
    """Keeps pretrained skills more than 20 points better than plain fine-tuning."""
    arms = ("consft", "consft_calibrated", "low_rate_sft", "constant_weight", "shuffled_weights", "finch")
    published, calibrated, smaller, constant, shuffled, finch = (
        matched_retention(evidence, method, "sft") for method in arms
    )
    verdict, sentences = either(
        (published, calibrated),
        holds=lambda figure: figure.low >= 0.20,
        fails=lambda figure: figure.high < 0.20,
    )
    best = calibrated if calibrated.value > published.value else published
    return Finding(
        verdict,
        (published, calibrated),
        (smaller, constant, shuffled, finch),
        (
            *sentences,
            compared_gains(smaller, best, does_as_well="a smaller step size gives the same gain"),
            compared_gains(constant, published, does_as_well="the gain does not come from weighting samples"),
            compared_gains(
                shuffled, published, does_as_well="it does not matter which samples get small weights"
            ),
            compared_gains(finch, best, does_as_well="a step size that follows the loss suffices"),
        ),
    )


@claim(
    "C3",
    CONSFT,
    reported="0.34 on prior tasks against 0.18 with 1:1 replay (pi0, LIBERO, Table 3)",
    rule="Holds if the lower end of the difference in retention at matched adaptation is at least -0.05 "
    "against both kinds of replay, for consft or for consft_calibrated; does not hold if each of the two has "
    "an upper end below -0.05 against one of them.",
)
def as_good_as_replay(evidence: Evidence) -> Finding:
    """As good as experience replay, without prior data."""
    replays = ("experience_replay", "buffered_replay")
    arms = [
        [matched_retention(evidence, method, replay) for replay in replays]
        for method in ("consft", "consft_calibrated")
    ]
    holding = [arm[0].methods[0] for arm in arms if all(figure.low >= -0.05 for figure in arm)]
    failing = all(any(figure.high < -0.05 for figure in arm) for arm in arms)
    sentences = [f"It holds for {' and '.join(holding)}."] if holding else []
    if all(arm[1].high < 0 for arm in arms):
        sentences.append("A buffer with 2 % of the prior demonstrations keeps more than either.")
    return Finding(
        decided(holds=bool(holding), fails=failing),
        tuple(arm[0] for arm in arms),
        tuple(arm[1] for arm in arms),
        tuple(sentences),
    )


@claim(
    "C4",
    CONSFT,
    reported="a curve without numbers: sparsity decays later and more evenly than with sft (Fig. 2)",
    rule="Holds if the interval over seeds of the difference in update sparsity at matched adaptation (mean "
    "over stages) is above 0; does not hold if its upper end is not above 0.",
)
def stays_sparse(evidence: Evidence) -> Finding:
    """Updates stay sparse."""
    published, calibrated, smaller = (
        evidence.matched_difference("update sparsity", sparsity, method, "sft", form=".3f")
        for method in ("consft", "consft_calibrated", "low_rate_sft")
    )
    return Finding(
        decided(holds=published.low > 0, fails=published.high <= 0),
        (published, calibrated),
        (smaller,),
        (compared_gains(smaller, published, does_as_well="smaller steps give updates as sparse"),),
    )


@claim(
    "C5",
    CONSFT,
    reported="risk times omega squared (Eq. 7), no measurement",
    rule="Holds for one sample, where it is algebra, while the test "
    "`test_one_sample_disrupts_old_knowledge_by_the_square_of_its_weight` of `tests/methods/test_consft.py` "
    "passes.",
)
def bounds_the_risk_of_a_step(evidence: Evidence) -> Finding:
    """Bounds how much a step can disrupt: the risk scales with the square of the weight."""
    methods = ("constant_weight", "consft", "sft")
    constant, weighed, sft = (evidence.metric("retention", method) for method in methods)
    difference = evidence.difference("retention", "constant_weight", "consft")
    sentences = [
        "The weight is a factor of the sample's gradient, so g'Fg contains its square. This does not cover "
        "the sum of many steps: Adam cancels a factor that all samples share."
    ]
    if difference.high >= 0:
        sentences.append(
            "constant_weight, whose weights are the same on average, keeps as much: the weights of single "
            "samples do not explain what is kept."
        )
    controls = (constant, weighed, sft, difference)
    return Finding("holds", (), controls, tuple(sentences), about=("consft", "consft_calibrated"))


@claim(
    "C6",
    CONSFT,
    reported="one exponential and one detached tensor per sample; no time measured",
    rule="Holds if bytes kept and parameters added equal those of sft and a step takes at most 1.05 times "
    "as long as a step of sft; does not hold if one of them is larger.",
)
def costs_nothing(evidence: Evidence) -> Finding:
    """Needs no extra network, memory or data."""
    (kept, kept_by_sft), (added, added_by_sft) = (
        [evidence.cost(name, method, f"{words} of {method}") for method in ("consft", "sft")]
        for name, words in (("bytes_kept", "bytes kept"), ("parameters_added", "parameters added"))
    )
    time = evidence.step_time("consft")
    same = kept.value == kept_by_sft.value and added.value == added_by_sft.value
    more = kept.value > kept_by_sft.value or added.value > added_by_sft.value
    return Finding(
        decided(holds=same and time.value <= 1.05, fails=more or time.value > 1.05),
        (time, kept, added),
        (kept_by_sft, added_by_sft),
    )


@claim(
    "C7",
    CONSFT,
    reported="stated in the abstract; no number was found",
    rule="Holds if the lower end of backward transfer is at least -0.10 for consft or for "
    "consft_calibrated; does not hold if both upper ends are below -0.10.",
)
def keeps_earlier_targets(evidence: Evidence) -> Finding:
    """Learns several targets in sequence and keeps the earlier ones."""
    published, calibrated, sft, replay = (
        evidence.metric("backward_transfer", method)
        for method in ("consft", "consft_calibrated", "sft", "experience_replay")
    )
    verdict, sentences = either(
        (published, calibrated),
        holds=lambda figure: figure.low >= -0.10,
        fails=lambda figure: figure.high < -0.10,
    )
    best = calibrated if calibrated.value > published.value else published
    as_well = "weighting samples keeps no earlier target that sft loses"
    return Finding(
        verdict,
        (published, calibrated),
        (sft, replay),
        (*sentences, compared(sft, best, does_as_well=as_well)),
    )


@claim(
    "C8",
    CONSFT,
    reported="one case on a real robot: sft closes the gripper too high, ConSFT does not (Sec. 5.5)",
    rule="None yet.",
)
def prevents_spatial_overfitting(evidence: Evidence) -> Finding:
    """Prevents overfitting to the positions in the demonstrations."""
    return Finding(
        "undecided",
        about=("consft", "consft_calibrated"),
        missing=(
            "No policy is evaluated outside the region of the target's demonstrations yet. It takes a "
            "scenario whose test episodes begin and end outside that region: `clbench run` it with `sft "
            "consft consft_calibrated`.",
        ),
    )
