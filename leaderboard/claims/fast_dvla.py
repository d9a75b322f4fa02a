"""The claims of Fast-dVLA, each with its rule; docs/history.md says which rules changed, and why.

Fast-dVLA has the abstract of CapVector; most claims here are CapVector's. Its claims are about how fast and
how well a policy adapts. With stages to a criterion, all methods learn equally well, so the rules compare
steps.
"""

from __future__ import annotations

from collections.abc import Sequence

from clbench.scoring.intervals import NO_ESTIMATE, Estimate

from ..policies.decoders import Decoding, read_decoding
from .claim import (
    ANYWHERE,
    Finding,
    Paper,
    Verdict,
    cannot_be_shown,
    claim,
    decided,
    is_open,
    what_would_change,
)
from .evidence import Evidence, Figure, rung
from .figures import SCENARIO_RATE, loses_no_answers, median_stage, question_drop, share_of_steps

CAPVECTOR = Paper("CapVector (the abstract of Fast-dVLA)", ("2603.25661", "2605.10903"))
FAST_DVLA = Paper("Fast-dVLA's body", ("2603.25661",))

SFT = rung("sft", SCENARIO_RATE)
VECTOR = rung("fast_dvla", SCENARIO_RATE)
CO_TRAINING = f"co_training+step_factor={SCENARIO_RATE}"
AT_RANDOM = f"fast_dvla+direction=random+step_factor={SCENARIO_RATE}"
NO_REGULARISER = f"fast_dvla+orthogonal=0.0+step_factor={SCENARIO_RATE}"

NO_CAPABILITY = (
    "The auxiliary objective certainly saves less than 5 % of the steps, so it gives no faster learning that "
    "a vector could carry."
)
KNOWN = (
    "The auxiliary objective, to answer questions, is a part of the pretraining, and sft does not certainly "
    "lose 0.01 of the answers"
)
A_CAPABILITY = "An auxiliary objective that speeds up learning, or a policy that lacks it."


FEWEST_STEPS = 20
"""Median steps of a stage of sft at which 5 % of the steps are one whole step."""

TOO_SHORT = "5 % of the steps of sft's median stage is less than one step."
LONGER = "Targets that take plain fine-tuning at least 20 steps at the scenario's learning rate."


def _is_too_short(stage: Figure, steps: Figure) -> bool:
    """Return whether stages are too short for the open question of whether 5 % of the steps are saved."""
    return stage.value < FEWEST_STEPS and is_open(steps, 0.95) and not steps.is_unknown


def _no_capability(evidence: Evidence) -> bool:
    """Return whether the records show that the auxiliary objective itself does not help."""
    return share_of_steps(evidence, CO_TRAINING, SFT).low > 0.95


def _why_known(evidence: Evidence) -> str:
    """Return why a board says nothing about an objective that the policy knows, and if it helps there."""
    if not _no_capability(evidence):
        return f"{KNOWN}: whether the objective could add anything here is open."
    return (
        f"{KNOWN}. Here the objective certainly saves less than 5 % of the steps; whether it would help a "
        "policy that lacks it is open."
    )


def _not_shown(evidence: Evidence, figures: Sequence[Figure], *controls: Figure) -> Finding | None:
    """Return the finding on a board that could not show the saved steps, the first figure; else None.

    Without an interval of the answers that sft loses, the finding is undecided.
    """
    stage, answers = median_stage(evidence, SFT), question_drop(evidence, SFT)
    reasons = [(TOO_SHORT, LONGER)] if _is_too_short(stage, figures[0]) else []
    reasons += [(_why_known(evidence), A_CAPABILITY)] if loses_no_answers(answers) else []
    if reasons:
        return cannot_be_shown(figures, (*controls, stage, answers), reasons)
    if answers.is_unknown:
        return Finding("undecided", tuple(figures), controls, (), what_would_change(answers, 0.01))
    return None


def _no_vector(evidence: Evidence, figure: Figure, *controls: Figure) -> Finding | None:
    """Return the finding on a board that could not show what a vector saves, else None."""
    if not_shown := _not_shown(evidence, (figure,), *controls):
        return not_shown
    if _no_capability(evidence):
        return cannot_be_shown((figure,), controls, [(NO_CAPABILITY, A_CAPABILITY)])
    return None


@claim(
    "F1",
    CAPVECTOR,
    reported="LIBERO 87.5 with the auxiliary objective, 82.1 without, after 5,000 steps; 28 % more compute",
    rule="Steps to the criterion at the scenario's learning rate, co_training divided by sft. Holds if the "
    "upper end is below 0.95 and the lower end of a step's time is above 1.1 times sft's; holds in part if "
    "only the first; does not hold if the lower end of the steps is above 0.95. Cannot be shown here if "
    "the interval contains 0.95 and sft's median stage is shorter than 20 steps, of which 5 % is no whole "
    "step, or if sft does not certainly lose 0.01 of the answers: the objective, to answer questions, is "
    "then known already.",
    settled="2026-11-28T20:50Z",
    margin="5 % of the steps, 10 % of the time",
)
def auxiliary_objective_helps(evidence: Evidence) -> Finding:
    """Plain fine-tuning adapts poorly; an auxiliary objective helps but is expensive."""
    steps, time = share_of_steps(evidence, CO_TRAINING, SFT), evidence.step_time(CO_TRAINING)
    helps, costs, no_help = steps.high < 0.95, time.low > 1.1, steps.low > 0.95
    if not_shown := _not_shown(evidence, (steps, time)):
        return not_shown
    whether = "It helps." if helps else "It does not help." if no_help else "Whether it helps is open."
    more = ["The steps to the criterion certainly cost more time in all."] if time.low * steps.low > 1 else []
    return Finding(
        decided(holds=helps and costs, in_part=helps and not time.is_unknown, fails=no_help),
        (steps, time),
        (median_stage(evidence, SFT),),
        () if steps.is_unknown else (whether, *more),
        what_would_change(*((time, 1.1) if helps and not costs else (steps, 0.95))),
    )


@claim(
    "F2",
    CAPVECTOR,
    reported="LIBERO 90.1 with the vector (91.7 with the regulariser as well, as here), 87.5 with the "
    "auxiliary objective, 82.1 with neither, after 5,000 steps (Table 1)",
    rule="Steps to the criterion at the scenario's learning rate. Holds if the upper ends of fast_dvla "
    "divided by sft and by a random vector of equal norms are below 0.95, and that divided by co_training, "
    "whose objective it replaces, is below 1.05; does not hold if the lower end of one of the first two is "
    "above 0.95, or that of the third above 1.05. Cannot be shown here for the reasons of F1, or if "
    "co_training certainly saves less than 5 % of the steps.",
    settled="2026-11-29T01:25Z",
    margin="5 % of the steps",
)
def vector_carries_the_capability(evidence: Evidence) -> Finding:
    """The difference between two trainings on a few tasks is a vector; merged, it replaces the objective."""
    over_sft, over_random = _of_the_vector(evidence)
    over_objective = share_of_steps(evidence, VECTOR, CO_TRAINING)
    controls = (over_random, over_objective, share_of_steps(evidence, CO_TRAINING, SFT))
    if not_shown := _no_vector(evidence, over_sft, *controls):
        return not_shown
    verdict, change = _all_below((over_sft, 0.95), (over_random, 0.95), (over_objective, 1.05))
    return Finding(verdict, (over_sft,), controls, (), change)


def _all_below(*bars: tuple[Figure, float]) -> tuple[Verdict, str]:
    """Return the verdict of a rule whose figures must all be below their bars, and what would change it."""
    failing = [(figure, bar) for figure, bar in bars if figure.low > bar]
    not_below = [(figure, bar) for figure, bar in bars if not figure.high < bar]
    verdict = decided(holds=not not_below, fails=bool(failing))
    return verdict, what_would_change(*(failing or not_below or bars)[0])


def _of_the_vector(evidence: Evidence) -> tuple[Figure, Figure]:
    """Return the steps of fast_dvla divided by those of sft, and by those with a random vector."""
    return share_of_steps(evidence, VECTOR, SFT), share_of_steps(evidence, VECTOR, AT_RANDOM)


@claim(
    "F3",
    CAPVECTOR,
    reported="LIBERO 90.1 without and 91.7 with it after 5,000 steps; +0.5 to +0.9 later (Table 1)",
    rule="Steps to the criterion at the scenario's learning rate, with the regulariser divided by without. "
    "Holds if the upper end is below 0.95; does not hold if the lower end is above 0.95. Cannot be shown "
    "here for the reasons of F1, or if co_training certainly saves less than 5 % of the steps.",
    settled="2026-11-28T20:50Z",
    margin="5 % of the steps",
)
def regulariser_keeps_the_vector(evidence: Evidence) -> Finding:
    """The orthogonal regulariser keeps the merged capability."""
    steps = share_of_steps(evidence, VECTOR, NO_REGULARISER)
    auxiliary = share_of_steps(evidence, CO_TRAINING, SFT)
    if not_shown := _no_vector(evidence, steps, auxiliary):
        return not_shown
    return Finding(
        decided(holds=steps.high < 0.95, fails=steps.low > 0.95),
        (steps,),
        (auxiliary,),
        (),
        what_would_change(steps, 0.95),
    )


@claim(
    "F4",
    CAPVECTOR,
    reported="less than 0.8 % more compute and memory, without the cost of making the vectors",
    rule="Holds if the upper end of a step's time is at most 1.05 times sft's; does not hold if the lower "
    "end is above 1.05. The preparation and the bytes kept are shown, and not judged.",
    settled="2026-11-23T07:13Z",
    margin="5 % of the time of a step",
    scenarios=ANYWHERE,
)
def costs_little(evidence: Evidence) -> Finding:
    """The cost is near that of plain fine-tuning."""
    time = evidence.step_time("fast_dvla")
    return Finding(
        decided(holds=time.high <= 1.05, fails=time.low > 1.05),
        (
            time,
            evidence.share_of_preparation("fast_dvla"),
            evidence.cost("bytes_kept", "fast_dvla", "bytes kept of fast_dvla"),
        ),
        change=what_would_change(time, 1.05),
    )


@claim(
    "F5",
    CAPVECTOR,
    reported="RoboTwin 31.8, 23.7 and 9.4 with vectors of three LIBERO suites, 6.7 without (Table 2)",
    rule="The vector is made from the retained skills and used on the targets. Steps to the criterion at "
    "the scenario's learning rate: holds if the upper ends of fast_dvla divided by sft and by a random "
    "vector of equal norms are below 0.95; does not hold if the lower end of one is above. Cannot be shown "
    "here for the reasons of F1, or if co_training certainly saves less than 5 % of the steps.",
    settled="2026-11-30T06:10Z",
    margin="5 % of the steps",
)
def vector_transfers(evidence: Evidence) -> Finding:
    """The vector transfers to tasks other than those it was made from."""
    over_sft, over_random = _of_the_vector(evidence)
    if not_shown := _no_vector(evidence, over_random, over_sft):
        return not_shown
    verdict, change = _all_below((over_random, 0.95), (over_sft, 0.95))
    return Finding(verdict, (over_random,), (over_sft,), (), change)


@claim(
    "F6",
    FAST_DVLA,
    reported="2.65 to 4.0 times the speed of the same model without it (4.1 is relative to another model), "
    "at equal success; 30 Hz on a robot",
    rule="One chunk at a time, the fastest pipeline of a distilled student against easy-first decoding in "
    "12 forwards. Holds if the lower end of the speed-up is at least 2.65 and that of the difference in "
    "success at least -0.03; does not hold if one of the upper ends is below. Cannot be shown here if one "
    "forward succeeds as often as 12 (there is nothing to speed up), or if a forward of all tokens takes "
    "less than 1.5 times as long as one of a block (the time is then that of forwards, whatever their "
    "tokens).",
    settled="2026-11-28T20:50Z",
    margin="a speed-up of 2.65, 0.03 of success",
    scenarios=ANYWHERE,
)
def decodes_faster(evidence: Evidence) -> Finding:
    """A discrete-diffusion policy decodes 2.65 to 4.0 times faster at equal success."""
    found = read_decoding()
    if found is None or found.scenario != evidence.scenario:
        how = f"measured on {found.scenario} alone" if found else "python benchmarks/decoding.py measures it"
        missing = Figure("speed-up of the pipeline", (), NO_ESTIMATE, note=how)
        return Finding("undecided", (missing,), change=what_would_change(missing, LEAST_SPEED_UP))
    best, least = found.best_pipeline, found.widths[min(found.widths)]
    pooled = f"interval over {found.episodes} episodes of {found.seeds} policies, pooled"
    speed = Figure(f"speed-up of the {best.name}", (), best.speed_up, note="one policy on one machine")
    success = Figure(f"success, {best.name} - easy first", (), best.difference, note=pooled)
    forward = Figure("time of a forward of all tokens / of a block", (), least["forward"], note=ONE_STEP)
    holds = speed.low >= LEAST_SPEED_UP and success.low >= -MOST_LOSS
    fails = speed.high < LEAST_SPEED_UP or success.high < -MOST_LOSS
    figures = (speed, success)
    single = min(found.decoders, key=lambda one: one.forwards)
    at_once = Figure(f"success, {single.name} - easy first", (), single.difference, note=pooled)
    controls = (at_once, forward, *_counts(found))
    reasons = []
    if single.forwards <= 1 and at_once.low >= -MOST_LOSS:
        reasons.append((AS_GOOD, HARDER))
    if forward.high < LEAST_RATIO:
        reasons.append((AS_LONG, WIDER))
    if reasons:
        return cannot_be_shown(figures, controls, reasons, PEER)
    bars = ((speed, LEAST_SPEED_UP), (success, -MOST_LOSS))
    judged = [(one, bar) for one, bar in bars if one.high < bar] or [
        (one, bar) for one, bar in bars if is_open(one, bar)
    ]
    verdict = decided(holds=holds, fails=fails)
    return Finding(verdict, figures, controls, (PEER,), what_would_change(*(judged or bars)[0]))


LEAST_SPEED_UP, MOST_LOSS, LEAST_RATIO = 2.65, 0.03, 1.5
"""The bars of F6: speed-up, loss of success, and how much longer a forward of all tokens must take."""

PEER = (
    "The decoder that it is compared with reads the observation once for a chunk, as the pipeline does. The "
    "paper's base models read it in every forward: the part of its speed-up that comes from keeping the "
    "observation is not in this figure."
)

ONE_STEP = "blocks of one step"
"""What the benchmark measures for each width. The fastest pipeline has longer blocks: a forward of one takes
longer."""

AS_GOOD = "One forward pass certainly succeeds at most 0.03 less often than 12: there is nothing to speed up."
AS_LONG = "A forward pass takes as long for all tokens as for a block: only fewer passes save time here."
HARDER = "Tasks on which decoding in one forward pass fails."
WIDER = "A policy that is wide enough for the time of a forward pass to grow with its tokens."


def _counts(found: Decoding) -> tuple[Figure, ...]:
    """Return what does not depend on the machine, and what the heads of wider policies would gain."""
    first, best = found.decoders[0], found.best_pipeline
    tokens = first.tokens / best.tokens
    widths = (
        Figure(
            f"speed-up of the head alone at width {width}, initial weights",
            (),
            ratios["chunk"],
            note=ONE_STEP,
        )
        for width, ratios in found.widths.items()
    )
    return (
        Figure(f"tokens in all forwards, easy first / {best.name}", (), Estimate(tokens, None, None)),
        Figure("chunks per second", (), Estimate(1000 / best.milliseconds, None, None), form=".0f"),
        *widths,
    )
