"""The claims of AEGIS, each with a rule that was fixed before there were results to judge."""

from __future__ import annotations

from .claim import Finding, Paper, claim, compared, decided
from .evidence import Evidence
from .figures import answer_curve, drift_ratio, question_drop

AEGIS = Paper("AEGIS", ("2604.16067",))


@claim(
    "A1",
    AEGIS,
    reported="OK-VQA 60.15 before, 57.36 after; the loss on held-out questions rises within 1,500 steps",
    rule="Holds if the lower end of the drop in question accuracy after the last target is above 0.01; does "
    "not hold if the upper end is below 0.01.",
)
def action_loss_erodes_answers(evidence: Evidence) -> Finding:
    """The gradient of the action loss rapidly erodes question answering."""
    drop, stopped = (question_drop(evidence, method) for method in ("sft", "stop_gradient"))
    sentences = []
    if stopped.high < drop.low:
        sentences.append(
            "Without that gradient in the backbone, less is lost: the gradient causes the erosion."
        )
    if drop.low > 0.01 and not any(figure.low > 0.01 for figure in answer_curve(evidence, "sft")):
        sentences.append(
            "The erosion is not rapid: during the whole first stage, no drop is certainly above 0.01."
        )
    return Finding(
        decided(holds=drop.low > 0.01, fails=drop.high < 0.01),
        (drop, *answer_curve(evidence, "sft")),
        (stopped, *answer_curve(evidence, "stop_gradient")),
        tuple(sentences),
    )


@claim(
    "A2",
    AEGIS,
    reported="the loss on held-out questions stays roughly constant; success was not measured",
    rule="Holds if question accuracy changes by at most 0.01 and the upper end of the difference in "
    "adaptation to sft is below 0; does not hold if answers are kept and adaptation is not lower, or if "
    "the lower end of the loss in question accuracy is above 0.01.",
)
def stop_gradient_keeps_and_wastes(evidence: Evidence) -> Finding:
    """Stopping the gradient keeps knowledge but throws away supervision."""
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
        ("sft does not lose certainly more, so there is little to keep.",) if nothing_to_keep else (),
    )


@claim(
    "A3",
    AEGIS,
    reported="with r = 16 the loss on held-out questions rises steadily, more slowly than with sft",
    rule="Holds if, for every rank that was run, the upper end of the difference to the frozen policy is "
    "below 0 in question accuracy or in retention; does not hold if, for one of them, both lower ends are at "
    "least -0.01. Ranks that were not run cannot be judged.",
)
def lora_still_overwrites(evidence: Evidence) -> Finding:
    """LoRA limits the rank of an update, not its direction, and still overwrites knowledge."""
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
    sentences = [f"There are no records for {', '.join(untold)}."] if present and untold else []
    for number, words in enumerate(("answers", "skills")):
        less = [ranks[label] for label, both in figures.items() if both[number].low > controls[number].high]
        sentences += [f"With {', '.join(less)}, fewer {words} are lost than with sft."] if less else []
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
    rule="Holds if the lower end of the difference in question accuracy to the frozen policy is at least "
    "-0.01; does not hold if the upper end is below -0.01.",
)
def keeps_answers(evidence: Evidence) -> Finding:
    """Keeps question answering at the pretrained level although the action gradient reaches the backbone."""
    aegis, sft, at_random = (
        evidence.difference("question_retention", method, "frozen", form=".3f")
        for method in ("aegis", "sft", "aegis+direction=random")
    )
    return Finding(
        decided(holds=aegis.low >= -0.01, fails=aegis.high < -0.01),
        (aegis,),
        (sft, at_random),
        (
            compared(sft, aegis, does_as_well="the projection does not explain what is kept"),
            compared(at_random, aegis, does_as_well="the anchor's direction does not explain what is kept"),
        ),
    )


@claim(
    "A5",
    AEGIS,
    reported="0.62 % on average, at most 3.4 %; about half of the layers projected on a typical step",
    rule="Holds if the mean share of the energy over steps, stages and seeds is below 0.01; otherwise it "
    "does not hold.",
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
    reported="stated about the projection; no number was found",
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
        sentences.append("low_rate_sft removes as much: smaller steps suffice.")
    if at_random.low <= aegis.high:
        sentences.append(
            "A random direction removes as much: the anchor's direction does not explain the result."
        )
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
    rule="Holds if a step takes at most 1.6 times as long as a step of sft; otherwise it does not hold.",
)
def costs_40_percent(evidence: Evidence) -> Finding:
    """Costs about 40 % more time and needs no buffer."""
    time = evidence.step_time("aegis")
    kept = evidence.cost("bytes_kept", "aegis", "bytes kept of aegis, the anchor")
    return Finding(decided(holds=time.value <= 1.6, fails=time.value > 1.6), (time, kept))
