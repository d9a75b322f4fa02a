"""The claims of AEGIS, each with its rule; docs/history.md says which rules changed, and why.

Claims about answers to questions are judged on the scenario of one long stage: on the boards, stages end
before plain fine-tuning has forgotten any answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from clbench.base.text import counted
from clbench.runs.tuning import tuned, tuned_scenarios
from clbench.scoring.reading import is_number
from clbench.spec.registry import registered_scenario

from .claim import (
    ANYWHERE,
    BOARDS,
    KNOWLEDGE,
    WITH_LIBERO,
    Finding,
    Paper,
    claim,
    decided,
    deciding,
    is_open,
    not_told_apart,
    what_would_change,
)
from .evidence import SHARE, Evidence, Figure, rung
from .figures import (
    ENDS,
    RANDOM,
    SCENARIO_RATE,
    anchor_distance,
    anchor_ratio,
    answer_curve,
    drift_ratio,
    early_success,
    learning_curve,
    loses_no_answers,
    question_drop,
    share_of_steps,
)

AEGIS = Paper("AEGIS", ("2604.16067",))

SHARES = ("energy_shed_mean", "energy_shed_highest", "layers_projected_mean")
"""Diagnostics of AEGIS that are shares."""

WITH_A_LADDER = BOARDS[:2]
"""The boards on whose ladders every method has run at every learning rate."""

NOTHING_TO_KEEP = "sft does not certainly lose 0.01 of the answers: there is nothing to keep."
CHOSEN = "Length and learning rate of this scenario were chosen so that sft loses answers (A1), and "
LOSES_ANSWERS = "A longer or narrower fine-tuning, after which sft has certainly lost answers."


@claim(
    "A1",
    AEGIS,
    reported="OK-VQA 60.15 before, 57.36 after; the loss on held-out questions rises within 1,500 steps",
    rule="Judged on a scenario that was made for it and trains one target long past learning: where stages "
    "end when the target is learned, sft loses less than 0.01 of the answers (findings.md). Its length "
    "and its learning rate, 3.3 times that of Fetch-v1, were chosen on seed 100 so that sft loses "
    "answers; at the rate of Fetch-v1 it lost 0.02 by the end, instead of 0.12. Holds if sft's drop in "
    "question accuracy certainly exceeds 0.01 within the first half of the stage; holds in part, "
    "because it is not rapid, if it does so only by the end; does not hold if the upper end of the drop "
    "at the end is below 0.01.",
    settled="2026-11-23T07:13Z",
    margin="0.01 of the answers",
    scenarios=KNOWLEDGE,
)
def action_loss_erodes_answers(evidence: Evidence) -> Finding:
    """The gradient of the action loss rapidly erodes question answering."""
    drop, stopped = (question_drop(evidence, method) for method in ("sft", "stop_gradient"))
    curve = answer_curve(evidence, "sft")
    steps, _ = learning_curve(evidence, "sft")
    half = [one for step, one in zip(steps, curve, strict=True) if step <= steps[-1] / 2]
    looked = any(one.estimate.value is not None for one in half)
    sentences = _when_lost(evidence, "sft")
    if evidence.difference("question_retention", "stop_gradient", "sft").low > 0:
        sentences.append("Without this gradient in the backbone, less is lost, so the gradient is the cause.")
    verdict = decided(
        holds=any(figure.low > 0.01 for figure in half),
        in_part=looked and drop.low > 0.01,
        fails=drop.high < 0.01,
    )
    return Finding(
        verdict,
        (drop, *curve),
        (stopped, *answer_curve(evidence, "stop_gradient")),
        tuple(sentences),
        what_would_change(deciding(verdict, half, 0.01) if verdict == "holds" else drop, 0.01)
        if looked or not drop.low > 0.01
        else "Records that ask questions within the first half of the stage.",
    )


def _when_lost(evidence: Evidence, method: str) -> list[str]:
    """Return when a method has lost answers, and when it had learned the target: the stage goes on."""
    steps, success = learning_curve(evidence, method)
    learned = next((step for step, value in zip(steps, success, strict=True) if value >= 0.9), None)
    curve = zip(steps, answer_curve(evidence, method), strict=True)
    lost = next((step for step, one in curve if one.low > 0.01), None)
    if learned is None or lost is None:
        return []
    return [
        f"{method} does the target in 0.9 of the episodes after {learned} steps; it has certainly lost 0.01 "
        f"of the answers after {lost} of {steps[-1]} steps."
    ]


@claim(
    "A2",
    AEGIS,
    reported="the loss on held-out questions stays roughly constant; success was not measured",
    rule="Supervision is lost if the upper end of the difference to sft in early success is below -0.05. "
    "Holds if stop_gradient's drop in question accuracy has an upper end below 0.01 and supervision is "
    "lost; does not hold if the lower end of the drop is above 0.01, or if the lower end of the difference "
    "in early success is above -0.05. Where sft does not certainly lose 0.01 of the answers, supervision "
    "alone is judged, by the steps to the criterion at the scenario's learning rate, divided by sft's: "
    "holds in part if the lower end is above 1.05; does not hold if the upper end is below it; else cannot "
    "be shown here.",
    settled="2026-11-28T17:29Z",
    margin="0.01 of the answers, 0.05 of the success, 0.05 of the steps",
    scenarios=(*WITH_A_LADDER, *KNOWLEDGE),
)
def stop_gradient_keeps_and_wastes(evidence: Evidence) -> Finding:
    """Stopping the gradient keeps knowledge but throws away supervision."""
    answers, early = question_drop(evidence, "stop_gradient"), early_success(evidence, "stop_gradient", "sft")
    of_sft = question_drop(evidence, "sft")
    if loses_no_answers(of_sft):
        at_one = (rung(method, SCENARIO_RATE) for method in ("stop_gradient", "sft"))
        return _by_steps(share_of_steps(evidence, *at_one), (early, answers, of_sft))
    if of_sft.is_unknown:
        return Finding("undecided", (early, answers), (of_sft,), change=what_would_change(of_sft, 0.01))
    by_answers = answers.low > 0.01 or early.high < -0.05
    return Finding(
        decided(
            holds=answers.high < 0.01 and early.high < -0.05,
            fails=answers.low > 0.01 or early.low > -0.05,
        ),
        (early, answers),
        (of_sft,),
        (),
        what_would_change(*((answers, 0.01) if by_answers else (early, -0.05))),
    )


def _by_steps(steps: Figure, others: tuple[Figure, ...]) -> Finding:
    """Judge whether supervision is lost, where there is no knowledge to keep."""
    if steps.low > 1.05 or steps.high < 1.05:
        half = "Only the half on supervision was judged: sft does not certainly lose answers here."
        return Finding(
            decided(holds=False, in_part=steps.low > 1.05, fails=steps.high < 1.05),
            (steps,),
            others,
            (half,),
            what_would_change(steps, 1.05),
        )
    return Finding(
        "cannot be shown here", (steps, *others[:2]), others[2:], (NOTHING_TO_KEEP,), LOSES_ANSWERS
    )


@claim(
    "A3",
    AEGIS,
    reported="with r = 16 the loss on held-out questions rises steadily, more slowly than with sft",
    rule="Holds if, for ranks 4, 16 and 64, the upper end of the difference to the frozen policy is below "
    "-0.01 in question accuracy; holds in part if it is so for some of them, or only in retention and below "
    "-0.05; does not hold if, for every rank, both lower ends are above these margins. LoRA trains at 3 "
    "times sft's learning rate, and alpha stays 32: the scale of its output falls as the rank rises.",
    settled="2026-11-23T07:13Z",
    margin="0.01 of the answers, 0.05 of the retained success",
    scenarios=KNOWLEDGE,
)
def lora_still_overwrites(evidence: Evidence) -> Finding:
    """LoRA limits the rank of an update, not its direction, and still overwrites knowledge."""
    labels = ("lora+rank=4", "lora", "lora+rank=64")
    answers = [evidence.difference("question_retention", label, "frozen", form=".3f") for label in labels]
    skills = [evidence.difference("retention", label, "frozen") for label in labels]
    of_sft = evidence.difference("question_retention", "sft", "frozen", form=".3f")
    lost = [figure.high < -0.01 for figure in answers]
    less = [figure.methods[0] for figure in answers if figure.low > of_sft.high]
    return Finding(
        decided(
            holds=all(lost),
            in_part=any(lost) or any(figure.high < -0.05 for figure in skills),
            fails=all(figure.low > -0.01 for figure in answers)
            and all(figure.low > -0.05 for figure in skills),
        ),
        (answers[1], answers[0], answers[2], *skills),
        (of_sft, evidence.difference("retention", "sft", "frozen"), *answer_curve(evidence, "lora")),
        (
            *([f"{', '.join(less)}: fewer answers are lost than with sft."] if less else ()),
            "The direction of the update was not measured.",
            *(f"{one}." for one, _ in _not_tuned(evidence, "lora")),
            *_when_lost(evidence, "lora"),
        ),
        what_would_change(*_deciding_rank(answers, skills)),
    )


def _not_tuned(evidence: Evidence, method: str) -> list[tuple[str, bool]]:
    """Return how the learning rate of a method that was not tuned compares with those that tuning chose.

    The second value is whether it is higher than one of them. Empty if the method was tuned on the scenario,
    or on no other, or has no run.
    """
    run = evidence.first_run(method)
    rate: Any = run.record.scenario.budget.get("learning_rate") if run else None
    if run is None or not is_number(rate) or method in tuned(evidence.scenario):
        return []
    factor: Any = run.record.run.settings.get("step_factor", SCENARIO_RATE)
    ratios = sorted(
        rate * factor / (registered_scenario(name).budget.learning_rate * found.settings["step_factor"])
        for name in tuned_scenarios()
        if (found := tuned(name).get(method))
    )
    if not ratios:
        return []
    least, most = (f"{one:.0f}" if one >= 1 else f"{one:.2g}" for one in (ratios[0], ratios[-1]))
    times = least if least == most else f"{least} to {most}"
    how = "is one" if times == "1" else f"is {times} times those"
    text = f"{method} was not tuned here: its learning rate {how} that tuning chose elsewhere"
    return [(text, ratios[-1] > 1 + 1e-9)]


def _deciding_rank(answers: Sequence[Figure], skills: Sequence[Figure]) -> tuple[Figure, float]:
    """Return the figure that would first change the verdict on LoRA, and its bar."""
    kept = [one for one in answers if not one.high < -0.01]
    if not kept:
        return max(answers, key=lambda one: one.high), -0.01
    bars = [(one, -0.01) for one in kept]
    if len(kept) == len(answers):  # else skills no longer matter
        bars += [(one, -0.05) for one in skills]
    nearest = min(kept, key=lambda one: one.low), -0.01
    return next((pair for pair in bars if is_open(*pair)), nearest)


@claim(
    "A4",
    AEGIS,
    reported="OK-VQA 60.15 before, 60.23 after",
    rule="Holds if the lower end of the difference in question accuracy to the frozen policy is at least "
    "-0.01; does not hold if the upper end is below -0.01. Cannot be shown here if sft does not certainly "
    "lose 0.01 of the answers.",
    settled="2026-11-23T07:13Z",
    margin="0.01 of the answers",
    scenarios=KNOWLEDGE,
)
def keeps_answers(evidence: Evidence) -> Finding:
    """Keeps question answering at the pretrained level although the action gradient reaches the backbone."""
    aegis, sft = (
        evidence.difference("question_retention", method, "frozen", form=".3f") for method in ("aegis", "sft")
    )
    gains: tuple[Figure, ...] = tuple(
        evidence.difference("question_retention", "aegis", other, form=".3f") for other in ("sft", RANDOM)
    )
    of_sft = question_drop(evidence, "sft")
    if loses_no_answers(of_sft):
        return Finding("cannot be shown here", (aegis,), (sft, *gains), (NOTHING_TO_KEEP,), LOSES_ANSWERS)
    chosen = CHOSEN if evidence.scenario in KNOWLEDGE else ""
    return Finding(
        "undecided" if of_sft.is_unknown else decided(holds=aegis.low >= -0.01, fails=aegis.high < -0.01),
        (aegis,),
        (sft, *gains, *answer_curve(evidence, "aegis")),
        (
            *(
                f"{chosen}{one}.{' It may keep answers at smaller rates.' if is_higher else ''}"
                for one, is_higher in _not_tuned(evidence, "aegis")
            ),
            *_when_lost(evidence, "aegis"),
            *_near_the_anchor(anchor_ratio(evidence)),
            not_told_apart(
                gains[0],
                explains="the projection need not keep any answer",
                does_not="the projection keeps answers",
            ),
            not_told_apart(
                gains[1],
                explains="aegis need not keep more than a random direction, which removes nearly no energy",
                does_not="the anchor's direction matters",
            ),
        ),
        what_would_change(*((of_sft, 0.01) if of_sft.is_unknown else (aegis, -0.01))),
    )


@claim(
    "A5",
    AEGIS,
    reported="0.62 % on average, at most 3.4 % (the notes do not say of which weights' energy; here "
    "it is that of the backbone's layers); about half of the layers projected on a typical step",
    rule="Judged in the first stage, as the paper fine-tunes on one data set. Holds if the upper end of the "
    "mean share over steps and seeds is below 0.01; does not hold if the lower end is above 0.01.",
    settled="2026-11-23T07:13Z",
    margin="0.01 of the energy, the claim's own",
    scenarios=(*WITH_LIBERO, *KNOWLEDGE),
)
def sheds_little(evidence: Evidence) -> Finding:
    """Sheds less than 1 % of the gradient's energy on average."""
    shed = "share of the energy that is shed, mean over steps"
    first = _of_stages(evidence, "energy_shed_mean", f"{shed}, first stage", stage=1)
    most = "share of the energy that is shed at the step that sheds most, first stage"
    highest = _of_stages(evidence, "energy_shed_highest", most, stage=1)
    layers = _of_stages(
        evidence, "layers_projected_mean", "share of the layers projected, first stage", stage=1
    )
    everywhere = _of_stages(evidence, "energy_shed_mean", f"{shed}, all stages")
    return Finding(
        decided(holds=first.high < 0.01, fails=first.low > 0.01),
        (first, everywhere, highest, layers),
        sentences=_seeds_below(evidence),
        change=what_would_change(first, 0.01),
    )


def _seeds_below(evidence: Evidence) -> tuple[str, ...]:
    """Return in how many seeds the share is below the bar: one seed may decide the mean."""
    runs = evidence.runs.get("aegis", {}).values()
    shed = [run.record.diagnostics.get("1") for run in runs]
    values: list[Any] = [found.get("energy_shed_mean") for found in shed if isinstance(found, dict)]
    known = [value for value in values if is_number(value)]
    if len(known) < 2:
        return ()
    below = sum(value < 0.01 for value in known)
    seeds = f"{below} of {counted(len(known), 'seed')}"
    return (f"The share of the first stage is below 1 % in {seeds}; the largest is {max(known):.2%}.",)


def _of_stages(evidence: Evidence, name: str, what: str, stage: int | None = None) -> Figure:
    return evidence.diagnostic("aegis", what, name, SHARE, ".2%", stage)


@claim(
    "A6",
    AEGIS,
    reported="stated about the projection; no number was found",
    rule="Two figures. The first is AEGIS's own drift: the distance of the robot's batch to the anchor at "
    "the end of the first stage, divided by that with a random direction, which removes nearly no energy. "
    "The second is how far training moves the hidden states of the questions, of which the anchor is made, "
    "divided by sft's. Holds if both upper ends are below 0.5; holds in part if only the first is; does not "
    "hold if the lower end of the first is above 0.5.",
    settled="2026-11-29T01:25Z",
    margin="half of the drift",
    scenarios=KNOWLEDGE,
)
def removes_drift(evidence: Evidence) -> Finding:
    """Removes the cumulative drift of activations."""
    near = anchor_ratio(evidence)
    on_questions, at_random = (drift_ratio(evidence, method) for method in ("aegis", RANDOM))
    first, last = (anchor_distance(evidence, "aegis", end) for end in ENDS)
    both, near_enough = near.high < 0.5 and on_questions.high < 0.5, near.high < 0.5
    second = max((near, on_questions), key=lambda one: one.high) if both else on_questions
    return Finding(
        decided(holds=both, in_part=near_enough and on_questions.high >= 0.5, fails=near.low > 0.5),
        (near, on_questions),
        (first, last, *(anchor_distance(evidence, RANDOM, end) for end in ENDS), at_random),
        (*_on_questions(on_questions), *_where_it_begins(first, last)),
        what_would_change(second if near_enough else near, 0.5),
    )


def _where_it_begins(first: Figure, last: Figure) -> tuple[str, ...]:
    """Return a sentence if AEGIS certainly ends nearer to its anchor than it begins."""
    if not last.high < first.low:
        return ()
    return (
        "The robot's batches are not questions, so their distance to the anchor is "
        f"{first.value:.1f} even before the first step. It ends at {last.value:.1f}. The projection removes "
        "only what leads away from the anchor: it does not hold the robot's hidden states in place, and they "
        "move onto those of the questions.",
    )


def _on_questions(drift: Figure) -> tuple[str, ...]:
    """Return a sentence if the hidden states of questions do not certainly drift less, too."""
    if not drift.high >= 0.5:  # also without an interval
        return ()
    return (
        "The hidden states of questions, whose answers can be lost nevertheless (A4), move "
        f"{drift.value:.2f} [{drift.low:.2f}, {drift.high:.2f}] times as far as with sft.",
    )


def _near_the_anchor(near: Figure) -> tuple[str, ...]:
    """Return a sentence if the projection certainly keeps the robot's batches nearer to the anchor."""
    if not near.high < 0.5:
        return ()
    figure = f"{near.value:.3f} [{near.low:.3f}, {near.high:.3f}]"
    return (
        "The projection acts: at the end of the first stage, the distance of the robot's batch to the anchor "
        f"is {figure} of that with a random direction; batches near the anchor need not keep the answers.",
    )


def _nearest_bar(time: Figure) -> float:
    """Return the bar of A7 that the interval contains or, if it contains none, that is nearest to an end."""
    bars = (1.2, 1.6)
    inside = [bar for bar in bars if time.low < bar <= time.high]
    return min(inside or bars, key=lambda bar: min(abs(time.low - bar), abs(time.high - bar)))


@claim(
    "A7",
    AEGIS,
    reported="about 40 % more time; no buffer",
    rule="Holds if the interval of a step's time, divided by sft's, lies between 1.2 and 1.6, and stages "
    "read no prior data; does not hold if it lies outside, or if they read any.",
    settled="2026-11-28T20:50Z",
    margin="0.2 of the time of a step",
    scenarios=ANYWHERE,
)
def costs_40_percent(evidence: Evidence) -> Finding:
    """Costs about 40 % more time and needs no buffer."""
    time = evidence.step_time("aegis")
    buffer = any(
        "throughout" in run.record.run.uses.values() for run in evidence.runs.get("aegis", {}).values()
    )
    return Finding(
        decided(
            holds=time.low >= 1.2 and time.high <= 1.6 and not buffer,
            fails=time.low > 1.6 or time.high < 1.2 or buffer,
        ),
        (time, evidence.cost("bytes_kept", "aegis", "bytes kept of aegis, the anchor")),
        change="Runs whose stages read no prior data."
        if buffer
        else what_would_change(time, _nearest_bar(time)),
    )
