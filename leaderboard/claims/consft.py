"""The claims of ConSFT, each with its rule; docs/history.md names the rules that were corrected later."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from .claim import ANYWHERE, Finding, Paper, best_first, claim, decided, not_told_apart, what_would_change
from .evidence import Evidence, Figure, rung
from .figures import (
    PUBLISHED,
    kept,
    perturbation_gain,
    perturbation_loss,
    retention_drop,
    share_between,
    sparsity,
)

CONSFT = Paper("ConSFT", ("2605.08879",))

ARMS = ("consft", "consft_calibrated")
"""The published loss with a tuned first temperature; the published constants, with the loss in their unit."""

LEAST_BETWEEN = 0.1
"""Share of the weights between 0.01 and 0.9, before the last tenth of the schedule, from which an arm counts.
Below it, most samples of most steps weigh alike: nothing, which Adam cancels, or 1."""


def _counts(share: Figure) -> bool:
    """Return whether an arm with this share has weights that differ between samples; unknown ones may."""
    return math.isnan(share.value) or share.value >= LEAST_BETWEEN


def _arms(evidence: Evidence) -> tuple[str, ...]:
    """Return the arms that count: those whose weights differ between samples."""
    return tuple(arm for arm in ARMS if _counts(share_between(evidence, arm)))


def _inactive_sentences(evidence: Evidence) -> tuple[str, ...]:
    shares = ((arm, share_between(evidence, arm)) for arm in ARMS)
    return tuple(
        f"Before the last tenth of its schedule, {share.value:.1%} of the weights of {arm} lie between 0.01 "
        "and 0.9: most samples weigh alike, and its figures do not count."
        for arm, share in shares
        if not _counts(share)
    )


def _without_an_arm(
    evidence: Evidence, figures: Sequence[Figure], controls: Sequence[Figure] = ()
) -> Finding:
    """Return the finding on a board on which no arm counts."""
    shares = tuple(share_between(evidence, arm) for arm in ARMS)
    return Finding(
        "cannot be shown here",
        best_first(figures),
        (*controls, *shares),
        _inactive_sentences(evidence),
        NEEDS_WEIGHTS,
        about=ARMS,
    )


NEEDS_WEIGHTS = "Weights that differ between samples while the temperature is low."


@claim(
    "C1",
    CONSFT,
    reported="0.49 on prior tasks before sft, 0.09 after; about 70 % of the parameters unchanged (pi0, "
    "LIBERO, Tables 1 and 2)",
    rule="Holds if the lower end of the drop in retained success with sft at its best learning rate is above "
    "0.05; does not hold if the upper end is below 0.05.",
    margin="0.05 of the retained success",
)
def sft_degrades(evidence: Evidence) -> Finding:
    """Fine-tuning without constraint degrades pretrained skills."""
    drop, joint = retention_drop(evidence, "sft"), retention_drop(evidence, "joint")
    published = retention_drop(evidence, rung("sft", PUBLISHED))
    sentences = []
    if joint.high < drop.low:
        sentences.append(
            "joint, which also learns every target, loses less: learning alone need not degrade."
        )
    return Finding(
        decided(holds=drop.low > 0.05, fails=drop.high < 0.05),
        (drop, published),
        (retention_drop(evidence, "frozen"), joint),
        tuple(sentences),
        what_would_change(drop, 0.05),
    )


@claim(
    "C2",
    CONSFT,
    reported="over 20 points on average; the visible margins are +25, +20, +10 and +14 (Table 2)",
    rule="An arm (consft with a tuned first temperature, or consft_calibrated) counts if 10 % of its weights "
    "before the last tenth of the schedule are between 0.01 and 0.9. Holds if the lower end of the "
    "difference in retained success to sft, each at its best settings, is at least 0.20 for an arm; holds in "
    "part if it is so only with both at the published learning rate; does not hold if all upper ends are "
    "below 0.20. Cannot be shown here if no arm counts, or if sft certainly keeps more than 0.80 at both "
    "settings.",
    margin="0.20 of the retained success, the claim's own",
)
def keeps_20_points_more(evidence: Evidence) -> Finding:
    """Keeps pretrained skills more than 20 points better than plain fine-tuning."""
    arms = _arms(evidence)
    at_best = [kept(evidence, arm, "sft") for arm in ARMS]
    at_one = [kept(evidence, rung(arm, PUBLISHED), rung("sft", PUBLISHED)) for arm in ARMS]
    sft = [evidence.metric("retention", label) for label in ("sft", rung("sft", PUBLISHED))]
    counting = [figure for figure in at_best if figure.methods[0] in arms]
    published = [figure for figure in at_one if figure.methods[0] in {rung(arm, PUBLISHED) for arm in arms}]
    judged = (*counting, *published)
    best = best_first(counting or at_best)[0]
    figures = (best, *(one for one in (*at_best, *at_one) if one is not best))
    controls = _controls_of(evidence, best.methods[0])
    controls_at_one = _controls_at_the_published_rate(evidence)
    shown = (*sft, *controls, *controls_at_one, *(share_between(evidence, arm) for arm in ARMS))
    at_one_says = _what_the_published_rate_says(best_first(at_one)[0], controls_at_one)
    if not arms or all(one.low > 0.80 for one in sft):
        reason = ("sft keeps too much for a gain of 0.20.",) if arms else ()
        return Finding(
            "cannot be shown here",
            figures,
            shown,
            (*_inactive_sentences(evidence), *reason, *at_one_says),
            "A setting in which sft keeps less than 0.80." if arms else NEEDS_WEIGHTS,
        )
    return Finding(
        decided(
            holds=any(one.low >= 0.20 for one in counting),
            in_part=any(one.low >= 0.20 for one in published),
            fails=all(one.high < 0.20 for one in judged),
        ),
        figures,
        shown,
        (*_inactive_sentences(evidence), *_what_controls_say(controls, arms), *at_one_says),
        what_would_change(next((one for one in judged if _is_open(one, 0.20)), best), 0.20),
        about=ARMS,
    )


def _is_open(figure: Figure, bar: float) -> bool:
    """Return whether an interval contains the bar, or is not known."""
    return not (figure.low >= bar or figure.high < bar)


CONTROLS = {
    "constant_weight": (
        "weighing single samples need not be what keeps skills",
        "the weights of single samples matter",
    ),
    "shuffled_weights": (
        "it need not matter which samples get small weights",
        "it matters which samples get small weights",
    ),
    "finch": (
        "a learning rate that follows the loss may suffice",
        "a learning rate that follows the loss does not suffice",
    ),
}
"""Controls of ConSFT: what one says that is not told apart from it, and one that is worse."""


def _controls_of(evidence: Evidence, arm: str) -> tuple[Figure, ...]:
    """Return the gains in retained success over the controls: two of consft_calibrated, and one of `arm`."""
    first = [kept(evidence, "consft_calibrated", name) for name in ("constant_weight", "shuffled_weights")]
    return (*first, kept(evidence, arm, "finch"))


def _controls_at_the_published_rate(evidence: Evidence) -> tuple[Figure, ...]:
    """Return the gains of consft_calibrated over two controls at the published learning rate, if they ran."""
    labels = [f"{name}+step_factor={PUBLISHED}" for name in ("constant_weight", "shuffled_weights")]
    arm = rung("consft_calibrated", PUBLISHED)
    return tuple(kept(evidence, arm, label) for label in labels if label in evidence.runs)


def _what_the_published_rate_says(gain: Figure, controls: Sequence[Figure]) -> list[str]:
    """Return in a sentence what an arm gains at the published learning rate, and what the controls say."""
    if not gain.low > 0:
        return []
    said = f"At the published learning rate {gain.methods[0]} keeps {gain.value:.2f} more than sft"
    for one in controls:
        name = one.methods[1].partition("+")[0]
        explains, does_not = CONTROLS[name]
        said += f"; {not_told_apart(one, name, explains=explains, does_not=does_not).rstrip('.')}"
    return [f"{said}."]


def _what_controls_say(figures: tuple[Figure, ...], arms: Sequence[str]) -> list[str]:
    """Return what the controls of the arms that count say."""
    says = [(one, *CONTROLS[one.methods[1]]) for one in figures if one.methods[0] in arms]
    return [not_told_apart(figure, explains=yes, does_not=no) for figure, yes, no in says]


@claim(
    "C3",
    CONSFT,
    reported="0.34 on prior tasks against 0.18 with 1:1 replay (pi0, LIBERO, Table 3)",
    rule="Holds if the lower end of the difference in retained success is at least -0.05 against both kinds "
    "of replay, for one of the arms of C2 that count, all at their best settings; does not hold if each of "
    "these arms has an upper end below -0.05 against one of them. Cannot be shown here if no arm counts. The "
    "tuned share of replay is in the note; the paper compares with 1:1.",
    margin="0.05 of the retained success",
)
def as_good_as_replay(evidence: Evidence) -> Finding:
    """As good as experience replay, without prior data."""
    replays = ("experience_replay", "buffered_replay")
    arms = [[kept(evidence, arm, replay) for replay in replays] for arm in _arms(evidence)]
    if not arms:
        return _without_an_arm(evidence, [kept(evidence, arm, replays[0]) for arm in ARMS])
    holding = [arm[0].methods[0] for arm in arms if all(figure.low >= -0.05 for figure in arm)]
    figures = best_first([arm[0] for arm in arms])
    sentences = [f"It holds for {' and '.join(holding)}."] if holding else []
    return Finding(
        decided(holds=bool(holding), fails=all(any(figure.high < -0.05 for figure in arm) for arm in arms)),
        figures,
        tuple(arm[1] for arm in arms),
        (*_inactive_sentences(evidence), *sentences),
        what_would_change(figures[0], -0.05),
        about=ARMS,
    )


@claim(
    "C4",
    CONSFT,
    reported="a curve without numbers: sparsity decays later and more evenly than with sft (Fig. 2)",
    rule="Update sparsity after the last target, each method at its best settings. Holds if the lower end "
    "of the difference to sft is above 0.05 for one of the arms of C2 that count; does not hold if all their "
    "upper ends are below 0.05. Cannot be shown here if the measure does not notice a penalty on moved "
    "weights (l2_sp's difference to sft has an upper end below 0.05), or if no arm counts.",
    margin="0.05 of the parameters",
)
def stays_sparse(evidence: Evidence) -> Finding:
    """Updates stay sparse."""
    arms = [sparsity(evidence, arm, "sft") for arm in _arms(evidence)]
    response = sparsity(evidence, "l2_sp", "sft")
    if not arms:
        return _without_an_arm(evidence, [sparsity(evidence, arm, "sft") for arm in ARMS], (response,))
    figures = best_first(arms)
    if response.high < 0.05:
        return Finding(
            "cannot be shown here",
            figures,
            (response,),
            (
                *_inactive_sentences(evidence),
                "Even a penalty on moved weights keeps no more in place.",
            ),
            "A measure of sparsity that responds to a penalty on moved weights.",
            about=ARMS,
        )
    responds = response.high >= 0.05  # not known without l2_sp
    return Finding(
        decided(
            holds=responds and any(one.low > 0.05 for one in arms),
            fails=responds and all(one.high < 0.05 for one in arms),
        ),
        figures,
        (response,),
        _inactive_sentences(evidence),
        what_would_change(figures[0] if responds else response, 0.05),
        about=ARMS,
    )


@claim(
    "C5",
    CONSFT,
    reported="risk times omega squared (Eq. 7), no measurement",
    rule="Holds by construction for one sample, while the test "
    "`test_one_sample_disrupts_old_knowledge_by_the_square_of_its_weight` of `tests/methods/test_consft.py` "
    "passes. No record can change it.",
    margin="none: an identity",
    scenarios=ANYWHERE,
)
def bounds_the_risk_of_a_step(evidence: Evidence) -> Finding:
    """Bounds how much a step can disrupt: the risk scales with the square of the weight."""
    return Finding(
        "holds",
        (),
        (),
        (
            "The weight is a factor of the sample's gradient, so g'Fg contains its square. This does not "
            "cover the sum of many steps: Adam cancels a factor that all samples share.",
        ),
        "Nothing: it is algebra.",
        about=ARMS,
    )


@claim(
    "C6",
    CONSFT,
    reported="one exponential and one detached tensor per sample; no time measured",
    rule="Holds if bytes kept and parameters added equal those of sft and the upper end of a step's time is "
    "at most 1.05 times sft's; does not hold if bytes or parameters are more, or if the lower end is above "
    "1.05.",
    margin="5 % of the time of a step",
    scenarios=ANYWHERE,
)
def costs_nothing(evidence: Evidence) -> Finding:
    """Needs no extra network, memory or data."""
    (bytes_kept, bytes_of_sft), (added, added_by_sft) = (
        [evidence.cost(name, method, f"{words} of {method}") for method in ("consft", "sft")]
        for name, words in (("bytes_kept", "bytes kept"), ("parameters_added", "parameters added"))
    )
    time = evidence.step_time("consft")
    same = bytes_kept.value == bytes_of_sft.value and added.value == added_by_sft.value
    more = bytes_kept.value > bytes_of_sft.value or added.value > added_by_sft.value
    return Finding(
        decided(holds=same and time.high <= 1.05, fails=more or time.low > 1.05),
        (time, bytes_kept, added),
        (bytes_of_sft, added_by_sft),
        (),
        what_would_change(time, 1.05),
    )


@claim(
    "C7",
    CONSFT,
    reported="stated in the abstract; no number was found",
    rule="Holds if the lower end of backward transfer is at least -0.10 for one of the arms of C2 that "
    "count; does not hold if all their upper ends are below -0.10. Cannot be shown here if no arm counts.",
    margin="0.10 of the success on earlier targets",
)
def keeps_earlier_targets(evidence: Evidence) -> Finding:
    """Learns several targets in sequence and keeps the earlier ones."""
    own = {arm: evidence.metric("backward_transfer", arm) for arm in ARMS}
    references = tuple(evidence.metric("backward_transfer", name) for name in ("sft", "experience_replay"))
    arms = [own[arm] for arm in _arms(evidence)]
    if not arms:
        return _without_an_arm(evidence, tuple(own.values()), references)
    figures = best_first(arms)
    over_sft, *over_controls = _gains_in_transfer(evidence, figures[0].methods[0])
    return Finding(
        decided(holds=any(one.low >= -0.10 for one in arms), fails=all(one.high < -0.10 for one in arms)),
        figures,
        (over_sft, *over_controls, *references),
        (*_inactive_sentences(evidence), _what_keeps_targets(over_sft, over_controls)),
        what_would_change(figures[0], -0.10),
        about=ARMS,
    )


def _gains_in_transfer(evidence: Evidence, arm: str) -> Iterator[Figure]:
    """Yield the gain of an arm over sft, over sft at the arm's step factor, and over its controls."""
    run = next(iter(evidence.runs.get(arm, {}).values()), None)
    alike = rung("sft", run.record.run.settings.get("step_factor", PUBLISHED)) if run else "sft"
    rest = (label for label in (alike, *CONTROLS) if label in evidence.runs)
    for other in dict.fromkeys(("sft", *rest)):
        yield evidence.difference("backward_transfer", arm, other)


def _what_keeps_targets(over_sft: Figure, over_controls: Sequence[Figure]) -> str:
    """Return what sft and the controls say about an arm's gain in backward transfer."""
    equal = [one.methods[1] for one in over_controls if not one.low > 0]
    if over_sft.low > 0 and equal:
        are = "is" if len(equal) == 1 else "are"
        return (
            f"sft at its best learning rate does not reach it, but {' and '.join(equal)} {are} not told "
            "apart from it: weighing samples need not be the cause."
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
    "gripper starts elsewhere and the block weighs half or twice as much. "
    "Holds if the lower end of sft's loss minus the method's is above 0.05 for one of the arms of C2 that "
    "count; does not hold if all their upper ends are below 0.05. Cannot be shown here if no arm counts, or "
    "if the upper end of sft's own loss is below 0.05.",
    margin="0.05 of the success",
    scenarios=ANYWHERE,
)
def prevents_spatial_overfitting(evidence: Evidence) -> Finding:
    """Prevents overfitting to the positions in the demonstrations."""
    of_sft = perturbation_loss(evidence, "sft")
    arms = [perturbation_gain(evidence, arm, "sft") for arm in _arms(evidence)]
    if not arms:
        return _without_an_arm(evidence, [perturbation_gain(evidence, arm, "sft") for arm in ARMS], (of_sft,))
    figures = best_first(arms)
    if of_sft.high < 0.05:
        return Finding(
            "cannot be shown here",
            figures,
            (of_sft,),
            ("sft loses nothing in perturbed episodes: there is nothing to prevent.",),
            "Starts farther from the demonstrated ones, at which sft fails.",
            about=ARMS,
        )
    return Finding(
        decided(holds=any(one.low > 0.05 for one in arms), fails=all(one.high < 0.05 for one in arms)),
        figures,
        (of_sft,),
        _inactive_sentences(evidence),
        what_would_change(figures[0], 0.05),
        about=ARMS,
    )
