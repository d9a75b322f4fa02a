"""The metrics of the leaderboard against matrices worked by hand and against plain loops."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from clbench.records.reader import RecordError
from clbench.records.record import Relearning
from clbench.scoring.metrics import METRICS, measure
from clbench.scoring.scores import Scores

MODULE = "clbench.scoring.ours"

# Two skills, two targets, one task held out; the rows are the pretrained policy and the ends of two stages.
MATRIX = [
    [1.0, 0.8, 0.1, 0.0, 0.2],
    [0.6, 0.9, 0.9, 0.2, 0.3],
    [0.5, 0.4, 0.3, 0.8, 0.1],
]
BY_HAND = {
    "final_average": (0.5 + 0.4 + 0.3 + 0.8) / 4,
    "adaptation": (0.9 + 0.8) / 2,
    "retention": (0.5 + 0.4) / 2,
    "forgetting": ((1.0 - 0.5) + (0.9 - 0.4) + (0.9 - 0.3)) / 3,
    "backward_transfer": 0.3 - 0.9,
    "zero_shot": 0.1,
    "kept_targets": 0.3,
    "kept": (0.5 + 0.4 + 0.3) / 3,
    "kept_skills_over_stages": ((0.6 + 0.9) / 2 + (0.5 + 0.4) / 2) / 2,
    "kept_targets_over_stages": 0.3,
    "kept_over_stages": ((0.6 + 0.9) / 2 + (0.5 + 0.4 + 0.3) / 3) / 2,
    "kept_share": ((0.6 + 0.9) / (1.0 + 0.8) + (0.5 + 0.4 + 0.3) / (0.6 + 0.9 + 0.9)) / 2,
}


KEPT_SKILLS = ("kept_skills_over_stages", "kept_over_stages", "kept_share")
"""Metrics of the skills at the ends of all stages."""


@pytest.mark.parametrize("name", BY_HAND)
def test_a_metric_has_the_value_worked_out_by_hand(name: str, scores: Callable[..., Scores]) -> None:
    assert measure(name, scores(MATRIX)) == pytest.approx(BY_HAND[name])


def test_every_metric_of_the_leaderboard_is_worked_out_by_hand() -> None:
    others = {"forward_transfer", "question_retention"}
    others |= {"perturbed_retention", "perturbed_adaptation", "update_sparsity", "activation_drift"}
    others |= {
        "gain",
        "criterion_met",
        "steps_to_criterion",
        "speed",
        "shift",
        "relearning_steps",
        "instruction_capture",
    }
    found = {name for name, metric in METRICS.items() if metric.function.__module__ == MODULE}
    assert {*BY_HAND, *others} == found


def test_perturbed_success_has_the_values_worked_out_by_hand(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, perturbed=[[0.9, 0.7], [0.5, 0.8], [0.4, 0.2]], perturbed_learned=[0.6, 0.3])
    assert measure("perturbed_retention", run) == pytest.approx((0.4 + 0.2) / 2)
    assert measure("perturbed_adaptation", run) == pytest.approx((0.6 + 0.3) / 2)
    assert measure("retention", run) == pytest.approx(BY_HAND["retention"])
    assert measure("perturbed_retention", scores(MATRIX)) is None
    assert measure("perturbed_adaptation", scores(MATRIX)) is None


def test_gain_is_the_final_average_beyond_that_of_plain_fine_tuning(scores: Callable[..., Scores]) -> None:
    sft = scores([[1.0] * 5, [0.5] * 5, [0.2, 0.4, 0.0, 0.6, 1.0]])
    expected = BY_HAND["final_average"] - (0.2 + 0.4 + 0.0 + 0.6) / 4
    assert measure("gain", scores(MATRIX), {"sft": sft}) == pytest.approx(expected)
    assert measure("gain", scores(MATRIX)) is None


def test_steps_to_the_criterion_count_a_stage_that_never_met_it_with_all_its_steps(
    scores: Callable[..., Scores],
) -> None:
    run, scratch = (scores(MATRIX, steps=(100,), ends=ends) for ends in ((8, 0), (100, 25)))
    assert measure("steps_to_criterion", run) == (8 + 0) / 2
    assert measure("steps_to_criterion", scratch) == (100 + 25) / 2
    assert (measure("criterion_met", run), measure("criterion_met", scratch)) == (1, 0.5)
    assert measure("speed", run, {"from_scratch": scratch}) == pytest.approx((100 / 8 * 25 / 1) ** 0.5)


def test_no_step_counts_as_one_also_if_learning_from_scratch_took_none(scores: Callable[..., Scores]) -> None:
    run, scratch = (scores(MATRIX, steps=(100,), ends=ends) for ends in ((8, 10), (0, 25)))
    assert measure("speed", run, {"from_scratch": scratch}) == pytest.approx((1 / 8 * 25 / 10) ** 0.5)


def test_a_run_that_learned_one_target_in_four_has_a_speed_and_one_that_learned_none_has_none(
    scores: Callable[..., Scores],
) -> None:
    matrix = np.full((5, 6), 0.5)
    one, none, scratch = (
        scores(matrix, groups=(1, 4, 1), steps=(100,), ends=ends)
        for ends in ((8, 100, 100, 100), (100,) * 4, (39, 39, 39, 39))
    )
    speed = (39 / 8 * (39 / 100) ** 3) ** (1 / 4)
    assert measure("speed", one, {"from_scratch": scratch}) == pytest.approx(speed)
    assert measure("speed", none, {"from_scratch": scratch}) is None


def test_where_nothing_succeeded_before_a_stage_there_is_no_share_that_is_kept(
    scores: Callable[..., Scores],
) -> None:
    assert measure("kept_share", scores([[0, 0, 0], [0.5, 1, 0]])) is None
    assert measure("kept_share", scores([[0.5, 0, 0], [0, 1, 0]])) == 0


def test_a_stage_to_a_criterion_has_no_learning_curve(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, steps=(100,), ends=(8, 12))
    for name in ("forward_transfer", "forward_transfer_libero", "area_under_curve_libero"):
        assert measure(name, run, {"from_scratch": run}) is None


def test_without_a_criterion_there_are_no_steps_to_it(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX)
    assert measure("steps_to_criterion", run) is None
    assert measure("speed", run, {"from_scratch": run}) is None


def test_the_shift_is_the_mean_over_the_stages(scores: Callable[..., Scores]) -> None:
    assert measure("shift", scores(MATRIX, shift=[0.5, 1.5])) == (0.5 + 1.5) / 2
    assert measure("shift", scores(MATRIX, steps=(100,), ends=(8, 12), shift=[2.0, 3.0])) == 2.5
    assert measure("shift", scores(MATRIX, shift=[0.5, np.nan])) is None
    assert measure("shift", scores(MATRIX)) is None


def test_instruction_capture_is_the_mean_share_over_the_stages(scores: Callable[..., Scores]) -> None:
    assert measure("instruction_capture", scores(MATRIX, captured=[0.5, 0.25])) == (0.5 + 0.25) / 2
    assert measure("instruction_capture", scores(MATRIX, captured=[0.5, np.nan])) is None
    assert measure("instruction_capture", scores(MATRIX)) is None


def test_relearning_that_fails_counts_with_all_the_steps_of_a_stage(scores: Callable[..., Scores]) -> None:
    regained, lost = Relearning("skill_0", 3, 14, True), Relearning("skill_1", 0, 100, False)
    for relearning, steps in ((regained, 14), (lost, 100), (None, None)):
        run = scores(MATRIX, steps=(100,), ends=(8, 12), relearning=relearning)
        assert measure("relearning_steps", run) == steps


@pytest.mark.parametrize(
    ("relearning", "ends", "words"),
    [
        (Relearning("target_0", 3, 14, True), (8, 12), "'target_0' is not a retained skill"),
        (Relearning("skill_0", 11, 14, True), (8, 12), "an impossible number of successes"),
        (Relearning("skill_0", -1, 14, True), (8, 12), "an impossible number of successes"),
        (Relearning("skill_0", 3, 15, True), (8, 12), "are not those of a check"),
        (Relearning("skill_0", 3, 200, False), (8, 12), "are not those of a check"),
        (Relearning("skill_0", 3, 14, False), (8, 12), "it ends before the criterion was met"),
        (Relearning("skill_0", 3, 14, True), None, "its budget has no criterion"),
    ],
)
def test_relearning_that_contradicts_the_protocol_is_refused(
    relearning: Relearning, ends: tuple[int, int] | None, words: str, scores: Callable[..., Scores]
) -> None:
    with pytest.raises(RecordError, match=words):
        scores(MATRIX, steps=(100,), ends=ends, relearning=relearning)


def test_an_earlier_target_counts_as_kept_from_the_stage_after_its_own(scores: Callable[..., Scores]) -> None:
    # three targets and no skill: rows are stages, and success before learning counts nowhere
    run = scores([[0.9] * 3, [0.5, 0.9, 0.9], [0.4, 0.8, 0.9], [0.2, 0.6, 0.7]], groups=(0, 3, 0))
    assert measure("kept_targets_over_stages", run) == pytest.approx((0.4 + (0.2 + 0.6) / 2) / 2)
    # nothing was known before the first stage, which therefore does not count
    assert measure("kept_over_stages", run) == pytest.approx((0.4 + (0.2 + 0.6) / 2) / 2)
    assert measure("kept_share", run) == pytest.approx((0.4 / 0.5 + (0.2 + 0.6) / (0.4 + 0.8)) / 2)


def test_forward_transfer_has_the_value_worked_out_by_hand(scores: Callable[..., Scores]) -> None:
    steps = (200, 400)
    run = scores(MATRIX, curves=[[0.7], [0.6]], steps=steps)
    scratch = scores([[0.0] * 5, [0, 0, 0.6, 0, 0], [0, 0, 0, 0.4, 0]], curves=[[0.2], [0.0]], steps=steps)
    # The curves start where the stage before ended: 0.1 for the first target, 0.2 for the second.
    areas = (0.1 / 4 + 0.7 / 2 + 0.9 / 4, 0.2 / 4 + 0.6 / 2 + 0.8 / 4)
    from_scratch = (0.2 / 2 + 0.6 / 4, 0.4 / 4)
    expected = np.mean([(a - b) / (1 - b) for a, b in zip(areas, from_scratch, strict=True)])
    assert measure("forward_transfer", run, {"from_scratch": scratch}) == pytest.approx(expected)


def test_learning_from_scratch_counts_as_starting_without_success(scores: Callable[..., Scores]) -> None:
    run = scores([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]], curves=[[0.5]], steps=(50, 100))
    scratch = scores([[0.0, 0.4, 0.0], [0.0, 1.0, 0.0]], curves=[[0.5]], steps=(50, 100))
    assert measure("forward_transfer", run, {"from_scratch": scratch}) == pytest.approx(0.0)


def test_a_skill_that_improves_at_the_end_makes_up_for_one_that_is_forgotten(
    scores: Callable[..., Scores],
) -> None:
    run = scores([[0.8, 0.6, 0.0], [0.5, 1.0, 0.9]], groups=(2, 1, 0))
    assert measure("forgetting", run) == pytest.approx((0.8 - 0.5 + 0.6 - 1.0) / 2)


def test_questions_of_all_kinds_count_together_at_the_end_alone(scores: Callable[..., Scores]) -> None:
    answers = {(0, "left"): (10, 10), (2, "left"): (30, 15), (2, "above"): (10, 9)}
    assert measure("question_retention", scores(MATRIX, answers=answers)) == pytest.approx(24 / 40)


@pytest.mark.parametrize(("name", "table"), [("update_sparsity", "sparsity"), ("activation_drift", "drift")])
def test_changes_of_the_policy_count_after_the_last_target(
    name: str, table: str, scores: Callable[..., Scores]
) -> None:
    values = np.array([[0.9, 0.8, 0.7, 0.6], [0.5, 0.4, 0.3, 0.2]])
    assert measure(name, scores(MATRIX, **{table: values})) == 0.2
    values[1, 2] = np.nan
    assert measure(name, scores(MATRIX, **{table: values})) == 0.2
    values[1, 3] = np.nan
    assert measure(name, scores(MATRIX, **{table: values})) is None


def test_forward_transfer_weighs_uneven_steps_by_their_length(scores: Callable[..., Scores]) -> None:
    steps = (50, 100, 200, 400)
    success = [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    run = scores(success, curves=[[0.2, 0.4, 0.8]], steps=steps)
    scratch = scores(success, curves=[[0.0, 0.0, 0.0]], steps=steps)
    area = (50 * 0.1 + 50 * 0.3 + 100 * 0.6 + 200 * 0.9) / 400
    expected = (area - 0.25) / (1 - 0.25)
    assert measure("forward_transfer", run, {"from_scratch": scratch}) == pytest.approx(expected)


@pytest.mark.long
def test_metrics_agree_with_plain_loops_on_random_matrices(scores: Callable[..., Scores]) -> None:
    generator = np.random.default_rng(0)
    for _ in range(200):
        retained, targets, held_out = (int(generator.integers(1, 4)) for _ in range(3))
        shape = (targets + 1, retained + targets + held_out)
        rates = generator.integers(0, 6, size=(2, *shape)) / 5
        curves = generator.integers(0, 6, size=(2, targets, 3)) / 5
        disturbed = generator.integers(0, 6, size=(targets + 1, retained)) / 5
        run, scratch = (
            scores(one, curves=curve, perturbed=disturbed, groups=(retained, targets, held_out), episodes=5)
            for one, curve in zip(rates, curves, strict=True)
        )
        expected = plain_loops(rates[0], rates[1], curves, retained, targets)
        expected["perturbed_retention"] = sum(disturbed[targets][s] for s in range(retained)) / retained
        for name, value in expected.items():
            assert measure(name, run, {"from_scratch": scratch}) == (
                None if value is None else pytest.approx(value)
            ), name


def plain_loops(
    matrix: Any, scratch: Any, curves: Any, retained: int, targets: int
) -> dict[str, float | None]:
    """Return the metrics of a matrix (stages + 1, tasks) as their papers write them."""
    end = targets
    column = {k: retained + k - 1 for k in range(1, targets + 1)}
    drops = [max(matrix[stage][s] for stage in range(end)) - matrix[end][s] for s in range(retained)]
    changes = []
    for k in range(1, targets):
        drops.append(max(matrix[stage][column[k]] for stage in range(k, end)) - matrix[end][column[k]])
        changes.append(matrix[end][column[k]] - matrix[k][column[k]])
    transfers = []
    for k in range(1, targets + 1):
        points = [0.0, 0.25, 0.5, 0.75, 1.0]
        own = trapezoid([matrix[k - 1][column[k]], *curves[0][k - 1], matrix[k][column[k]]], points)
        base = trapezoid([0.0, *curves[1][k - 1], scratch[k][column[k]]], points)
        transfers.append((own - base) / (1 - base))
    return {
        "final_average": sum(matrix[end][s] for s in range(retained + targets)) / (retained + targets),
        "adaptation": sum(matrix[k][column[k]] for k in column) / targets,
        "retention": sum(matrix[end][s] for s in range(retained)) / retained,
        "forgetting": sum(drops) / len(drops),
        "backward_transfer": sum(changes) / len(changes) if changes else None,
        "forward_transfer": sum(transfers) / len(transfers),
        "zero_shot": float(np.mean(matrix[end][retained + targets :])),
    }


def test_without_the_reference_forward_transfer_is_none(scores: Callable[..., Scores]) -> None:
    assert measure("forward_transfer", scores(MATRIX, curves=[[0.5] * 3] * 2)) is None


def test_without_questions_question_retention_is_none(scores: Callable[..., Scores]) -> None:
    assert measure("question_retention", scores(MATRIX, answers={(0, "left"): (10, 9)})) is None


def test_without_held_out_tasks_zero_shot_is_none(scores: Callable[..., Scores]) -> None:
    assert measure("zero_shot", scores(np.array(MATRIX)[:, :4], groups=(2, 2, 0))) is None


def test_with_one_target_backward_transfer_is_none(scores: Callable[..., Scores]) -> None:
    run = scores([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]])
    assert measure("backward_transfer", run) is None
    assert measure("forgetting", run) == 0.5


def test_a_record_of_the_pretrained_policy_alone_has_no_value_that_needs_a_target(
    scores: Callable[..., Scores],
) -> None:
    run = scores([[1.0, 0.5]], groups=(1, 0, 1))
    values = {name: measure(name, run) for name in METRICS}
    assert {name for name, value in values.items() if value is not None} == {
        "final_average",
        "kept",
        "retention",
        "zero_shot",
    }


@pytest.mark.parametrize(
    ("stage", "task", "missing"),
    [
        (2, 0, {"final_average", "retention", "forgetting", "kept", *KEPT_SKILLS}),
        (1, 2, {"adaptation", "forgetting", "backward_transfer", "kept_share"}),
        (0, 0, {"forgetting", "kept_share"}),
        (0, 2, set()),
        (2, 4, {"zero_shot"}),
    ],
)
def test_metrics_that_need_a_missing_cell_are_none_and_the_others_are_not(
    stage: int, task: int, missing: set[str], scores: Callable[..., Scores]
) -> None:
    matrix = np.array(MATRIX)
    matrix[stage, task] = np.nan
    values = {name: measure(name, scores(matrix)) for name in BY_HAND}
    assert {name for name, value in values.items() if value is None} == missing


def test_a_cell_that_lacks_an_episode_is_missing(scores: Callable[..., Scores]) -> None:
    outcomes = np.ones((2, 3, 20))
    outcomes[1, 0, 19] = np.nan
    assert measure("retention", scores(outcomes)) is None
    assert measure("adaptation", scores(outcomes)) == 1.0


def test_a_missing_point_of_a_curve_takes_forward_transfer_only(scores: Callable[..., Scores]) -> None:
    curves = np.full((2, 3), 0.5)
    scratch = scores(MATRIX, curves=curves)
    curves[1, 1] = np.nan
    run = scores(MATRIX, curves=curves)
    assert measure("forward_transfer", run, {"from_scratch": scratch}) is None
    assert measure("adaptation", run) == pytest.approx(BY_HAND["adaptation"])
