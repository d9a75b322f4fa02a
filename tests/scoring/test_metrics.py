"""Metrics against matrices worked by hand and against plain loops."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from clbench.cli import metric_pages
from clbench.records.record import Record
from clbench.scoring.intervals import estimate
from clbench.scoring.metrics import METRICS, load_metric, measure
from clbench.scoring.ours import matched_points
from clbench.scoring.scores import Scores, rates_of

MakeRecord = Callable[..., Record]

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
}


@pytest.fixture(scope="module")
def scores(make_record: MakeRecord) -> Callable[..., Scores]:
    return lambda *arguments, **options: Scores.from_record(make_record(*arguments, **options))


@pytest.mark.parametrize("name", BY_HAND)
def test_a_metric_has_the_value_worked_out_by_hand(name: str, scores: Callable[..., Scores]) -> None:
    assert measure(name, scores(MATRIX)) == pytest.approx(BY_HAND[name])


def test_perturbed_retention_has_the_value_worked_out_by_hand(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, perturbed=[[0.9, 0.7], [0.5, 0.8], [0.4, 0.2]])
    assert measure("perturbed_retention", run) == pytest.approx((0.4 + 0.2) / 2)
    assert measure("retention", run) == pytest.approx(BY_HAND["retention"])
    assert measure("perturbed_retention", scores(MATRIX)) is None


def test_forward_transfer_has_the_value_worked_out_by_hand(scores: Callable[..., Scores]) -> None:
    steps = (200, 400)
    run = scores(MATRIX, curves=[[0.7], [0.6]], steps=steps)
    scratch = scores([[0.0] * 5, [0, 0, 0.6, 0, 0], [0, 0, 0, 0.4, 0]], curves=[[0.2], [0.0]], steps=steps)
    # The curves start with what the stage before left: 0.1 for the first target, 0.2 for the second.
    areas = (0.1 / 4 + 0.7 / 2 + 0.9 / 4, 0.2 / 4 + 0.6 / 2 + 0.8 / 4)
    from_scratch = (0.2 / 2 + 0.6 / 4, 0.4 / 4)
    expected = np.mean([(a - b) / (1 - b) for a, b in zip(areas, from_scratch, strict=True)])
    assert measure("forward_transfer", run, {"from_scratch": scratch}) == pytest.approx(expected)


def test_questions_of_all_kinds_count_together_at_the_end_alone(scores: Callable[..., Scores]) -> None:
    answers = {(0, "left"): (10, 10), (2, "left"): (30, 15), (2, "above"): (10, 9)}
    assert measure("question_retention", scores(MATRIX, answers=answers)) == pytest.approx(24 / 40)


# Two stages with three points each: what plain fine-tuning and a gentler method do on the way.
MATCHED_STEPS = (100, 200, 400)
PLAIN = {"validation": [[0.4, 0.9, 1.0], [0.0, 0.7, 0.8]], "retained_curves": [[[0.9, 0.7], [0.5, 0.6]]] * 2}
GENTLE = {
    "validation": [[0.1, 0.6, 0.9], [0.3, 0.8, 0.9]],
    "retained_curves": [[[1.0, 1.0], [0.9, 0.9]], [[0.8, 0.9], [0.7, 0.6]]],
}


def test_retention_at_matched_adaptation_has_the_value_worked_out_by_hand(
    scores: Callable[..., Scores],
) -> None:
    sft = scores(MATRIX, steps=MATCHED_STEPS, **PLAIN)
    run = scores(MATRIX, steps=MATCHED_STEPS, **GENTLE)
    # The goals are 0.9 x 1.0, reached at the end of its stage, and 0.9 x 0.8, reached in the middle.
    np.testing.assert_array_equal(matched_points(rates_of([run], {"sft": [sft]})), [[2, 1]])
    expected = ((0.6 + 0.9) / 2 + (0.7 + 0.6) / 2) / 2
    assert measure("retention_at_matched_adaptation", run, {"sft": sft}) == pytest.approx(expected)


def test_plain_fine_tuning_is_matched_with_its_own_end(scores: Callable[..., Scores]) -> None:
    sft = scores(MATRIX, steps=MATCHED_STEPS, **PLAIN)
    # 0.9 of 1.0 after 200 steps, 0.72 of 0.8 not before the end
    expected = ((0.5 + 0.6) / 2 + (0.5 + 0.4) / 2) / 2
    assert measure("retention_at_matched_adaptation", sft, {"sft": sft}) == pytest.approx(expected)


def test_a_method_that_never_learns_a_target_as_well_has_no_matched_point(
    scores: Callable[..., Scores],
) -> None:
    sft = scores(MATRIX, steps=MATCHED_STEPS, **PLAIN)
    run = scores(MATRIX, steps=MATCHED_STEPS, **{**GENTLE, "validation": [[0.1, 0.6, 0.8], [0.9, 0.9, 0.9]]})
    np.testing.assert_array_equal(matched_points(rates_of([run], {"sft": [sft]})), [[np.nan, 0]])
    assert measure("retention_at_matched_adaptation", run, {"sft": sft}) is None


def test_the_matched_point_is_chosen_on_validation_episodes_whatever_the_report_ones_say(
    scores: Callable[..., Scores],
) -> None:
    sft = scores(MATRIX, steps=MATCHED_STEPS, curves=np.ones((2, 2)), **PLAIN)
    first, last = (
        scores(MATRIX, steps=MATCHED_STEPS, curves=curves, **GENTLE)
        for curves in (np.ones((2, 2)), np.zeros((2, 2)))
    )
    points = matched_points(rates_of([first, last], {"sft": [sft, sft]}))
    np.testing.assert_array_equal(points, [[2, 1], [2, 1]])


def test_a_rate_that_just_reaches_the_goal_is_matched_whatever_its_last_bit(
    scores: Callable[..., Scores],
) -> None:
    assert 36 / 50 < 0.9 * (40 / 50)
    sft, run = (
        scores(
            [[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]],
            steps=(100,),
            validation=[[right / 50]],
            validation_episodes=50,
        )
        for right in (40, 36)
    )
    np.testing.assert_array_equal(matched_points(rates_of([run], {"sft": [sft]})), [[0]])


@pytest.mark.parametrize(
    ("method", "point", "points"),
    [("run", 0, [np.nan, 1]), ("run", 2, [np.nan, 1]), ("sft", 2, [np.nan, 1]), ("sft", 0, [2, 1])],
)
def test_a_missing_selection_rate_leaves_no_point_that_could_be_another(
    method: str, point: int, points: list[float], scores: Callable[..., Scores]
) -> None:
    selection = {"sft": np.array(PLAIN["validation"]), "run": np.array(GENTLE["validation"])}
    selection[method][0, point] = np.nan
    sft, run = (scores(MATRIX, steps=MATCHED_STEPS, validation=selection[name]) for name in ("sft", "run"))
    np.testing.assert_array_equal(matched_points(rates_of([run], {"sft": [sft]})), [points])


def test_a_missing_success_at_the_matched_point_leaves_no_value_and_elsewhere_does_not_matter(
    scores: Callable[..., Scores],
) -> None:
    sft = scores(MATRIX, steps=MATCHED_STEPS, **PLAIN)
    values = []
    for point in (0, 1):
        retained = np.array(GENTLE["retained_curves"])
        retained[1, point, 0] = np.nan
        run = scores(MATRIX, steps=MATCHED_STEPS, **{**GENTLE, "retained_curves": retained})
        values.append(measure("retention_at_matched_adaptation", run, {"sft": sft}))
    assert values == [pytest.approx(0.7), None]


def test_without_plain_fine_tuning_there_is_no_matched_retention(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, steps=MATCHED_STEPS, **GENTLE)
    assert measure("retention_at_matched_adaptation", run) is None
    np.testing.assert_array_equal(matched_points(run.rates()), [np.nan, np.nan])


@pytest.mark.parametrize(("name", "table"), [("update_sparsity", "sparsity"), ("activation_drift", "drift")])
def test_what_has_become_of_the_policy_counts_after_the_last_target(
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
        "retention",
        "zero_shot",
    }


@pytest.mark.parametrize(
    ("stage", "task", "missing"),
    [
        (2, 0, {"final_average", "retention", "forgetting"}),
        (1, 2, {"adaptation", "forgetting", "backward_transfer"}),
        (0, 0, {"forgetting"}),
        (0, 2, set()),
        (2, 4, {"zero_shot"}),
    ],
)
def test_what_needs_a_missing_cell_is_none_and_the_rest_is_not(
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


def test_an_unknown_metric_is_a_lookup_error_that_names_the_nearest() -> None:
    with pytest.raises(LookupError, match="Did you mean 'retention'"):
        load_metric("retentoin")


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_describes_itself(name: str) -> None:
    metric = load_metric(name)
    assert metric.name == name
    assert metric.description.endswith(".")
    assert metric.formula
    assert metric.source
    assert metric.units
    assert metric.missing.endswith(".")
    assert metric.low < metric.high


@pytest.fixture(scope="module")
def random_pairs(scores: Callable[..., Scores]) -> tuple[list[Scores], list[Scores]]:
    """Twenty runs at random, and as many references."""
    generator = np.random.default_rng(1)
    runs, others = (
        [
            scores(
                generator.integers(0, 2, size=(4, 6, 2)),
                curves=generator.integers(0, 2, size=(3, 3, 2)),
                retained_curves=generator.integers(0, 2, size=(3, 3, 2, 2)),
                perturbed=generator.integers(0, 2, size=(4, 2, 2)),
                # each target is learned in the end, as the matched point needs
                validation=np.concatenate([generator.random((3, 3)), np.ones((3, 1))], axis=1),
                sparsity=generator.random((3, 4)),
                drift=generator.random((3, 4)),
                answers={(3, "left"): (10, int(generator.integers(11)))},
            )
            for _ in range(20)
        ]
        for _ in range(2)
    )
    return runs, others


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_keeps_to_its_range_and_to_batch_axes(
    name: str, random_pairs: tuple[list[Scores], list[Scores]]
) -> None:
    (runs, others), metric = random_pairs, load_metric(name)
    values = [
        measure(name, run, dict.fromkeys(metric.references, other))
        for run, other in zip(runs, others, strict=True)
    ]
    known = [value for value in values if value is not None]
    # a share of the highest success has no value where there is none
    assert len(known) >= (10 if name.endswith("_cora") else 20)
    assert all(metric.low <= value <= metric.high for value in known)
    together = metric.function(rates_of(runs, dict.fromkeys(metric.references, others)))
    np.testing.assert_allclose(together, np.array(values, dtype=float))


# ---- published definitions ---------------------------------------------------------------------------------

# One skill, three targets, one task held out: the target rows are .6 .2 .1, .8 .9 .4 and .9 .3 1.
PUBLISHED = [
    [1.0, 0.1, 0.0, 0.2, 0.3],
    [0.8, 0.6, 0.2, 0.1, 0.2],
    [0.7, 0.8, 0.9, 0.4, 0.4],
    [0.6, 0.9, 0.3, 1.0, 0.1],
]
OWN_CURVES = [[0.2, 0.3, 0.4], [0.5, 0.5, 0.6], [0.4, 0.6, 0.9]]
SKILL_CURVES = [[[0.9], [0.5], [0.7]], [[0.8], [0.8], [0.8]], [[0.7], [0.4], [0.5]]]
JOINT = [[1.0, 0.1, 0.0, 0.2, 0.3], [1, 0.9, 0, 0, 0], [1, 0.9, 0.8, 0, 0], [1, 0.9, 0.8, 1.0, 0]]
PUBLISHED_BY_HAND = {
    "performance_continual_world": (0.9 + 0.3 + 1.0) / 3,
    "average_incremental_accuracy": (0.6 + (0.8 + 0.9) / 2 + (0.9 + 0.3 + 1.0) / 3) / 3,
    "forgetting_chaudhry": ((0.8 - 0.9) + (0.9 - 0.3)) / 2,
    "forgetting_mammoth": (0.0 + (0.9 - 0.3)) / 2,
    "forgetting_avalanche": ((0.6 - 0.9) + (0.9 - 0.3)) / 2,
    "forgetting_continual_world": ((0.6 - 0.9) + (0.9 - 0.3) + 0.0) / 3,
    "intransigence": ((0.9 - 0.6) + (0.8 - 0.9) + 0.0) / 3,
    "accuracy_diaz_rodriguez": (0.6 + 0.8 + 0.9 + 0.9 + 0.3 + 1.0) / 6,
    "backward_transfer_diaz_rodriguez": (0.2 + 0.3 - 0.6) / 3,
    "remembering_diaz_rodriguez": 1 - 0.1 / 3,
    "positive_backward_transfer_diaz_rodriguez": 0.0,
    "forward_transfer_diaz_rodriguez": (0.2 + 0.1 + 0.4) / 3,
    "minimum_accuracy": (0.8 + 0.3) / 2,
    "worst_case_accuracy": 1.0 / 3 + 2 / 3 * (0.8 + 0.3) / 2,
    "isolated_forgetting_cora": (-0.2 / 0.9 - 0.1 / 0.9 + 0.6 / 0.9) / 3,
    "isolated_zero_shot_transfer_cora": (0.2 / 0.9 - 0.1 / 1.0 + 0.3 / 1.0) / 3,
    "forward_transfer_libero": (1.6 + 2.7 + 3.3) / 5 / 3,
    "negative_backward_transfer_libero": ((-0.2 - 0.3) / 2 + 0.6 + 0) / 3,
    "negative_backward_transfer_clare": ((-0.2 - 0.3) / 2 + 0.6) / 2,
    "negative_backward_transfer_arfm": (0.0 + 0.6) / 2,
    "area_under_curve_libero": ((0.32 + 0.8 + 0.9) / 3 + (0.54 + 0.3) / 2 + 0.66) / 3,
    "zero_shot_change": 0.1 - 0.3,
    "minimum_retention": 0.4,
}


@pytest.mark.parametrize("name", PUBLISHED_BY_HAND)
def test_a_published_definition_has_the_value_worked_out_by_hand(
    name: str, scores: Callable[..., Scores]
) -> None:
    run = scores(PUBLISHED, curves=OWN_CURVES, retained_curves=SKILL_CURVES)
    assert measure(name, run, {"joint": scores(JOINT)}) == pytest.approx(PUBLISHED_BY_HAND[name])


def test_every_metric_is_worked_out_by_hand_somewhere() -> None:
    others = {"forward_transfer", "question_retention", "retention_at_matched_adaptation"}
    others.add("perturbed_retention")
    assert {*BY_HAND, *PUBLISHED_BY_HAND, *others, "update_sparsity", "activation_drift"} == set(METRICS)


def test_published_definitions_agree_with_plain_loops_on_random_matrices_also_in_a_batch(
    scores: Callable[..., Scores],
) -> None:
    generator = np.random.default_rng(2)
    for _ in range(100):
        groups = tuple(int(number) for number in generator.integers(1, 5, size=3))
        retained, targets, held_out = groups
        runs, joints, expected = [], [], []
        for _ in range(2):
            shape = (2, targets + 1, retained + targets + held_out)
            matrix, joint = generator.integers(0, 6, size=shape) / 5
            own = generator.integers(0, 6, size=(targets, 3)) / 5
            skills = generator.integers(0, 6, size=(targets, 3, retained)) / 5
            runs.append(scores(matrix, curves=own, retained_curves=skills, groups=groups, episodes=5))
            joints.append(scores(joint, groups=groups, curves=own, episodes=5))
            expected.append(published_loops(matrix, joint, own, skills, retained, targets))
        assert set(expected[0]) == set(PUBLISHED_BY_HAND)
        rates = rates_of(runs, {"joint": joints})
        for name in expected[0]:
            wanted = np.array([one[name] for one in expected], dtype=float)
            got = load_metric(name).function(rates)
            np.testing.assert_allclose(got, wanted, atol=1e-12, err_msg=name)
            deeper = load_metric(name).function(rates.each(lambda array: np.stack([array, array])[:, None]))
            np.testing.assert_allclose(deeper, [[wanted], [wanted]], atol=1e-12, err_msg=name)


def published_loops(
    matrix: Any, joint: Any, own: Any, skills: Any, retained: int, targets: int
) -> dict[str, float | None]:
    """Return the published definitions of a matrix (stages + 1, tasks) as their sources write them."""
    n = targets
    r = [[float(matrix[i][retained + j - 1]) if j else 0.0 for j in range(n + 1)] for i in range(n + 1)]
    last_but_one, everything = range(1, n), range(1, n + 1)
    values: dict[str, float | None] = dict.fromkeys(PUBLISHED_BY_HAND)
    values["performance_continual_world"] = sum(r[n][i] for i in everything) / n
    running = [sum(r[k][j] for j in range(1, k + 1)) / k for k in everything]
    values["average_incremental_accuracy"] = sum(running) / n
    values["intransigence"] = sum(joint[k][retained + k - 1] - r[k][k] for k in everything) / n
    area = sum(r[i][j] for i in everything for j in everything if i >= j)
    values["accuracy_diaz_rodriguez"] = area / (n * (n + 1) / 2)
    forward = {k: (r[k - 1][k] + sum(own[k - 1]) + r[k][k]) / 5 for k in everything}
    values["forward_transfer_libero"] = sum(forward.values()) / n
    values["area_under_curve_libero"] = (
        sum((forward[k] + sum(r[t][k] for t in range(k + 1, n + 1))) / (n - k + 1) for k in everything) / n
    )
    unseen = range(retained + n, len(matrix[0]))
    values["zero_shot_change"] = sum(matrix[n][s] - matrix[0][s] for s in unseen) / len(unseen)
    lowest = [
        min([matrix[k][s] for k in everything] + [point[s] for stage in skills for point in stage])
        for s in range(retained)
    ]
    values["minimum_retention"] = sum(lowest) / retained
    if n == 1:
        return values
    values["forgetting_chaudhry"] = sum(max(r[i][j] for i in range(1, n)) - r[n][j] for j in last_but_one) / (
        n - 1
    )
    # Mammoth fills the tasks that are still to come with 0 before it takes the highest
    padded = [[r[i][j] if j <= i else 0.0 for j in everything] for i in everything]
    highest = [max(row[j] for row in padded) for j in range(n)]
    values["forgetting_mammoth"] = sum(highest[j] - padded[-1][j] for j in range(n - 1)) / (n - 1)
    initial, final = {j: r[j][j] for j in everything}, {j: r[n][j] for j in last_but_one}
    values["forgetting_avalanche"] = sum(initial[j] - final[j] for j in final) / len(final)
    values["forgetting_continual_world"] = sum(r[j][j] - r[n][j] for j in everything) / n
    change = sum(r[i][j] - r[j][j] for i in range(2, n + 1) for j in range(1, i)) / (n * (n - 1) / 2)
    values["backward_transfer_diaz_rodriguez"] = change
    values["remembering_diaz_rodriguez"] = 1 - abs(min(change, 0))
    values["positive_backward_transfer_diaz_rodriguez"] = max(change, 0)
    ahead = sum(r[i][j] for i in everything for j in everything if i < j)
    values["forward_transfer_diaz_rodriguez"] = ahead / (n * (n - 1) / 2)
    minimum = sum(min(r[i][j] for i in range(j + 1, n + 1)) for j in last_but_one) / (n - 1)
    values["minimum_accuracy"] = minimum
    values["worst_case_accuracy"] = r[n][n] / n + (1 - 1 / n) * minimum
    best = {i: max(r[j][i] for j in range(n + 1)) for i in everything}
    lost = [(i, j) for i in everything for j in everything if j > i]
    if all(best[i] for i, _ in lost):
        values["isolated_forgetting_cora"] = sum((r[j - 1][i] - r[j][i]) / best[i] for i, j in lost) / len(
            lost
        )
    won = [(i, j) for i in everything for j in everything if j < i]
    if all(best[i] for i, _ in won):
        gains = [(r[j][i] - r[j - 1][i]) / best[i] for i, j in won]
        values["isolated_zero_shot_transfer_cora"] = sum(gains) / len(gains)
    worse = [sum(r[k][k] - r[t][k] for t in range(k + 1, n + 1)) / (n - k) for k in last_but_one]
    values["negative_backward_transfer_libero"] = (sum(worse) + 0) / n
    values["negative_backward_transfer_clare"] = sum(worse) / (n - 1)
    values["negative_backward_transfer_arfm"] = sum(max(0, r[k][k] - r[n][k]) for k in last_but_one) / (n - 1)
    return values


def skill_and(targets: Any) -> Any:
    """Return a matrix with a skill that is always kept before the targets, and a task held out after them."""
    rows = np.array([[0.0] * len(targets), *targets])
    return np.concatenate([np.ones((len(rows), 1)), rows, np.zeros((len(rows), 1))], axis=1)


# A dip that is made good, against a small loss that stays.
DIP = [[0.9, 0, 0], [0.1, 0.9, 0], [0.9, 0.9, 0.9]]
LOSS = [[0.9, 0, 0], [0.9, 0.9, 0], [0.7, 0.7, 0.9]]
# Learned well and lost in part, against learned badly and better later.
LOST = [[1.0, 0, 0], [1.0, 1.0, 0], [0.9, 0.9, 1.0]]
LATE = [[0.2, 0, 0], [0.9, 0.2, 0], [0.6, 0.2, 0.2]]


@pytest.mark.parametrize(
    ("first", "second", "one", "other"),
    [
        # the end alone, or every later stage
        (DIP, LOSS, "forgetting_avalanche", "negative_backward_transfer_clare"),
        (DIP, LOSS, "forgetting_continual_world", "negative_backward_transfer_libero"),
        # from the best success, or from the first
        (LOST, LATE, "forgetting_avalanche", "forgetting_chaudhry"),
        (LOST, LATE, "forgetting_continual_world", "forgetting_mammoth"),
        # what is clipped, or what is not
        (LOST, LATE, "forgetting_avalanche", "forgetting_mammoth"),
    ],
)
def test_definitions_may_rank_the_same_two_runs_differently(
    first: Any, second: Any, one: str, other: str, scores: Callable[..., Scores]
) -> None:
    def first_is_better(name: str) -> bool:
        values = [measure(name, scores(skill_and(targets))) for targets in (first, second)]
        assert values[0] is not None
        assert values[1] is not None
        assert load_metric(name).higher_is_better is False
        assert abs(values[0] - values[1]) > 0.01
        return values[0] < values[1]

    assert first_is_better(one) != first_is_better(other)


def test_the_highest_of_chaudhry_counts_stages_before_the_target_and_mammoths_does_not(
    scores: Callable[..., Scores],
) -> None:
    run = scores(skill_and([[0.5, 0.9, 0], [0.5, 0.4, 0], [0.5, 0.4, 0.5]]))
    assert measure("forgetting_chaudhry", run) == pytest.approx((0 + 0.5) / 2)
    assert measure("forgetting_mammoth", run) == pytest.approx(0)


def test_with_one_target_what_compares_later_stages_is_none(scores: Callable[..., Scores]) -> None:
    run = scores([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]])
    names = [name for name, metric in METRICS.items() if "fewer than two targets" in metric.missing]
    assert len(names) == 16
    assert {measure(name, run) for name in names} == {None}


def test_without_joint_intransigence_is_none(scores: Callable[..., Scores]) -> None:
    assert measure("intransigence", scores(PUBLISHED)) is None


def test_a_target_without_any_success_leaves_no_share_of_the_highest(scores: Callable[..., Scores]) -> None:
    run = scores(skill_and([[0.0, 0, 0], [0.0, 0.9, 0], [0.0, 0.9, 0.9]]))
    assert measure("isolated_forgetting_cora", run) is None
    assert measure("isolated_zero_shot_transfer_cora", run) == pytest.approx(0)


def test_skills_that_were_not_evaluated_on_the_way_have_no_minimum(scores: Callable[..., Scores]) -> None:
    assert measure("minimum_retention", scores(PUBLISHED, curves=OWN_CURVES)) is None


def test_a_missing_cell_of_a_target_leaves_no_value_that_needs_it(scores: Callable[..., Scores]) -> None:
    matrix = np.array(PUBLISHED)
    matrix[2, 1] = np.nan
    run = scores(matrix, curves=OWN_CURVES, retained_curves=SKILL_CURVES)
    values = {name: measure(name, run, {"joint": scores(JOINT)}) for name in PUBLISHED_BY_HAND}
    assert {name for name, value in values.items() if value is not None} == {
        "performance_continual_world",
        "forgetting_avalanche",
        "forgetting_continual_world",
        "intransigence",
        "forward_transfer_diaz_rodriguez",
        "isolated_zero_shot_transfer_cora",
        "forward_transfer_libero",
        "negative_backward_transfer_arfm",
        "zero_shot_change",
        "minimum_retention",
    }


def test_every_published_definition_has_an_interval(scores: Callable[..., Scores]) -> None:
    curves = {"curves": OWN_CURVES, "retained_curves": SKILL_CURVES}
    runs = {seed: scores(PUBLISHED, **curves) for seed in range(3)}
    references = dict.fromkeys(("from_scratch", "joint", "sft"), runs)
    rows = estimate(METRICS, runs, np.random.default_rng(0), references=references)
    assert all(rows[name].low is not None for name in PUBLISHED_BY_HAND)


# ---- docs/reference/metrics.md ---------------------------------------------------------------------------------------

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "metrics.md"


@pytest.mark.skipif(not PAGE.exists(), reason="pages are not part of an installed package")
def test_the_page_of_the_metrics_is_what_the_registry_makes() -> None:
    assert PAGE.read_text(encoding="utf-8") == metric_pages.page()


@pytest.mark.parametrize("name", METRICS)
def test_all_about_a_metric_says_its_formula_source_direction_and_what_none_means(name: str) -> None:
    metric, text = METRICS[name], metric_pages.text(METRICS[name])
    for part in (metric.formula, metric.source, metric_pages.direction(metric), metric.missing, metric.units):
        assert part in text


def test_all_about_a_metric_is_exact() -> None:
    assert metric_pages.text(METRICS["retention"]) == (
        "retention\n"
        "Success on the retained skills after the last target.\n"
        "\n"
        "Formula: mean of R[K][s] over the retained skills s\n"
        "Source: clbench\n"
        "Version: 0\n"
        "Direction: higher is better\n"
        "Range: 0 to 1\n"
        "Units: success rate\n"
        "References: none\n"
        "Seeds: the mean of their values\n"
        "None means: The success on a retained skill after the last target is missing.\n"
    )
