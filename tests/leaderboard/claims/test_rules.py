"""The rules of the claims: every verdict follows from records."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from claims_bench import Bench
from stated_evidence import FORGETS, judged, shares

from clbench.base.entry_points import resolve
from clbench.records.record import Record
from clbench.scoring.intervals import Estimate

Figure = resolve("clbench.leaderboard.claims.evidence:Figure")
not_told_apart = resolve("clbench.leaderboard.claims.claim:not_told_apart")

Given = dict[str, dict[str, Any]]

SFT: Given = {"sft": {}, "sft@1": {}}
"""Plain fine-tuning that keeps .2 of the skills, at its tuned learning rate and at the scenario's."""
ACTIVE = {"1": {"omega_counts": [[5, 5, 0, 0, 0], [0, 5, 3, 1, 1]]}}
SAME = {"1": {"omega_counts": [[98, 1, 0, 0, 1], [60, 0, 0, 0, 40]]}}
"""Weights at the floor, or of 1."""
CO_TRAINING = "co_training+step_factor=1.0"
STEADY: Given = {"sft@1": {"took": (77, 77)}, CO_TRAINING: {"took": (49, 49)}}
"""The auxiliary objective saves steps, so that there is a capability for a vector to carry."""
VECTOR, AT_RANDOM = "fast_dvla@1", "fast_dvla+direction=random+step_factor=1.0"
NO_REGULARISER = "fast_dvla+orthogonal=0.0+step_factor=1.0"
LOSES: Given = {"sft": {"right": (500, 400)}, "frozen": {"right": (500, 500)}}
"""Plain fine-tuning forgets a fifth of the answers."""
KEEPS: Given = {"sft": {"right": (500, 500)}, "frozen": {"right": (500, 500)}}
IN_TIME: Given = {"sft": {"right": (500, 500), "took": (77, 77)}}
"""Its stages end at the criterion, before it forgets an answer."""


def _early_loss(record: Record) -> None:
    """Let the policy have lost the answers half way through the first stage."""
    rows = zip(record.answers["stage"], record.answers["step"], strict=True)
    record.answers["correct"][list(rows).index((1, 50))] = 400 + record.run.seed


def _shed(first: float, later: float) -> Callable[[Record], None]:
    """Return the edit that writes the mean energy shed in the first stage and in the second."""

    def edit(record: Record) -> None:
        for stage, value in (("1", first), ("2", later)):
            record.diagnostics[stage] = {"energy_shed_mean": value + 0.001 * record.run.seed}

    return edit


def _in_the_time_of_sft(record: Record) -> None:
    """Let a step take as long as one of plain fine-tuning, or nearly."""
    record.timing["step_ratio"] = 1.0 + 0.001 * record.run.seed


def _distances(*ends: Any) -> Callable[[Record], None]:
    """Return an edit of records: the distance of the batch to the anchor at the end, by seed."""

    def edit(record: Record) -> None:
        record.diagnostics = {"1": {"anchor_distance": [90.0 + record.run.seed, ends[record.run.seed]]}}

    return edit


AWAY = "aegis+direction=random"
DRIFTS: Given = {"sft": {"drift": (1.0, 1.1, 1.2)}, AWAY: {"edit": _distances(200, 290, 400)}}
SMALL_STEPS_COUNT: Given = {"sft@0.03": {"sparsity": 0.9}, "sft@1": {"sparsity": 0.3}}

CASES: list[tuple[str, str, Given]] = [
    ("C1", "holds", {"sft": {"kept": 0.2}}),
    ("C1", "does not hold", {"sft": {"kept": 1.0}}),
    ("C1", "undecided", {"sft": {"kept": 0.95}}),
    ("C2", "holds", {**SFT, "consft": {"kept": 0.8}, "consft_calibrated": {}}),
    (
        "C2",
        "does not hold",
        {**SFT, "consft": {}, "consft_calibrated": {}, "consft@1": {}, "consft_calibrated@1": {}},
    ),
    (
        "C2",
        "holds in part",
        {**SFT, "consft": {}, "consft_calibrated": {}, "consft@1": {}, "consft_calibrated@1": {"kept": 0.8}},
    ),
    ("C2", "undecided", {**SFT, "consft": {"kept": (0.0, 0.4, 0.8)}, "consft_calibrated": {}}),
    ("C2", "undecided", {"sft": {}, "consft": {}}),
    (
        "C2",
        "cannot be shown here",
        {
            "sft": {"kept": (0.95, 0.95, 1.0)},
            "sft@1": {"kept": (0.95, 1.0, 0.95)},
            "consft": {"kept": 1.0},
            "consft_calibrated": {"kept": 1.0},
        },
    ),
    (
        "C2",
        "cannot be shown here",
        {
            **SFT,
            "consft": {"kept": 0.8, "diagnostics": SAME},
            "consft_calibrated": {"kept": 0.8, "diagnostics": SAME},
        },
    ),
    (
        "C2",
        "undecided",
        {
            **SFT,
            "consft": {"kept": 0.8, "diagnostics": SAME},
            "consft_calibrated": {"diagnostics": ACTIVE},
        },
    ),
    (
        "C3",
        "holds",
        {
            "consft": {"kept": 1.0},
            "consft_calibrated": {},
            "experience_replay": {"kept": 1.0},
            "buffered_replay": {"kept": 1.0},
        },
    ),
    (
        "C3",
        "does not hold",
        {"consft": {}, "consft_calibrated": {}, "experience_replay": {"kept": 1.0}, "buffered_replay": {}},
    ),
    ("C3", "holds", {"consft": {"kept": 1.0}, "consft_calibrated": {}, "experience_replay": {}}),
    ("C3", "undecided", {"consft": {"kept": 1.0}, "consft_calibrated": {}}),
    (
        "C4",
        "holds",
        {
            **SMALL_STEPS_COUNT,
            "sft": {"sparsity": 0.3},
            "consft": {"sparsity": 0.5},
        },
    ),
    (
        "C4",
        "does not hold",
        {
            **SMALL_STEPS_COUNT,
            "sft": {"sparsity": 0.3},
            "consft": {"sparsity": 0.3},
            "consft_calibrated": {"sparsity": 0.3},
        },
    ),
    (
        "C4",
        "cannot be shown here",
        {
            "sft@0.03": {"sparsity": 0.3},
            "sft@1": {"sparsity": 0.3},
            "sft": {"sparsity": 0.3},
            "consft": {"sparsity": 0.5},
        },
    ),
    # without the ladder it is not known whether the measure responds
    (
        "C4",
        "undecided",
        {"sft": {"sparsity": 0.3}, "consft": {"sparsity": 0.3}, "consft_calibrated": {"sparsity": 0.3}},
    ),
    ("C4", "undecided", {"sft": {"sparsity": 0.3, "seeds": 1}, "consft": {"sparsity": 0.9, "seeds": 1}}),
    ("C6", "does not hold", {"sft": {}, "consft": {"costs": {"bytes_kept": 8}}}),
    ("C6", "undecided", {"sft": {}, "consft": {}}),
    ("C7", "holds", {"consft": {"earlier": 1.0}, "consft_calibrated": {"earlier": 0.4}}),
    ("C7", "does not hold", {"consft": {"earlier": 0.5}, "consft_calibrated": {"earlier": 0.4}}),
    # an arm whose samples all weigh the same shows nothing: it makes no claim hold or fail
    (
        "C7",
        "undecided",
        {"consft": {"earlier": 1.0, "diagnostics": SAME}, "consft_calibrated": {"earlier": 0.4}},
    ),
    ("C8", "holds", {"sft": {"displaced": 0.5}, "consft": {"displaced": 0.8}}),
    (
        "C8",
        "does not hold",
        {"sft": {"displaced": 0.5}, "consft": {"displaced": 0.5}, "consft_calibrated": {"displaced": 0.45}},
    ),
    ("C8", "cannot be shown here", {"sft": {"displaced": 1.0}, "consft": {"displaced": 1.0}}),
    ("C8", "undecided", {"sft": {}, "consft": {}}),
    ("A1", "holds", {"sft": {"right": (500, 400), "edit": _early_loss}}),
    ("A1", "holds in part", LOSES),
    ("A1", "does not hold", KEEPS),
    ("A1", "undecided", {"sft": {"right": (490, 485)}}),
    ("A2", "holds", {**LOSES, "stop_gradient": {"right": (500, 500), "curve": 0.1}}),
    ("A2", "does not hold", {**LOSES, "stop_gradient": {"right": (500, 500)}}),
    ("A2", "does not hold", {**LOSES, "stop_gradient": {"right": (490, 300), "curve": 0.1}}),
    ("A2", "cannot be shown here", {**KEEPS, "stop_gradient": {"right": (500, 500), "curve": 0.1}}),
    ("A2", "undecided", {"stop_gradient": {"right": (500, 500), "curve": 0.1}}),
    ("A2", "holds in part", {**IN_TIME, "sft@1": {"took": (39, 39)}, "stop_gradient@1": {"took": (77, 77)}}),
    ("A2", "does not hold", {**IN_TIME, "sft@1": {"took": (77, 77)}, "stop_gradient@1": {"took": (39, 39)}}),
    (
        "A2",
        "cannot be shown here",
        {**IN_TIME, "sft@1": {"took": (77, 77)}, "stop_gradient@1": {"took": (77, 77)}},
    ),
    ("A3", "holds", {**LOSES, "lora": {}, "lora+rank=4": {}, "lora+rank=64": {}}),
    ("A3", "holds in part", {**LOSES, "lora": {}, "lora+rank=4": {"right": (500, 500)}, "lora+rank=64": {}}),
    (
        "A3",
        "does not hold",
        {
            "frozen": {"right": (500, 500), "kept": 0.2},
            "lora": {"right": (500, 500)},
            "lora+rank=4": {"right": (500, 500)},
            "lora+rank=64": {"right": (500, 500)},
        },
    ),
    ("A3", "undecided", {"lora": {}}),
    ("A4", "holds", {**LOSES, "aegis": {"right": (500, 500)}}),
    ("A4", "does not hold", {**LOSES, "aegis": {"right": (500, 450)}}),
    ("A4", "cannot be shown here", {**KEEPS, "aegis": {"right": (500, 500)}}),
    ("A4", "undecided", {**LOSES, "frozen": {"right": (500, 490)}, "aegis": {"right": (500, 486)}}),
    ("A5", "holds", {"aegis": {"edit": _shed(0.002, 0.06)}}),
    ("A5", "does not hold", {"aegis": {"edit": _shed(0.06, 0.002)}}),
    ("A5", "undecided", {"aegis": {"edit": _shed(0.009, 0.002)}}),
    ("A5", "undecided", {"aegis": {"diagnostics": {"1": {"energy_shed_mean": "little"}}}}),
    ("A6", "holds", {**DRIFTS, "aegis": {"drift": 0.1, "edit": _distances(2, 3, 4)}}),
    ("A6", "holds in part", {**DRIFTS, "aegis": {"drift": 1.0, "edit": _distances(2, 3, 4)}}),
    (
        "A6",
        "does not hold",
        {"aegis": {"edit": _distances(190, 300, 390)}, AWAY: {"edit": _distances(200, 290, 400)}},
    ),
    (
        "A6",
        "undecided",
        {"aegis": {"edit": _distances(2, 290, 4)}, AWAY: {"edit": _distances(200, 290, 400)}},
    ),
    ("F1", "undecided", STEADY),  # the time of a step is not known
    ("F1", "holds in part", {**STEADY, CO_TRAINING: {"took": (49, 49), "edit": _in_the_time_of_sft}}),
    ("F1", "undecided", {"sft@1": {"took": (77, 77)}}),
    ("F2", "holds", {**STEADY, VECTOR: {"took": (39, 39)}, AT_RANDOM: {"took": (77, 77)}}),
    ("F2", "does not hold", {**STEADY, VECTOR: {"took": (49, 49)}, AT_RANDOM: {"took": (39, 39)}}),
    (
        "F2",
        "cannot be shown here",
        {**STEADY, CO_TRAINING: {"took": (96, 96)}, VECTOR: {"took": (39, 39)}},
    ),
    ("F2", "undecided", {**STEADY, VECTOR: {"took": (39, 39)}}),
    ("F3", "holds", {**STEADY, VECTOR: {"took": (39, 39)}, NO_REGULARISER: {"took": (49, 49)}}),
    ("F3", "does not hold", {**STEADY, VECTOR: {"took": (49, 49)}, NO_REGULARISER: {"took": (39, 39)}}),
    ("F5", "holds", {**STEADY, VECTOR: {"took": (39, 39)}, AT_RANDOM: {"took": (49, 49)}}),
    ("F5", "does not hold", {**STEADY, VECTOR: {"took": (49, 49)}, AT_RANDOM: {"took": (39, 39)}}),
]


@pytest.mark.parametrize(
    ("identifier", "verdict", "given"),
    CASES,
    ids=[f"{identifier}-{verdict}-{number}" for number, (identifier, verdict, _) in enumerate(CASES)],
)
def test_a_verdict_follows_from_the_records_by_the_rule(
    identifier: str, verdict: str, given: Given, bench: Bench
) -> None:
    for label, values in given.items():
        bench.add(label, **values)
    assert bench.judge(identifier).verdict == verdict


def test_an_objective_that_the_policy_knows_already_cannot_show_what_it_adds(bench: Bench) -> None:
    bench.add("sft@1", took=(77, 77), right=(500, 499))
    for label in ("co_training+step_factor=1.0", VECTOR, AT_RANDOM, NO_REGULARISER):
        bench.add(label, took=(96, 96))
    for identifier in ("F1", "F2", "F3", "F5"):
        finding = bench.judge(identifier)
        assert finding.verdict == "cannot be shown here"
        assert "is a part of the pretraining, and sft does not certainly lose 0.01" in finding.sentences[0]


@pytest.mark.parametrize(
    ("joint", "says"),
    [
        (0.9, "joint, which trains on all data and learns 1.00 of the targets, keeps more than sft at "),
        ((0.1, 0.4, 0.8), "joint, which trains on all data, is not told apart from sft at the same "),
        (0.0, "joint, which trains on all data, keeps even less than sft at the same learning rate: "),
    ],
)
def test_skills_that_joint_training_loses_too_are_not_put_down_to_the_missing_constraint(
    joint: Any, says: str, bench: Bench
) -> None:
    bench.add("sft", kept=0.9)  # at a smaller rate, which joint does not have
    bench.add("sft@1", kept=0.4)
    bench.add("joint", kept=joint)
    (sentence,) = bench.judge("C1").sentences
    assert sentence.startswith(says)


@pytest.mark.parametrize(("best", "said"), [((-0.02, 0.4), True), ((0.051, 0.4), False)])
def test_a_loss_that_only_the_best_learning_rate_leaves_open_is_told(
    best: tuple[float, float], said: bool
) -> None:
    drop = "retained success, pretrained - {} after the last target"
    finding = judged("C1", {drop.format("sft"): best, drop.format("sft@1"): (0.3, 0.8)})
    assert finding.change.endswith("at that rate, sft certainly loses more than 0.05.") is said


def test_an_arm_that_does_not_count_is_shown_with_the_verdict_that_it_would_give(bench: Bench) -> None:
    bench.add("sft", earlier=0.4)
    bench.add("consft", earlier=1.0, diagnostics=SAME)
    bench.add("consft_calibrated", earlier=0.4, diagnostics=ACTIVE)
    finding = bench.judge("C7")
    assert finding.verdict == "undecided"
    assert 'If consft counted, the verdict would be "holds".' in finding.sentences
    (same,) = [one for one in bench.judge("C2").sentences if one.startswith("If consft counted")]
    assert same == "If consft counted, the verdict would be the same."
    assert {one.methods for one in finding.controls} >= {("consft",), ("consft", "sft")}


def test_small_steps_that_the_measure_hardly_notices_are_told_with_their_difference(bench: Bench) -> None:
    bench.add("sft@0.03", sparsity=0.52)
    bench.add("sft@1", sparsity=0.5)
    bench.add("sft", sparsity=0.5)
    bench.add("consft", sparsity=0.5, diagnostics=ACTIVE)
    assert "Much smaller steps keep only 0.020 more of the weights in place" in " ".join(
        bench.judge("C4").sentences
    )


def test_what_would_change_a_rapid_loss_is_the_point_that_shows_it(bench: Bench) -> None:
    bench.add("sft", right=(500, 400), edit=_early_loss)
    finding = bench.judge("A1")
    assert finding.verdict == "holds"
    assert "sft after 50 steps of the first target" in finding.change


def test_the_distance_to_the_anchor_is_that_of_the_same_seed_with_a_random_direction(bench: Bench) -> None:
    bench.add("sft", drift=(1.0, 1.1, 1.2), right=(500, 400))
    bench.add("aegis", drift=0.9, edit=_distances(2.0, 1.1, 7.2))
    bench.add(AWAY, edit=_distances(200.0, 100.0, 800.0))
    finding = bench.judge("A6")
    near, drift = finding.figures
    assert finding.verdict == "holds in part"
    assert near.value == pytest.approx((0.010 * 0.011 * 0.009) ** (1 / 6))
    on_questions, begins = finding.sentences
    assert "their distance to the anchor is 9.5 even before the first step. It ends at 1.7." in begins
    assert "move 0.91 [0." in on_questions
    assert drift.value == pytest.approx((0.9 / (1.0 * 1.1 * 1.2) ** (1 / 3)) ** 0.5, abs=0.001)
    bench.add("frozen")
    (acts,) = (
        one for one in bench.judge("A4").sentences if one.startswith("The projection acts: at the end")
    )
    assert f"is 0.100 [{near.low:.3f}, {near.high:.3f}] of that with" in acts


@pytest.mark.parametrize("ends", [(250.0, 110.0, 700.0), (0.0, 1.0, 8.0), ("2", 1.0, 8.0)])
def test_a_distance_that_is_not_certainly_smaller_or_no_number_says_nothing(
    bench: Bench, ends: tuple[Any, ...]
) -> None:
    bench.add("sft", right=(500, 400))
    bench.add("frozen")
    bench.add("aegis", edit=_distances(*ends))
    bench.add(AWAY, edit=_distances(200.0, 100.0, 800.0))
    assert bench.judge("A6").verdict != "holds"
    assert not any("projection acts" in one for one in bench.judge("A4").sentences)


def test_the_seeds_in_which_aegis_sheds_little_are_counted(bench: Bench) -> None:
    def shed(record: Record) -> None:
        record.diagnostics["1"] = {"energy_shed_mean": 0.004 + 0.05 * (record.run.seed == 2)}

    bench.add("aegis", edit=shed)
    assert bench.judge("A5").sentences == (
        "The share of the first stage is below 1 % in 2 of 3 seeds; the largest is 5.40%.",
    )


@pytest.mark.parametrize(
    ("low", "high", "says"),
    [
        (0.01, 0.20, "finch does not reach consft: it takes weights."),
        (-0.10, 0.10, "finch is not told apart from consft: a learning rate suffices."),
        (-0.20, -0.01, "finch is even better than consft: a learning rate suffices."),
        (math.nan, math.nan, "The records cannot show what finch says about consft."),
    ],
)
def test_what_a_control_says_follows_from_the_interval_of_the_gain(
    low: float, high: float, says: str
) -> None:
    gain = Figure("kept", ("consft", "finch"), Estimate((low + high) / 2, low, high))
    assert not_told_apart(gain, explains="a learning rate suffices", does_not="it takes weights") == says


def test_an_objective_that_may_save_steps_does_not_keep_a_vector_from_being_judged() -> None:
    given = {
        f"steps to the criterion, {CO_TRAINING} / sft@1": (0.949, 1.2),
        f"steps to the criterion, {VECTOR} / {NO_REGULARISER}": (0.5, 0.949),
    }
    assert judged("F3", {**FORGETS, **given}).verdict == "holds"


CONTROLS = ("constant_weight", "shuffled_weights", "finch")
TRANSFER = "backward transfer, consft - {}"
GAINS: dict[str, Any] = {
    **shares(0.1, 0.1),
    "backward transfer of consft": (0.0, 0.1),
    "backward transfer of consft_calibrated": (-0.4, -0.2),
    TRANSFER.format("sft"): (0.01, 0.2),
}


@pytest.mark.parametrize(
    ("controls", "says"),
    [
        (
            dict.fromkeys(CONTROLS, (0.01, 0.2)),
            "sft does not reach consft: weighing samples keeps earlier",
        ),
        ({}, "is not known without an interval for constant_weight, shuffled_weights and finch."),
        (
            {"finch": (0.01, 0.2)},
            "is not known without an interval for constant_weight and shuffled_weights.",
        ),
        ({"finch": (-0.1, 0.2)}, "but finch does not: weighing samples need not be the cause."),
    ],
)
def test_weights_keep_targets_only_if_no_control_does_and_none_is_missing(
    controls: dict[str, Any], says: str
) -> None:
    given = {**GAINS, **{TRANSFER.format(name): ends for name, ends in controls.items()}}
    finding = judged("C7", given, {name: {0: None} for name in controls})
    assert says in finding.sentences[-1]


def test_nothing_explains_a_gain_that_is_not_known() -> None:
    given = {**shares(0.1, 0.1), "retained success, consft_calibrated - constant_weight": (0.1, 0.2)}
    assert judged("C2", given).sentences == ("The records cannot show whether consft keeps more than sft.",)
