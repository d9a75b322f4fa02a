"""Definitions of other papers against matrices worked by hand and against plain loops."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from clbench.scoring.intervals import estimate
from clbench.scoring.metrics import METRICS, load_metric, measure
from clbench.scoring.scores import Scores, rates_of

MODULE = "clbench.scoring.published"

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
BY_HAND = {
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


@pytest.mark.parametrize("name", BY_HAND)
def test_a_published_definition_has_the_value_worked_out_by_hand(
    name: str, scores: Callable[..., Scores]
) -> None:
    run = scores(PUBLISHED, curves=OWN_CURVES, retained_curves=SKILL_CURVES)
    assert measure(name, run, {"joint": scores(JOINT)}) == pytest.approx(BY_HAND[name])


def test_every_published_definition_is_worked_out_by_hand() -> None:
    assert {name for name, metric in METRICS.items() if metric.function.__module__ == MODULE} == set(BY_HAND)


@pytest.mark.long
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
        assert set(expected[0]) == set(BY_HAND)
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
    values: dict[str, float | None] = dict.fromkeys(BY_HAND)
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
        # the clipped difference, or the plain one
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


def test_with_one_target_metrics_that_compare_later_stages_are_none(scores: Callable[..., Scores]) -> None:
    run = scores([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]])
    names = [name for name, metric in METRICS.items() if "fewer than two targets" in metric.missing]
    assert len(names) == 18
    assert {measure(name, run) for name in names} == {None}


def test_without_joint_intransigence_is_none(scores: Callable[..., Scores]) -> None:
    assert measure("intransigence", scores(PUBLISHED)) is None


def test_a_target_without_any_success_leaves_no_share_of_the_highest(scores: Callable[..., Scores]) -> None:
    run = scores(skill_and([[0.0, 0, 0], [0.0, 0.9, 0], [0.0, 0.9, 0.9]]))
    assert measure("isolated_forgetting_cora", run) is None
    assert measure("isolated_zero_shot_transfer_cora", run) == pytest.approx(0)


@pytest.mark.parametrize(
    ("name", "without", "words"),
    [
        ("isolated_forgetting_cora", 2, "the success on one before the last is missing or always 0"),
        ("isolated_zero_shot_transfer_cora", 0, "the success on one after the first is missing or always 0"),
    ],
)
def test_a_share_of_the_highest_needs_no_success_on_the_one_target_that_its_reason_leaves_out(
    name: str, without: int, words: str, scores: Callable[..., Scores]
) -> None:
    targets = np.full((3, 3), 0.9)
    targets[:, without] = 0
    assert measure(name, scores(skill_and(targets))) is not None
    assert words in METRICS[name].missing


def test_the_highest_success_on_a_target_may_be_the_one_before_any_target(
    scores: Callable[..., Scores],
) -> None:
    run = scores([[0.8, 0.0], [0.4, 0.0], [0.2, 0.9]], groups=(0, 2, 0))
    assert measure("isolated_forgetting_cora", run) == pytest.approx((0.4 - 0.2) / 0.8)


def test_skills_that_were_not_evaluated_on_the_way_have_no_minimum(scores: Callable[..., Scores]) -> None:
    assert measure("minimum_retention", scores(PUBLISHED, curves=OWN_CURVES)) is None


def test_a_missing_cell_of_a_target_leaves_no_value_that_needs_it(scores: Callable[..., Scores]) -> None:
    matrix = np.array(PUBLISHED)
    matrix[2, 1] = np.nan
    run = scores(matrix, curves=OWN_CURVES, retained_curves=SKILL_CURVES)
    values = {name: measure(name, run, {"joint": scores(JOINT)}) for name in BY_HAND}
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


@pytest.mark.long
def test_every_published_definition_has_an_interval(scores: Callable[..., Scores]) -> None:
    curves = {"curves": OWN_CURVES, "retained_curves": SKILL_CURVES}
    runs = {seed: scores(PUBLISHED, **curves) for seed in range(3)}
    references = dict.fromkeys(("from_scratch", "joint", "sft"), runs)
    rows = estimate(METRICS, runs, np.random.default_rng(0), references=references)
    assert all(rows[name].low is not None for name in BY_HAND)
