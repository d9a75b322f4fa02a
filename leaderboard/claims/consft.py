"""The claims of ConSFT, each with its rule; docs/history.md says which rules changed, and why."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

from clbench.scoring.reading import is_number

from ..board.runs import PRIOR
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
    WITH_LIBERO,
    Finding,
    Paper,
    Verdict,
    best_first,
    cannot_be_shown,
    claim,
    decided,
    deciding,
    what_would_change,
)
from .consft_controls import (
    controls_at_the_full_rate,
    controls_of,
    sft_at_the_rate_of,
    what_controls_say,
    what_the_full_rate_says,
)
from .evidence import Evidence, Figure, rung
from .figures import (
    SCENARIO_RATE,
    retention_difference,
    retention_drop,
    share_afterwards,
    share_between,
)

CONSFT = Paper("ConSFT", ("2605.08879",))


@claim(
    "C1",
    CONSFT,
    reported="0.49 on prior tasks before sft, 0.09 after (pi0, LIBERO, Table 2); the weights are overwritten "
    "densely (about 30 % of them change)",
    rule="Holds if the lower end of the drop in retained success with sft at its best learning rate is above "
    "0.05; does not hold if the upper end is below 0.05.",
    settled="2026-11-23T07:13Z",
    margin="0.05 of the retained success",
    scenarios=WITH_LIBERO,
)
def sft_degrades(evidence: Evidence) -> Finding:
    """Unconstrained fine-tuning degrades pretrained skills."""
    drop, at_one = (retention_drop(evidence, label) for label in ("sft", rung("sft", SCENARIO_RATE)))
    # joint has the scenario's learning rate
    joint = retention_difference(evidence, "joint", rung("sft", SCENARIO_RATE))
    learned = evidence.metric("adaptation", "joint")
    sparse = replace(evidence.metric("update_sparsity", "sft"), note="density is not judged")
    return Finding(
        decided(holds=drop.low > 0.05, fails=drop.high < 0.05),
        (drop, at_one),
        (retention_drop(evidence, "frozen"), retention_drop(evidence, "joint"), joint, sparse),
        _what_joint_says(joint, learned),
        what_would_change(drop, 0.05) + (LOSES_AT_ONE if at_one.low > 0.05 >= drop.low else ""),
    )


LOSES_AT_ONE = (
    " Or a rule that asks for the scenario's learning rate: at that rate, sft certainly loses more than 0.05."
)
"""What C1 adds where the loss is certain, but not at the best learning rate."""


def _what_joint_says(gain: Figure, learned: Figure) -> tuple[str, ...]:
    """Return whether training on all data keeps more than sft at its learning rate; empty if unknown."""
    if gain.is_unknown:
        return ()
    if gain.low > 0:
        return (
            f"joint, which trains on all data and learns {learned.value:.2f} of the targets, keeps more than "
            "sft at the same learning rate: learning alone need not degrade skills.",
        )
    less = "keeps even less than" if gain.high < 0 else "is not told apart from"
    return (
        f"joint, which trains on all data, {less} sft at the same learning rate: the records do not show "
        "that the missing constraint is the cause.",
    )


@claim(
    "C2",
    CONSFT,
    reported="over 20 points on average; the visible margins are +25, +20, +10 and +14, 17 in the mean "
    "(Table 2)",
    rule="An arm (consft with a tuned first temperature, or consft_calibrated) counts if 10 % of its weights "
    "before the last tenth of the schedule are between 0.01 and 0.9. Holds if the lower end of the "
    "difference in retained success to sft, each at its best settings, is at least 0.20 for an arm; holds in "
    "part if it is so only with both at the scenario's learning rate; does not hold if all upper ends of "
    "both comparisons are below 0.20 for both arms, counting or not. Cannot be shown here if no arm counts, "
    "or if sft certainly keeps more than 0.80 at both settings.",
    settled="2026-11-27T20:50Z",
    margin="0.20 of the retained success, the claim's own",
    scenarios=WITH_LIBERO,
)
def keeps_20_points_more(evidence: Evidence) -> Finding:
    """Keeps pretrained skills on average more than 20 points better than plain fine-tuning."""
    arms = arms_that_count(evidence)
    at_best = [retention_difference(evidence, arm, "sft") for arm in ARMS]
    at_one = [
        retention_difference(evidence, rung(arm, SCENARIO_RATE), rung("sft", SCENARIO_RATE)) for arm in ARMS
    ]
    sft = [evidence.metric("retention", label) for label in ("sft", rung("sft", SCENARIO_RATE))]
    counting = [figure for figure in at_best if figure.methods[0] in arms]
    counting_at_one = [
        figure for figure in at_one if figure.methods[0] in {rung(arm, SCENARIO_RATE) for arm in arms}
    ]
    every, keeps_too_much = [*at_best, *at_one], all(one.low > 0.80 for one in sft)
    verdict, of_all = _keeps_more(counting, counting_at_one, every), _keeps_more(at_best, at_one, every)
    best = best_first(counting or at_best)[0]
    if verdict == "holds":
        best = deciding(verdict, counting, 0.20)
    figures = (best, *(one for one in (*at_best, *at_one) if one is not best))
    controls = controls_of(evidence, best.methods[0])
    controls_at_one = controls_at_the_full_rate(evidence)
    arm = best.methods[0]
    alike = [retention_difference(evidence, arm, label) for label in sft_at_the_rate_of(evidence, arm)]
    shares = tuple(one(evidence, arm) for arm in ARMS for one in (share_between, share_afterwards))
    shown = (*sft, *alike, *controls, *controls_at_one, *shares)
    at_one_says = what_the_full_rate_says(best_first(at_one)[0], controls_at_one)
    may_hold = {"holds": counting, "holds in part": counting_at_one}.get(
        verdict, [*counting, *counting_at_one]
    )
    if not arms or keeps_too_much:
        reasons = [*inactive_reasons(evidence, arms), *([KEEPS_TOO_MUCH] if keeps_too_much else [])]
        if_they_did = if_all_counted(arms, "cannot be shown here", of_all) if not keeps_too_much else ()
        return cannot_be_shown(figures, shown, reasons, *if_they_did, *at_one_says)
    one_sided = ONE_SIDED if any(one.is_unknown for one in at_one) else ""
    return Finding(
        verdict,
        figures,
        shown,
        (
            *inactive_sentences(evidence),
            *if_all_counted(arms, verdict, of_all),
            *what_controls_say(best, controls, arms),
            *at_one_says,
        ),
        change_of_arms(verdict, may_hold, every, 0.20) + one_sided,
        about=ARMS,
    )


ONE_SIDED = " Without runs of both arms at the scenario's learning rate, the claim can hold, but not fail."
"""What C2 lacks on a board without these runs."""

KEEPS_TOO_MUCH = (
    "sft keeps too much for a gain of 0.20.",
    "A setting in which sft keeps less than 0.80.",
)
"""A reason why C2 cannot be shown, and what would remove it."""


def _keeps_more(at_best: Sequence[Figure], at_one: Sequence[Figure], every: Sequence[Figure]) -> Verdict:
    """Return the verdict on gains.

    Args:
        at_best: Gains of the arms that count at their best settings.
        at_one: Their gains at the scenario's learning rate.
        every: Both gains of all arms.
    """
    return decided(
        holds=any(one.low >= 0.20 for one in at_best),
        in_part=any(one.low >= 0.20 for one in at_one),
        fails=all(one.high < 0.20 for one in every),
    )


REPLAYS = ("experience_replay", "buffered_replay")
"""The kinds of replay that C3 compares with."""


@claim(
    "C3",
    CONSFT,
    reported="0.34 on prior tasks against 0.18 with 1:1 replay (pi0, LIBERO, Table 3)",
    rule="Holds if the lower end of the difference in retained success is at least -0.05 against each kind "
    "of replay with runs, for one of the arms of C2 that count, all at their best settings; does not hold if "
    "both arms, counting or not, have an upper end below -0.05 against one of them. Cannot be shown here if "
    "no arm counts. "
    "Replay draws from the demonstrations of the retained skills themselves, and the note has its tuned "
    "share; the paper compares with pretraining data at 1:1.",
    settled="2026-11-28T20:50Z",
    margin="0.05 of the retained success",
    scenarios=WITH_LIBERO,
)
def as_good_as_replay(evidence: Evidence) -> Finding:
    """As good as experience replay, without prior data."""
    replays = [one for one in REPLAYS if evidence.runs.get(one)] or REPLAYS
    every = {arm: [retention_difference(evidence, arm, replay) for replay in replays] for arm in ARMS}
    of_all, counting = _reaches(every.values(), every.values()), arms_that_count(evidence)
    arms = [every[arm] for arm in counting]
    if not arms:
        others = [figure for of_arm in every.values() for figure in of_arm[1:]]
        return without_an_arm(evidence, [of_arm[0] for of_arm in every.values()], others, of_all)
    verdict = _reaches(arms, every.values())
    holding = [arm[0].methods[0] for arm in arms if all(figure.low >= -0.05 for figure in arm)]
    others = [figure for arm in ARMS if arm not in counting for figure in every[arm]]
    sentences = [f"It holds for {' and '.join(holding)}."] if holding else []
    if verdict == "does not hold":
        failing = [min(arm, key=_upper_end) for arm in arms]
        sentences = [_keeps_fewer(evidence, figure) for figure in failing]
    return Finding(
        verdict,
        best_first([arm[0] for arm in arms]),
        (*chain.from_iterable(arm[1:] for arm in arms), *others),
        (*inactive_sentences(evidence), *if_all_counted(counting, verdict, of_all), *sentences),
        what_would_change(_deciding_replay(verdict, arms, list(every.values())), -0.05),
        about=ARMS,
    )


def _reaches(counting: Iterable[Sequence[Figure]], every: Iterable[Sequence[Figure]]) -> Verdict:
    """Return the verdict on the differences to both kinds of replay, of the arms that count and of all."""
    return decided(
        holds=any(all(figure.low >= -0.05 for figure in arm) for arm in counting),
        fails=all(any(figure.high < -0.05 for figure in arm) for arm in every),
    )


def _upper_end(figure: Figure) -> float:
    """Return the upper end of an interval, infinite if it is unknown."""
    return math.inf if math.isnan(figure.high) else figure.high


def _lower_end(figure: Figure) -> float:
    """Return the lower end of an interval, infinitely low if it is unknown."""
    return -math.inf if math.isnan(figure.low) else figure.low


def _deciding_replay(
    verdict: Verdict, counting: Sequence[Sequence[Figure]], every: Sequence[Sequence[Figure]]
) -> Figure:
    """Return the figure that decides C3, among the figures of each arm against each kind of replay.

    The lowest lower end of an arm decides whether it reaches replay, and its lowest upper end decides whether
    it fails.
    """
    if verdict == "does not hold":
        return max((min(arm, key=_upper_end) for arm in every), key=_upper_end)
    return max((min(arm, key=_lower_end) for arm in counting), key=_lower_end)


def _keeps_fewer(evidence: Evidence, figure: Figure) -> str:
    """Return the sentence that an arm certainly keeps fewer skills than a kind of replay."""
    arm, replay = figure.methods[:2]
    share = _share_of_replay(evidence) if replay == "experience_replay" else ""
    return f"{replay}{share} certainly keeps more skills than {arm}."


def _share_of_replay(evidence: Evidence) -> str:
    """Return which share of a batch experience replay draws from prior demonstrations, in words."""
    run = evidence.first_run("experience_replay")
    share: Any = run.record.run.settings.get("replay") if run else None
    if not is_number(share):
        return ""
    beyond = ", more than the paper's 1:1," if share > 0.5 else ""
    return f" with a share of {share:g} of each batch{beyond}"


@claim(
    "C4",
    CONSFT,
    reported="sparsity decays later and more evenly than with sft (Fig. 2, a curve without numbers); sft "
    "ends near 0.70, reinforcement learning near 0.85",
    rule="Update sparsity after the last target, each method at its best settings. Holds if the lower end "
    "of the difference to sft is above 0.05 for one of the arms of C2 that count; does not hold if the upper "
    "ends of both arms, counting or not, are below 0.05. Cannot be shown here if no arm counts, or if the "
    "measure does not notice much smaller steps, which are all that ConSFT can make (sft at 0.03 of the "
    "learning rate or, without such records, at a tuned rate of at most a tenth, less sft at the whole rate, "
    "has an upper end below 0.05).",
    settled="2026-11-29T01:25Z",
    margin="0.05 of the parameters",
)
def stays_sparse(evidence: Evidence) -> Finding:
    """Updates stay sparse."""
    every = {arm: _sparser(evidence, arm, "sft") for arm in ARMS}
    counting = arms_that_count(evidence)
    arms = [every[arm] for arm in counting]
    response = _sparser(evidence, _small_steps(evidence), rung("sft", SCENARIO_RATE))
    controls = (response, _sparser(evidence, "l2_sp", "sft"))
    insensitive = (
        f"Much smaller steps keep only {response.value:.3f} more of the weights in place: a method that "
        "makes steps smaller cannot change this measure.",
        "A measure of sparsity that responds to smaller steps.",
    )
    reasons = [insensitive] if response.high < 0.05 else []
    if not arms:
        return without_an_arm(evidence, list(every.values()), controls, None, *reasons)
    figures = best_first(arms)
    if reasons:
        every_reason = [*inactive_reasons(evidence, counting), *reasons]
        return cannot_be_shown(figures, controls, every_reason, about=ARMS)
    responds = response.high >= 0.05  # not known without records
    verdict, of_all = (
        rises_above(0.05, some, every.values()) if responds else "undecided"
        for some in (arms, every.values())
    )
    more = f"Smaller steps keep {response.value:.3f} more of the weights in place; weighing samples does not."
    return Finding(
        verdict,
        figures,
        (*controls, *(every[arm] for arm in ARMS if arm not in counting)),
        (
            *inactive_sentences(evidence),
            *if_all_counted(counting, verdict, of_all),
            *([more] if verdict == "does not hold" else []),
        ),
        change_of_arms(verdict, arms, list(every.values()), 0.05)
        if responds
        else what_would_change(response, 0.05),
        about=ARMS,
    )


def _sparser(evidence: Evidence, method: str, other: str) -> Figure:
    """Return how much sparser the updates of a method are than those of the other, after the last target."""
    return evidence.difference("update_sparsity", method, other, form=".3f")


def _small_steps(evidence: Evidence) -> str:
    """Return the label of plain fine-tuning with much smaller steps, the control of C4."""
    ladder, tuned = rung("sft", 0.03), evidence.first_run("sft")
    factor: Any = tuned.record.run.settings.get("step_factor") if tuned else None
    has_small_steps = is_number(factor) and factor <= 0.1
    return "sft" if ladder not in evidence.runs and has_small_steps else ladder


@claim(
    "C5",
    CONSFT,
    reported="risk times omega squared (Eq. 7), no measurement",
    rule="Holds by construction for one sample, while the test "
    "`test_one_sample_disrupts_old_knowledge_by_the_square_of_its_weight` of `tests/methods/test_consft.py` "
    "passes. No record can change it.",
    settled="2026-11-23T07:13Z",
    margin="none: an identity",
    scenarios=ANYWHERE,
    uncounted="algebra",
)
def risk_has_the_square_of_the_weight(evidence: Evidence) -> Finding:
    """The risk of one sample's gradient scales with the square of the sample's weight."""
    return Finding(
        "holds",
        (),
        (),
        (
            "The paper's risk of a gradient g is g'Fg, with the Fisher matrix F of the old knowledge. The "
            "weight is a factor of g, so the risk contains its square: by algebra, whatever the records say. "
            "This covers one sample. In a batch, weights can undo the cancellation of two gradients, so that "
            "the weighted mean disrupts more; and Adam nearly cancels a factor that all samples share.",
        ),
        "Nothing: it is algebra.",
        about=ARMS,
    )


@claim(
    "C6",
    CONSFT,
    reported="one exponential and one detached tensor per sample; no time measured",
    rule="Holds if bytes kept and parameters added equal those of sft, no prior data is read, and the upper "
    "end of a step's time is at most 1.05 times sft's; does not hold if bytes or parameters are more, if "
    "prior data is read, or if the lower end is above 1.05. Steps may be more: this is the cost of one.",
    settled="2026-11-26T20:19Z",
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
    reads = any(
        run.record.run.uses.get(kind, "never") != "never"
        for run in evidence.runs.get("consft", {}).values()
        for kind in PRIOR
    )
    more = reads or bytes_kept.value > bytes_of_sft.value or added.value > added_by_sft.value
    unknown = [one for one in (bytes_kept, bytes_of_sft, added, added_by_sft) if math.isnan(one.value)]
    change = what_would_change(*((unknown[0], 0.0) if unknown else (time, 1.05)))
    return Finding(
        decided(holds=same and not reads and time.high <= 1.05, fails=more or time.low > 1.05),
        (time, bytes_kept, added),
        (bytes_of_sft, added_by_sft),
        (),
        "Runs that keep, add and read no more than sft." if more else change,
    )
