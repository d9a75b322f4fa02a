"""Scores: the values in a record, and no others."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from clbench.records.reader import RecordError
from clbench.records.record import Record
from clbench.scoring.scores import Scores, rates_of

MakeRecord = Callable[..., Record]

# Two skills, two targets, one task held out; the rows are the pretrained policy and the ends of two stages.
MATRIX = [
    [1.0, 0.8, 0.1, 0.0, 0.2],
    [0.6, 0.9, 0.9, 0.2, 0.3],
    [0.5, 0.4, 0.3, 0.8, 0.1],
]
CURVES = [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]
RETAINED_CURVES = [[[0.9, 0.8], [0.7, 0.6], [0.5, 0.4]], [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]]
VALIDATION = [[0.1, 0.2, 0.3, 0.9], [0.4, 0.5, 0.6, 1.0]]
SPARSITY = [[0.9, 0.8, 0.7, 0.6], [0.5, 0.4, 0.3, 0.2]]
DRIFT = [[0.5, 1.0, 2.0, 4.0], [5.0, 6.0, 7.0, 8.0]]
SHIFT = [0.25, 0.75]
CAPTURED = [0.5, 0.25]
ON_THE_WAY = {"curves": CURVES, "retained_curves": RETAINED_CURVES}
ALL = {**ON_THE_WAY, "validation": VALIDATION, "sparsity": SPARSITY, "drift": DRIFT, "shift": SHIFT}
ALL["captured"] = CAPTURED
ARRAYS = (
    "success",
    "on_the_way",
    "perturbed",
    "asked",
    "correct",
    "answer_curves",
    "update_sparsity",
    "activation_drift",
    "shift",
    "captured",
)


@pytest.fixture
def make_record(make_record: MakeRecord) -> MakeRecord:
    """Return the function that makes records, which may lack results here."""
    return functools.partial(make_record, complete=False)


@pytest.fixture
def scores(make_record: MakeRecord) -> Callable[..., Scores]:
    return lambda *arguments, **options: Scores.from_record(make_record(*arguments, **options), partial=True)


def append(columns: dict[str, list[Any]], *row: Any) -> None:
    for column, value in zip(columns.values(), row, strict=True):
        column.append(value)


def test_the_axes_of_scores_follow_the_scenario(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, **ALL, answers={(1, "left"): (8, 6)}, curve_episodes=10)
    assert run.layout.tasks == ("skill_0", "skill_1", "target_0", "target_1", "unseen_0")
    assert run.layout.columns("held_out") == slice(4, 5)
    assert run.layout.steps == (100, 200, 300, 400)
    assert run.layout.episodes == tuple(range(20))
    assert run.layout.curve_episodes == run.layout.validation_episodes == tuple(range(10))
    np.testing.assert_allclose(run.success.mean(axis=-1), MATRIX)
    np.testing.assert_allclose(run.on_the_way[0, :, 2].mean(axis=-1), CURVES[0])
    np.testing.assert_allclose(run.on_the_way[1, :, 3].mean(axis=-1), CURVES[1])
    np.testing.assert_allclose(run.on_the_way[:, :, :2].mean(axis=-1), RETAINED_CURVES)
    assert np.isnan(run.on_the_way[0, :, 3:]).all()
    assert np.isnan(run.on_the_way[1, :, [2, 4]]).all()
    np.testing.assert_array_equal(run.asked, [[0], [8], [0]])
    np.testing.assert_array_equal(run.correct, [[0], [6], [0]])
    np.testing.assert_array_equal(run.update_sparsity, SPARSITY)
    np.testing.assert_array_equal(run.activation_drift, DRIFT)
    np.testing.assert_array_equal(run.shift, SHIFT)
    np.testing.assert_array_equal(run.captured, CAPTURED)


def test_the_curves_of_rates_end_with_the_end_of_the_stage(scores: Callable[..., Scores]) -> None:
    rates = scores(MATRIX, **ALL, curve_episodes=10).rates()
    np.testing.assert_allclose(rates.learning_curves, [[0.1, 0.2, 0.3, 0.9], [0.4, 0.5, 0.6, 0.8]])
    np.testing.assert_allclose(rates.retained_curves[..., :-1, :], RETAINED_CURVES)
    np.testing.assert_allclose(rates.retained_curves[..., -1, :], rates.retained[1:])
    np.testing.assert_allclose(rates.learned, rates.learning_curves[:, -1])


def test_values_that_the_record_lacks_are_missing_and_not_guessed(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX)
    for name in ("answer_curves", "update_sparsity", "activation_drift"):
        assert getattr(run, name).shape == (2, 4)
        assert np.isnan(getattr(run, name)).all()
    assert np.isnan(run.rates().curves[:, :-1]).all()
    np.testing.assert_allclose(run.rates().curves[:, -1], MATRIX[1:])


def test_a_rate_that_lacks_an_episode_is_missing(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, **ALL, curve_episodes=10)
    columns = record.episodes
    rows = list(zip(*columns.values(), strict=True))
    lost = {(1, 200, "skill_1", "test", 3)}
    kept = [row for row in rows if row[:5] not in lost]
    assert len(kept) == len(rows) - 1
    record.episodes = {name: [row[number] for row in kept] for number, name in enumerate(columns)}
    rates = Scores.from_record(record, partial=True).rates()
    expected = np.array(RETAINED_CURVES)
    expected[0, 1, 1] = np.nan
    np.testing.assert_allclose(rates.retained_curves[:, :-1], expected)


def test_the_share_of_right_answers_is_missing_where_a_kind_was_not_asked(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, answers={(0, "left"): (10, 10), (0, "above"): (10, 10)})
    for step, kind, correct in ((100, "left", 9), (100, "above", 6), (200, "left", 8), (400, "above", 0)):
        append(record.answers, 1, step, kind, 10, correct)
    append(record.answers, 1, 400, "left", 10, 7)
    append(record.answers, 2, 400, "left", 10, 6)
    run = Scores.from_record(record, partial=True)
    np.testing.assert_allclose(run.answer_curves, [[0.75, np.nan, np.nan, 0.35], [np.nan] * 4])
    np.testing.assert_allclose(run.rates().answered, [1.0, 0.35, np.nan])
    np.testing.assert_array_equal(run.correct, [[10, 10], [0, 7], [0, 6]])


def test_the_curve_of_answers_counts_the_questions_of_all_kinds_together(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, answers={(0, "left"): (30, 30), (0, "above"): (10, 10)})
    append(record.answers, 1, 100, "left", 30, 15)
    append(record.answers, 1, 100, "above", 10, 9)
    run = Scores.from_record(record, partial=True)
    assert run.answer_curves[0, 0] == (15 + 9) / (30 + 10)


def test_the_episodes_on_the_way_weigh_as_often_as_they_were_drawn(scores: Callable[..., Scores]) -> None:
    outcomes = np.array([[[[1, 0]], [[0, 1]]]])  # one stage, two points on the way, one skill, two episodes
    run = scores(np.ones((2, 3, 4)), retained_curves=outcomes, steps=(1, 2, 4))
    assert run.layout.curve_episodes == (0, 1)
    counts = np.empty((4, 3, 4))
    counts[:] = np.array([[1, 1, 1, 1], [3, 1, 0, 0], [0, 2, 1, 1], [0, 0, 4, 0]])[:, None]
    curves = run.rates(counts).retained_curves[:, 0, :, 0]
    # The last draw holds neither of the two: both count alike.
    np.testing.assert_allclose(curves, [[0.5, 0.5, 1], [0.75, 0.25, 1], [0.0, 1.0, 1], [0.5, 0.5, 1]])


def test_every_array_of_rates_has_the_batch_axes(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, **ALL, curve_episodes=10, answers={(1, "left"): (8, 6)})
    rates, alone = run.rates(np.ones((3, 2, 5, 20))), run.rates()
    names = ("success", "curves", *ARRAYS[2:])
    for name in names:
        both = getattr(rates, name)
        np.testing.assert_allclose(both, np.broadcast_to(getattr(alone, name), both.shape))
        assert both.shape[:2] == (3, 2)
    for name in names:
        np.testing.assert_allclose(getattr(rates.mean_over_runs(), name)[0], getattr(alone, name))


PERTURBED = [[0.9, 0.7], [0.5, 0.8], [0.4, 0.2]]


def test_perturbed_episodes_are_scores_of_their_own_and_change_no_other(
    scores: Callable[..., Scores],
) -> None:
    plain, run = scores(MATRIX, **ALL), scores(MATRIX, perturbed=PERTURBED, **ALL)
    np.testing.assert_allclose(run.perturbed.mean(axis=-1)[:, :2], PERTURBED)
    np.testing.assert_allclose(run.rates().perturbed[:, :2], PERTURBED)
    assert np.isnan(plain.perturbed).all()
    assert np.isnan(plain.rates().perturbed).all()
    assert run.layout == plain.layout
    for name in set(ARRAYS) - {"perturbed"}:
        np.testing.assert_array_equal(getattr(run, name), getattr(plain, name))
    both = rates_of([plain, run], {})
    np.testing.assert_allclose(both.perturbed[1][:, :2], PERTURBED)
    assert np.isnan(both.mean_over_runs().perturbed).all()  # a mean over some seeds alone would be another


def test_perturbed_episodes_are_drawn_with_episodes_of_the_same_number(scores: Callable[..., Scores]) -> None:
    generator = np.random.default_rng(0)
    outcomes = generator.integers(2, size=(3, 5, 6)).astype(float)
    run = scores(outcomes, perturbed=1 - outcomes[:, :2])
    counts = generator.multinomial(6, [1 / 6] * 6, size=(4, 5)).astype(float)
    rates = run.rates(counts)
    np.testing.assert_allclose(rates.perturbed[..., :2], 1 - rates.retained)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, "159 are perturbed, not 160: the retained skills and the stage's target have perturbed test"),
        (
            {"task": "target_0"},
            "the perturbed episode 19 of target_0 at stage 2, step 400, must not be there",
        ),
        ({"task": "unseen_0"}, "the perturbed episode 19 of unseen_0"),
        ({"episode": 20}, "the perturbed episode 20 of target_1"),
        ({"step": 300}, "the perturbed episode 19 of target_1 at stage 2, step 300, must not be there"),
        ({"episode": 3}, "an episode is there twice"),
    ],
)
def test_perturbed_episodes_other_than_the_test_episodes_are_refused(
    change: dict[str, Any], words: str, make_record: MakeRecord
) -> None:
    record = make_record(MATRIX, perturbed=PERTURBED)
    last = {name: column.pop() for name, column in record.episodes.items()}
    assert (last["split"], last["task"], last["episode"]) == ("perturbed", "target_1", 19)
    if change:
        append(record.episodes, *{**last, **change}.values())
    with pytest.raises(RecordError, match=words):
        Scores.from_record(record, partial=True)


def test_a_perturb_run_without_perturbed_episodes_is_refused(make_record: MakeRecord) -> None:
    with pytest.raises(RecordError, match="0 are perturbed, not 160"):
        Scores.from_record(make_record(MATRIX, perturb=True), partial=True)


def test_a_tuning_run_with_perturbed_episodes_is_refused(make_record: MakeRecord) -> None:
    with pytest.raises(RecordError, match="a tuning run has only validation episodes"):
        Scores.from_record(make_record(MATRIX, perturbed=PERTURBED, split="validation"), partial=True)


def test_a_stage_ends_at_the_last_of_the_evaluation_steps(scores: Callable[..., Scores]) -> None:
    rates = scores(MATRIX, curves=[[0.4], [0.5]], steps=(10, 25)).rates()
    np.testing.assert_allclose(rates.learned, [0.9, 0.8])
    np.testing.assert_allclose(rates.learning_curves, [[0.4, 0.9], [0.5, 0.8]])


def test_validation_episodes_are_no_scores(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, **ALL)
    before = Scores.from_record(record, partial=True)
    append(record.episodes, 2, 400, "skill_0", "validation", 20, 1, 1.0, 5)
    after = Scores.from_record(record, partial=True)
    assert after.layout == before.layout
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_a_tuning_run_is_scored_on_its_validation_episodes(scores: Callable[..., Scores]) -> None:
    run = scores(MATRIX, **ON_THE_WAY, episodes=10, split="validation")
    assert run.layout.episodes == run.layout.curve_episodes == run.layout.validation_episodes
    np.testing.assert_allclose(run.success.mean(axis=-1), MATRIX)
    np.testing.assert_allclose(run.rates().retained_curves[:, :-1], RETAINED_CURVES)


def test_a_tuning_run_with_a_test_episode_is_refused(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, episodes=10, split="validation")
    record.episodes["split"][0] = "test"
    with pytest.raises(RecordError, match="tuning run"):
        Scores.from_record(record, partial=True)


def test_the_order_of_rows_does_not_matter(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, **ALL, answers={(2, "b"): (9, 3), (2, "a"): (5, 4)})
    scores = Scores.from_record(record, partial=True)
    order = np.random.default_rng(0).permutation(len(record.episodes["stage"]))
    record.episodes = {name: [column[n] for n in order] for name, column in record.episodes.items()}
    record.answers = {name: column[::-1] for name, column in record.answers.items()}
    record.policy = {name: column[::-1] for name, column in record.policy.items()}
    shuffled = Scores.from_record(record, partial=True)
    assert shuffled.layout == scores.layout
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(shuffled, name), getattr(scores, name))


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("task", "juggle", "juggle"),
        ("stage", 3, "impossible"),
        ("stage", -1, "impossible"),
        ("stage", True, "impossible"),
        ("stage", 1, "not an evaluation point"),
        ("step", 10**30, "impossible"),
        ("step", 1.5, "impossible"),
        ("step", 100, "not an evaluation point"),
        ("episode", None, "impossible"),
        ("episode", 1, "twice"),
        ("split", "training", "'training', which is none of validation, test, perturbed"),
        ("split", [], "which is none of validation, test, perturbed"),
        ("split", "perturbed", "there are perturbed ones, but its run does not say perturb"),
        ("success", 0.5, "neither true nor false"),
        ("success", "yes", "neither true nor false"),
        ("success", None, "neither true nor false"),
        ("success", [], "neither true nor false"),
    ],
)
def test_an_impossible_episode_is_refused(
    column: str, value: Any, words: str, make_record: MakeRecord
) -> None:
    record = make_record(MATRIX)
    record.episodes[column][0] = value
    with pytest.raises(RecordError, match=words):
        Scores.from_record(record, partial=True)


def test_an_episode_with_two_outcomes_is_refused(make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    first = [column[0] for column in record.episodes.values()]
    append(record.episodes, *first[:5], 1 - first[5], *first[6:])
    with pytest.raises(RecordError, match="an episode is there twice"):
        Scores.from_record(record, partial=True)


@pytest.mark.parametrize("split", ["test", "validation"])
def test_an_episode_at_a_step_between_the_evaluation_points_is_refused(
    split: str, make_record: MakeRecord
) -> None:
    record = make_record(MATRIX)
    append(record.episodes, 1, 150, "target_0", split, 0, 1, 1.0, 5)
    with pytest.raises(RecordError, match="stage 1, step 150, which is not an evaluation point"):
        Scores.from_record(record, partial=True)


@pytest.mark.parametrize(
    "row",
    [
        (2, 400, "left", 5, 6),
        (2, 400, "left", -1, -2),
        (3, 400, "left", 5, 5),
        (2, 150, "left", 5, 5),
        (0, 400, "left", 5, 5),
        (2, None, "left", 5, 5),
        (2, 400, 7, 5, 5),
        (2, 400, "left", "5", 5),
        (0, 0, "left", 10, 1),
        (2, 400, "left", 10**40, 1),
    ],
)
def test_an_impossible_answer_count_is_refused(row: tuple[Any, ...], make_record: MakeRecord) -> None:
    record = make_record(MATRIX, answers={(0, "left"): (10, 9)})
    append(record.answers, *row)
    with pytest.raises(RecordError, match="answers"):
        Scores.from_record(record, partial=True)


@pytest.mark.parametrize(
    "row",
    [
        (1, 100, 0.5, 0.1, None, None),
        (3, 400, 0.5, 0.1, None, None),
        (1, 150, 0.5, 0.1, None, None),
        (0, 100, 0.5, 0.1, None, None),
        (2, 400, 1.5, 0.1, None, None),
        (2, 400, -0.5, 0.1, None, None),
        (2, 400, True, 0.1, None, None),
        (2, 400, "0.5", 0.1, None, None),
        (2, 400, 0.5, -0.1, None, None),
        (2, 400, 0.5, float("nan"), None, None),
        (2, 400, 0.5, 10**300, None, None),
        (2, 400, 0.5, [1], None, None),
        (2, 400, 0.5, 0.1, -0.5, None),
        (2, 400, 0.5, 0.1, 10**300, None),
        (2, 400, 0.5, 0.1, 0.5, -0.1),
        (2, 400, 0.5, 0.1, 0.5, 1.1),
    ],
)
def test_an_impossible_row_of_the_policy_table_is_refused(
    row: tuple[Any, ...], make_record: MakeRecord
) -> None:
    record = make_record(MATRIX, sparsity=[[0.5] * 4, [np.nan] * 4])
    record.policy = {name: column[:-1] for name, column in record.policy.items()}
    Scores.from_record(record, partial=True)
    append(record.policy, *row)
    with pytest.raises(RecordError, match="policy"):
        Scores.from_record(record, partial=True)


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("column", ["shift", "captured"])
def test_what_only_the_end_of_a_targets_stage_has_is_refused_before(
    row: int, column: str, make_record: MakeRecord
) -> None:
    record = make_record(MATRIX, shift=SHIFT, captured=CAPTURED)
    record.policy[column][row] = 0.5
    with pytest.raises(RecordError, match="only the end of a target's stage has"):
        Scores.from_record(record, partial=True)


@pytest.mark.parametrize("names", [["target_0"], ["skill_0", "skill_0"]])
def test_a_task_name_that_occurs_twice_is_refused(names: list[str], make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    record.scenario.retained = names
    with pytest.raises(RecordError, match="scenario: a task name occurs twice"):
        Scores.from_record(record, partial=True)


@pytest.mark.parametrize("steps", [[], [400, 100], [400, 400], [0, 400], [100, 10**9 + 1]])
def test_a_scenario_without_clear_evaluation_steps_is_refused(
    steps: list[int], make_record: MakeRecord
) -> None:
    record = make_record(MATRIX)
    record.scenario.evaluation_steps = steps
    with pytest.raises(RecordError, match="evaluation_steps"):
        Scores.from_record(record, partial=True)


def test_a_record_without_test_episodes_is_refused(make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    record.episodes["split"] = ["validation"] * len(record.episodes["split"])
    with pytest.raises(RecordError, match="no test episode"):
        Scores.from_record(record, partial=True)


def test_runs_of_different_layouts_do_not_mix(scores: Callable[..., Scores]) -> None:
    with pytest.raises(ValueError, match="do not mix"):
        rates_of([scores(MATRIX), scores(MATRIX, episodes=10)], {})
    with pytest.raises(ValueError, match="do not mix"):
        rates_of([scores(MATRIX)], {"from_scratch": [scores(MATRIX, steps=(200,))]})
    with pytest.raises(ValueError, match="do not mix"):
        rates_of([scores(MATRIX, **ALL), scores(MATRIX, **ALL, validation_episodes=20)], {})


@pytest.mark.parametrize("name", ["validation_episodes", "test_episodes", "curve_episodes"])
def test_a_budget_that_would_take_all_memory_is_refused(name: str, make_record: MakeRecord) -> None:
    record = make_record(MATRIX, groups=(2, 2, 1))
    record.scenario.budget[name] = 10_001
    with pytest.raises(RecordError, match="tasks x episodes are 5 x 10,001, and the limit is 20,000"):
        Scores.from_record(record, partial=True)


def test_a_budget_of_exactly_the_most_cells_is_read(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, groups=(2, 2, 1))
    record.scenario.budget["test_episodes"] = 20_000 // 5
    np.testing.assert_allclose(Scores.from_record(record, partial=True).success.mean(axis=-1), MATRIX)


@pytest.mark.parametrize("name", ["validation_episodes", "test_episodes", "curve_episodes"])
def test_a_budget_of_fewer_than_no_episodes_is_refused(name: str, make_record: MakeRecord) -> None:
    record = make_record(MATRIX)
    record.scenario.budget[name] = -1
    with pytest.raises(RecordError, match=f"{name} of its budget must be a whole number, not -1"):
        Scores.from_record(record, partial=True)


def test_a_record_counts_the_steps_of_its_preparation(make_record: MakeRecord) -> None:
    record = make_record(MATRIX, steps=(100,), ends=(8, 12))
    record.costs = dataclasses.replace(record.costs, optimiser_steps=20, preparation_steps=300)
    with pytest.raises(RecordError, match="20 optimiser steps are fewer than the 320 of the preparation"):
        Scores.from_record(record, partial=True)
