"""The evaluation protocol: its points and episodes, against a count by hand."""

import dataclasses
from itertools import pairwise
from typing import Any

import pytest

from clbench.base.errors import ClbenchError
from clbench.spec.budget import Budget
from clbench.spec.protocol import EpisodeKey, Point, Protocol, check_steps

PROTOCOL = Protocol(
    retained=("a", "b"),
    target=("c", "d"),
    held_out=("e",),
    steps=(10, 20),
    validation_episodes=2,
    test_episodes=3,
    curve_episodes=1,
)


def test_a_stage_ends_at_its_last_step_and_stage_0_has_none() -> None:
    assert PROTOCOL.points(0) == (Point(0, 0),)
    assert PROTOCOL.points(2) == (Point(2, 10), Point(2, 20))
    ends = [PROTOCOL.is_end(point) for point in (Point(0, 0), Point(1, 10), Point(1, 20))]
    assert ends == [True, False, True]


def test_before_any_target_all_tasks_have_their_test_episodes() -> None:
    expected = [EpisodeKey(task, "test", number) for task in "abcde" for number in range(3)]
    assert PROTOCOL.episodes(Point(0, 0)) == expected


def test_on_the_way_the_stage_shows_the_skills_and_its_target() -> None:
    assert PROTOCOL.episodes(Point(2, 10)) == [
        EpisodeKey("a", "test", 0),
        EpisodeKey("b", "test", 0),
        EpisodeKey("d", "test", 0),
        EpisodeKey("d", "validation", 0),
        EpisodeKey("d", "validation", 1),
    ]


def test_a_tuning_run_has_validation_episodes_alone() -> None:
    tuning = dataclasses.replace(PROTOCOL, split="validation")
    points = [point for stage in tuning.stages for point in tuning.points(stage)]
    assert {key.split for point in points for key in tuning.episodes(point)} == {"validation"}
    assert len(tuning.episodes(Point(1, 20))) == 5 * 2
    assert len(tuning.episodes(Point(1, 10))) == 3 * 2


def test_perturbed_episodes_repeat_the_test_episodes_on_the_skills_at_the_ends() -> None:
    perturbed, target = dataclasses.replace(PROTOCOL, perturb=True), PROTOCOL.target[0]
    extra = set(perturbed.episodes(Point(1, 20))) - set(PROTOCOL.episodes(Point(1, 20)))
    assert extra == {
        EpisodeKey(task, "perturbed", number) for task in ("a", "b", target) for number in range(3)
    }
    assert perturbed.episodes(Point(1, 10)) == PROTOCOL.episodes(Point(1, 10))


def test_no_episode_is_played_twice_at_a_point() -> None:
    perturbed = dataclasses.replace(PROTOCOL, perturb=True)
    for stage in perturbed.stages:
        for point in perturbed.points(stage):
            keys = perturbed.episodes(point)
            assert len(set(keys)) == len(keys)


# ---- stages with a criterion -------------------------------------------------------------------------------

TO_CRITERION = dataclasses.replace(PROTOCOL, steps=(100,), criterion=0.9, validation_episodes=20)


def test_checks_are_close_at_first_and_about_an_eighth_apart_later() -> None:
    steps = check_steps(1000)
    assert steps[:12] == (0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22)
    assert steps[-1] == 1000
    assert all(0 < later - step <= max(2, 0.12 * step + 0.5) for step, later in pairwise(steps))
    assert check_steps(5) == (0, 2, 4, 5)


def test_the_criterion_is_a_share_of_the_validation_episodes() -> None:
    assert TO_CRITERION.goal == 18
    assert [TO_CRITERION.is_learned(successes) for successes in (17, 18, 20)] == [False, True, True]
    assert not PROTOCOL.is_learned(2)
    assert dataclasses.replace(TO_CRITERION, criterion=0.7, validation_episodes=10).goal == 7


def test_with_a_criterion_every_evaluated_point_of_a_stage_is_its_end() -> None:
    assert TO_CRITERION.is_end(Point(2, 14))  # before the run every step may be the end
    finished = dataclasses.replace(TO_CRITERION, ends=(14, 100))
    assert finished.points(1) == (Point(1, 14),)
    assert [finished.is_end(point) for point in (Point(1, 14), Point(1, 100), Point(2, 100))] == [
        True,
        False,
        True,
    ]
    assert {key.split for key in finished.episodes(Point(1, 14))} == {"test"}
    assert len(finished.episodes(Point(1, 14))) == 5 * 3


@pytest.mark.parametrize("criterion", [0, -0.5, 1.1])
def test_a_criterion_that_is_no_success_rate_is_refused(criterion: float) -> None:
    with pytest.raises(ValueError, match=r"Budget\.criterion must be a success rate"):
        Budget(criterion=criterion)


@pytest.mark.parametrize("criterion", ["0.9", True])
def test_a_criterion_that_is_no_number_is_refused(criterion: Any) -> None:
    with pytest.raises(ClbenchError, match=r"Budget\.criterion must be a .*number"):
        Budget(criterion=criterion)


def test_a_budget_with_a_criterion_has_its_checks_and_one_evaluation_point() -> None:
    budget = Budget(criterion=0.9, adaptation_steps=50)
    assert budget.check_steps == check_steps(50)
    assert budget.evaluation_steps == (50,)
    assert Budget().check_steps == ()


def test_a_goal_is_a_whole_number_of_successes_whatever_the_last_bit_of_the_criterion() -> None:
    hundred = dataclasses.replace(PROTOCOL, validation_episodes=100)
    assert 0.55 * 100 > 55
    goals = [dataclasses.replace(hundred, criterion=one).goal for one in (0.5, 0.501, 0.55, 1.0)]
    assert goals == [50, 51, 55, 100]
