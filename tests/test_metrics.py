"""Metrics against matrices worked by hand and against plain loops."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid

from clbench.metrics import METRICS, Scores, load_metric, measure, rates_of
from clbench.record import Record, RecordError

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


@pytest.fixture
def scores(make_record: MakeRecord) -> Callable[..., Scores]:
    return lambda *arguments, **options: Scores.from_record(make_record(*arguments, **options))


@pytest.mark.parametrize("name", BY_HAND)
def test_a_metric_has_the_value_worked_out_by_hand(name: str, scores: Callable[..., Scores]) -> None:
    assert measure(name, scores(MATRIX)) == pytest.approx(BY_HAND[name])


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


def test_metrics_agree_with_plain_loops_on_random_matrices(scores: Callable[..., Scores]) -> None:
    generator = np.random.default_rng(0)
    for _ in range(200):
        retained, targets, held_out = (int(generator.integers(1, 4)) for _ in range(3))
        shape = (targets + 1, retained + targets + held_out)
        rates = generator.integers(0, 6, size=(2, *shape)) / 5
        curves = generator.integers(0, 6, size=(2, targets, 3)) / 5
        run, scratch = (
            scores(one, curves=curve, groups=(retained, targets, held_out), episodes=5)
            for one, curve in zip(rates, curves, strict=True)
        )
        expected = plain_loops(rates[0], rates[1], curves, retained, targets)
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


def test_a_stage_ends_where_it_was_evaluated_last(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, curves=[[0.4], [0.5]], steps=(10, 25))
    assert measure("adaptation", run) == pytest.approx(BY_HAND["adaptation"])
    np.testing.assert_allclose(run.curves.mean(axis=-1), [[0.4, 0.9], [0.5, 0.8]])


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


def test_selection_episodes_count_for_nothing(make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    before = Scores.from_record(record)
    for column, value in zip(
        record.episodes.values(), (2, 400, "skill_0", "selection", 20, 1, 1.0, 5), strict=True
    ):
        column.append(value)
    np.testing.assert_array_equal(Scores.from_record(record).success, before.success)


def test_the_order_of_rows_does_not_matter(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, curves=np.full((2, 3), 0.5), answers={(2, "b"): (9, 3), (2, "a"): (5, 4)})
    scores = Scores.from_record(record)
    order = np.random.default_rng(0).permutation(len(record.episodes["stage"]))
    record.episodes = {name: [column[n] for n in order] for name, column in record.episodes.items()}
    record.answers = {name: column[::-1] for name, column in record.answers.items()}
    shuffled = Scores.from_record(record)
    assert shuffled.layout == scores.layout
    for name in ("success", "curves", "asked", "correct"):
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(scores, name))


def test_the_axes_of_scores_follow_the_scenario(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, curves=[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], answers={(1, "left"): (8, 6)})
    assert run.layout.tasks == ("skill_0", "skill_1", "target_0", "target_1", "unseen_0")
    assert run.layout.columns("held_out") == slice(4, 5)
    assert run.layout.steps == (100, 200, 300, 400)
    np.testing.assert_allclose(run.success.mean(axis=-1), MATRIX)
    np.testing.assert_allclose(run.curves.mean(axis=-1), [[0.1, 0.2, 0.3, 0.9], [0.4, 0.5, 0.6, 0.8]])
    np.testing.assert_array_equal(run.asked, [[0], [8], [0]])
    np.testing.assert_array_equal(run.correct, [[0], [6], [0]])


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("task", "juggle", "juggle"),
        ("stage", 3, "impossible"),
        ("stage", -1, "impossible"),
        ("stage", True, "impossible"),
        ("step", 10**30, "impossible"),
        ("step", 1.5, "impossible"),
        ("episode", None, "impossible"),
        ("episode", 1, "twice"),
        ("success", 0.5, "neither true nor false"),
        ("success", "yes", "neither true nor false"),
        ("success", [], "neither true nor false"),
    ],
)
def test_an_episode_that_cannot_be_is_refused(
    column: str, value: Any, words: str, make_record: MakeRecord
) -> None:
    record = make_record(MATRIX)
    record.episodes[column][0] = value
    with pytest.raises(RecordError, match=words):
        Scores.from_record(record)


@pytest.mark.parametrize(
    "row",
    [
        (2, "left", 5, 6),
        (2, "left", -1, -2),
        (3, "left", 5, 5),
        (2, 7, 5, 5),
        (2, "left", "5", 5),
        (0, "left", 10, 1),
        (2, "left", 10**40, 1),
    ],
)
def test_an_answer_count_that_cannot_be_is_refused(row: tuple[Any, ...], make_record: MakeRecord) -> None:
    record = make_record(MATRIX, answers={(0, "left"): (10, 9)})
    for column, value in zip(record.answers.values(), row, strict=True):
        column.append(value)
    with pytest.raises(RecordError, match="answers"):
        Scores.from_record(record)


@pytest.mark.parametrize("names", [None, "skill_0", [1], ["target_0"]])
def test_a_scenario_without_clear_task_names_is_refused(names: Any, make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    record.scenario["retained"] = names
    with pytest.raises(RecordError, match="scenario"):
        Scores.from_record(record)


def test_a_record_without_report_episodes_is_refused(make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    record.episodes["split"] = ["selection"] * len(record.episodes["split"])
    with pytest.raises(RecordError, match="no report episode"):
        Scores.from_record(record)


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
    assert metric.low < metric.high


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_keeps_to_its_range_and_to_batch_axes(name: str, scores: Callable[..., Scores]) -> None:
    generator = np.random.default_rng(1)
    metric = load_metric(name)
    runs, others = (
        [
            scores(
                generator.integers(0, 2, size=(4, 6, 2)),
                curves=generator.integers(0, 2, size=(3, 3, 2)),
                answers={(3, "left"): (10, int(generator.integers(11)))},
            )
            for _ in range(20)
        ]
        for _ in range(2)
    )
    values = [
        measure(name, run, dict.fromkeys(metric.references, other))
        for run, other in zip(runs, others, strict=True)
    ]
    assert all(value is not None and metric.low <= value <= metric.high for value in values)
    together = metric.function(rates_of(runs, dict.fromkeys(metric.references, others)))
    np.testing.assert_allclose(together, np.array(values, dtype=float))


def test_runs_of_different_layouts_do_not_mix(scores: Callable[..., Scores]) -> None:
    with pytest.raises(ValueError, match="do not mix"):
        rates_of([scores(MATRIX), scores(MATRIX, episodes=10)], {})
    with pytest.raises(ValueError, match="do not mix"):
        rates_of([scores(MATRIX)], {"from_scratch": [scores(MATRIX, steps=(200,))]})
