"""The claims of the papers, each with the rule that judges it, fixed before there were results to judge."""

from __future__ import annotations

import math

from .claim import CLAIMS, Finding, Paper, claim, compared, compared_gains, decided, either
from .evidence import Evidence, Figure
from .figures import (
    answer_curve,
    drift_ratio,
    gain_over_random,
    matched_retention,
    question_drop,
    retention_drop,
    sparsity,
    sparsity_after,
)

CONSFT = Paper("ConSFT", ("2605.08879",))
AEGIS = Paper("AEGIS", ("2604.16067",))
CAPVECTOR = Paper("Fast-dVLA's abstract, which is CapVector's", ("2603.25661", "2605.10903"))
FAST_DVLA = Paper("Fast-dVLA's body", ("2603.25661",))

LATER = {"F6": (FAST_DVLA, "A discrete-diffusion policy decodes 2.65 to 4.1 times faster at equal success.")}
"""Claims that are later work."""


def judge_all(evidence: Evidence) -> dict[str, Finding]:
    """Return the finding of every claim by id."""
    return {one.id: one.judge(evidence) for one in CLAIMS.values()}


# ---- ConSFT ------------------------------------------------------------------------------------------------


@claim(
    "C1",
    CONSFT,
    reported="0.49 on prior tasks before, 0.09 after sft; about 70 % of the parameters unchanged (pi0, "
    "LIBERO, Tables 1 and 2)",
    rule="Holds if the lower end of the drop in retained success is above 0.05, does not hold if the upper "
    "end is below 0.05.",
)
def sft_degrades(evidence: Evidence) -> Finding:
    """Fine-tuning without constraint overwrites parameters densely and degrades pretrained skills."""
    drop, joint = retention_drop(evidence, "sft"), retention_drop(evidence, "joint")
    of_sft, of_joint = (sparsity_after(evidence, method) for method in ("sft", "joint"))
    if math.isnan(joint.high) or math.isnan(drop.low):
        sentence = "Whether joint loses less cannot be told."
    elif joint.high >= drop.low:
        sentence = (
            "joint does not lose certainly less: it need not be the want of a constraint that degrades."
        )
    elif of_joint[-1].low <= of_sft[-1].high:
        sentence = "joint changes as many parameters and loses less: dense updates alone do not degrade."
    else:
        sentence = "joint loses less, and changes fewer parameters."
    return Finding(
        decided(holds=drop.low > 0.05, fails=drop.high < 0.05),
        (drop, *of_sft),
        (*sparsity_after(evidence, "frozen"), *of_joint, retention_drop(evidence, "frozen"), joint),
        (sentence,),
    )


@claim(
    "C2",
    CONSFT,
    reported="over 20 points on average; the margins that can be seen are +25, +20, +10 and +14 (Table 2)",
    rule="Holds if the lower end of the difference of retention at matched adaptation is at least 0.20 for "
    "consft (as published) or for consft_calibrated, does not hold if both upper ends are below 0.20.",
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
            compared_gains(smaller, best, does_as_well="the gain is that of a smaller step size"),
            compared_gains(constant, published, does_as_well="the gain is not from weighing samples"),
            compared_gains(shuffled, published, does_as_well="it does not matter which samples weigh little"),
            compared_gains(finch, best, does_as_well="a step size that follows the loss is enough"),
        ),
    )


@claim(
    "C3",
    CONSFT,
    reported="0.34 on prior tasks against 0.18 with 1:1 replay (pi0, LIBERO, Table 3)",
    rule="Holds if the lower end of the difference of retention at matched adaptation is at least -0.05 "
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
        sentences.append("A buffer of 2 % of the prior demonstrations keeps more than either.")
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
    rule="Holds if the interval over seeds of the difference of update sparsity at matched adaptation, mean "
    "over stages, lies above 0, does not hold if its upper end is not above 0.",
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
        (compared_gains(smaller, published, does_as_well="smaller steps are as sparse"),),
    )


@claim(
    "C5",
    CONSFT,
    reported="risk times omega squared (Eq. 7), no measurement",
    rule="Holds for one sample, where it is algebra, as long as the test "
    "`test_one_sample_disrupts_what_was_known_by_the_square_of_its_weight` of `tests/methods/test_consft.py` "
    "passes.",
)
def bounds_the_risk_of_a_step(evidence: Evidence) -> Finding:
    """Bounds how much a step can disrupt: the risk scales with the square of the weight."""
    methods = ("constant_weight", "consft", "sft")
    constant, weighed, sft = (evidence.metric("retention", method) for method in methods)
    difference = evidence.difference("retention", "constant_weight", "consft")
    sentences = [
        "The weight is a factor of the sample's gradient, so that g'Fg has its square. This says nothing of "
        "the sum of many steps: Adam divides a factor that all samples share out again."
    ]
    if difference.high >= 0:
        sentences.append(
            "constant_weight, whose weights are the same on average, keeps as much: what is kept does not "
            "come from the weight of the single sample."
        )
    controls = (constant, weighed, sft, difference)
    return Finding("holds", (), controls, tuple(sentences), about=("consft", "consft_calibrated"))


@claim(
    "C6",
    CONSFT,
    reported="one exponential and one detached tensor for each sample; no time measured",
    rule="Holds if bytes kept and parameters added are those of sft and a step takes at most 1.05 times "
    "sft's time, does not hold if one of them is more.",
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
    "consft_calibrated, does not hold if both upper ends are below -0.10.",
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
    as_well = "weighing samples keeps no earlier target that sft loses"
    return Finding(
        verdict,
        (published, calibrated),
        (sft, replay),
        (*sentences, compared(sft, best, does_as_well=as_well)),
    )


@claim(
    "C8",
    CONSFT,
    reported="a case on a real robot: sft closes the gripper too high, ConSFT does not (Sec. 5.5)",
    rule="None yet.",
)
def prevents_spatial_overfitting(evidence: Evidence) -> Finding:
    """Prevents overfitting to the places of the demonstrations."""
    return Finding(
        "cannot be told",
        about=("consft", "consft_calibrated"),
        missing=(
            "No policy is evaluated outside the region of the target's demonstrations yet. What would tell "
            "is a scenario whose test episodes begin and end outside it: `clbench run` it with `sft "
            "consft consft_calibrated`.",
        ),
    )


# ---- AEGIS -------------------------------------------------------------------------------------------------


@claim(
    "A1",
    AEGIS,
    reported="OK-VQA 60.15 before, 57.36 after; the loss on held-out questions rises within 1,500 steps",
    rule="Holds if the lower end of the drop in question accuracy after the last target is above 0.01, does "
    "not hold if the upper end is below 0.01.",
)
def action_loss_erodes_answers(evidence: Evidence) -> Finding:
    """The gradient of the action loss erodes question answering rapidly."""
    drop, stopped = (question_drop(evidence, method) for method in ("sft", "stop_gradient"))
    sentences = []
    if stopped.high < drop.low:
        sentences.append("Without that gradient in the backbone less is lost: it is what erodes.")
    if drop.low > 0.01 and not any(figure.low > 0.01 for figure in answer_curve(evidence, "sft")):
        sentences.append("It is not rapid: in the whole first stage no drop is certainly above 0.01.")
    return Finding(
        decided(holds=drop.low > 0.01, fails=drop.high < 0.01),
        (drop, *answer_curve(evidence, "sft")),
        (stopped, *answer_curve(evidence, "stop_gradient")),
        tuple(sentences),
    )


@claim(
    "A2",
    AEGIS,
    reported="the loss on held-out questions stays about constant; success was not measured",
    rule="Holds if question accuracy changes by at most 0.01 and the upper end of the difference of "
    "adaptation to sft is below 0; does not hold if questions are kept and adaptation is not lower, or if "
    "the lower end of what questions lose is above 0.01.",
)
def stop_gradient_keeps_and_wastes(evidence: Evidence) -> Finding:
    """Stopping the gradient keeps knowledge, but throws away supervision."""
    questions = question_drop(evidence, "stop_gradient")
    adaptation = evidence.difference("adaptation", "stop_gradient", "sft")
    kept, of_sft = abs(questions.value) <= 0.01, question_drop(evidence, "sft")
    nothing_to_keep = of_sft.low <= questions.high
    return Finding(
        decided(
            holds=kept and adaptation.high < 0,
            fails=(kept and adaptation.high >= 0) or questions.low > 0.01,
        ),
        (adaptation, questions),
        (of_sft,),
        ("sft does not lose certainly more: there is little to keep.",) if nothing_to_keep else (),
    )


@claim(
    "A3",
    AEGIS,
    reported="with r = 16 the loss on held-out questions rises steadily, more slowly than with sft",
    rule="Holds if for every rank that was run the upper end of the difference to the frozen policy is below "
    "0 in question accuracy or in retention; does not hold if for one of them both lower ends are at least "
    "-0.01. Ranks that were not run cannot be told.",
)
def lora_still_overwrites(evidence: Evidence) -> Finding:
    """LoRA limits the rank of an update, not its direction, and still overwrites."""
    ranks = {"lora+rank=4": "r = 4", "lora": "r = 16", "lora+rank=64": "r = 64"}
    figures = {
        label: [
            evidence.difference("question_retention", label, "frozen", form=".3f"),
            evidence.difference("retention", label, "frozen"),
        ]
        for label in ranks
    }
    present = [both for label, both in figures.items() if label in evidence.runs]
    untold = [words for label, words in ranks.items() if label not in evidence.runs]
    controls = tuple(
        evidence.difference(name, "sft", "frozen", form=form)
        for name, form in (("question_retention", ".3f"), ("retention", ".2f"))
    )
    sentences = [f"Cannot be told for {', '.join(untold)}."] if present and untold else []
    for number, words in enumerate(("answers", "skills")):
        less = [ranks[label] for label, both in figures.items() if both[number].low > controls[number].high]
        sentences += [f"Fewer {words} are lost than by sft with {', '.join(less)}."] if less else []
    return Finding(
        decided(
            holds=bool(present) and all(any(figure.high < 0 for figure in both) for both in present),
            fails=any(all(figure.low >= -0.01 for figure in both) for both in present),
        ),
        tuple(figure for both in figures.values() for figure in both),
        controls,
        tuple(sentences),
    )


@claim(
    "A4",
    AEGIS,
    reported="OK-VQA 60.15 before, 60.23 after",
    rule="Holds if the lower end of the difference of question accuracy to the frozen policy is at least "
    "-0.01, does not hold if the upper end is below -0.01.",
)
def keeps_answers(evidence: Evidence) -> Finding:
    """Keeps question answering at the pretrained level while the action's gradient reaches the backbone."""
    aegis, sft, at_random = (
        evidence.difference("question_retention", method, "frozen", form=".3f")
        for method in ("aegis", "sft", "aegis+direction=random")
    )
    return Finding(
        decided(holds=aegis.low >= -0.01, fails=aegis.high < -0.01),
        (aegis,),
        (sft, at_random),
        (
            compared(sft, aegis, does_as_well="what is kept is not kept by the projection"),
            compared(at_random, aegis, does_as_well="what is kept is not kept by the anchor's direction"),
        ),
    )


@claim(
    "A5",
    AEGIS,
    reported="0.62 % on average, at most 3.4 %; about half of the layers projected on a typical step",
    rule="Holds if the mean share of the energy over steps, stages and seeds is below 0.01, else it does not "
    "hold.",
)
def sheds_little(evidence: Evidence) -> Finding:
    """Sheds less than 1 % of the gradient's energy on average."""
    mean, highest, layers = (
        evidence.diagnostic(name, "aegis", words, form=".2%")
        for name, words in (
            ("energy_shed_mean", "share of the energy that is shed, mean over steps"),
            ("energy_shed_highest", "the same at the step of each stage that sheds most"),
            ("layers_projected_mean", "share of the layers projected, mean over steps"),
        )
    )
    return Finding(decided(holds=mean.value < 0.01, fails=mean.value >= 0.01), (mean, highest, layers))


@claim(
    "A6",
    AEGIS,
    reported="said of the projection; no number was found",
    rule="Activation drift divided by that of sft with the same seed: holds if the upper end is below 0.5, "
    "does not hold if the lower end is above 0.5.",
)
def removes_drift(evidence: Evidence) -> Finding:
    """Removes the cumulative drift of activations."""
    aegis, smaller, at_random = (
        drift_ratio(evidence, method) for method in ("aegis", "low_rate_sft", "aegis+direction=random")
    )
    sentences = []
    if smaller.low <= aegis.high:
        sentences.append("low_rate_sft removes as much: smaller steps are enough for it.")
    if at_random.low <= aegis.high:
        sentences.append("A random direction removes as much: it is not the anchor's that does it.")
    return Finding(
        decided(holds=aegis.high < 0.5, fails=aegis.low > 0.5),
        (aegis,),
        (smaller, at_random),
        tuple(sentences),
    )


@claim(
    "A7",
    AEGIS,
    reported="about 40 % more time; no buffer",
    rule="Holds if a step takes at most 1.6 times sft's time, else it does not hold.",
)
def costs_40_percent(evidence: Evidence) -> Finding:
    """Costs about 40 % more time, and no buffer."""
    time = evidence.step_time("aegis")
    kept = evidence.cost("bytes_kept", "aegis", "bytes kept of aegis, the anchor")
    return Finding(decided(holds=time.value <= 1.6, fails=time.value > 1.6), (time, kept))


# ---- the capability vector ---------------------------------------------------------------------------------


@claim(
    "F1",
    CAPVECTOR,
    reported="LIBERO 87.5 with the auxiliary objective, 82.1 without, after 5,000 steps; 28 % more computing",
    rule="Holds if the lower end of the difference of forward transfer between co_training and sft is above "
    "0, does not hold if the upper end is not.",
)
def auxiliary_objective_helps(evidence: Evidence) -> Finding:
    """Plain fine-tuning adapts poorly; an auxiliary objective helps, but costs much."""
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
    rule="Holds if the lower ends of the differences of forward transfer to sft and to a random vector of "
    "equal norms are above 0; does not hold if the upper end to sft is not above 0, or if the random vector "
    "does as well: the interval of the difference to it reaches 0.",
)
def vector_carries_the_capability(evidence: Evidence) -> Finding:
    """The difference of two small trainings is a vector; merged, the policy adapts as if trained with it."""
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
    """Return what the random vector says of the capability vector."""
    if math.isnan(over_random.low):
        return "Whether a random vector does as well cannot be told."
    if over_random.low <= 0:
        return "A random vector of equal norms does as well: nothing is shown of a capability in the vector."
    return "A random vector of equal norms does not do as well: the direction matters."


@claim(
    "F3",
    CAPVECTOR,
    reported="LIBERO 90.1 without, 91.7 with it after 5,000 steps; +0.5 to +0.9 later (Table 1)",
    rule="Holds if the lower end of the difference with and without it is above 0 in adaptation or in "
    "forward transfer; does not hold if both upper ends are below 0.008, half of what the paper reports.",
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
    reported="less than 0.8 % more computing and memory, the making of the vectors not counted",
    rule="Holds if a step takes at most 1.05 times sft's time, else it does not hold.",
)
def costs_little(evidence: Evidence) -> Finding:
    """The overhead is near that of plain fine-tuning."""
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
    "difference of forward transfer to a random vector is above 0, does not hold if it is not.",
)
def vector_transfers(evidence: Evidence) -> Finding:
    """The vector transfers to other tasks than those that it was made from."""
    over_random = gain_over_random(evidence)
    return Finding(
        decided(holds=over_random.low > 0, fails=over_random.low <= 0),
        (over_random,),
        (evidence.difference("forward_transfer", "fast_dvla+direction=random", "sft", form=".3f"),),
        (sentence_on_random(over_random),),
    )
