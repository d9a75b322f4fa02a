"""The evaluation protocol: its points and episodes, against a count by hand."""

import dataclasses

from clbench.spec.protocol import EpisodeKey, Point, Protocol

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
    perturbed = dataclasses.replace(PROTOCOL, perturb=True)
    extra = set(perturbed.episodes(Point(1, 20))) - set(PROTOCOL.episodes(Point(1, 20)))
    assert extra == {EpisodeKey(task, "perturbed", number) for task in "ab" for number in range(3)}
    assert perturbed.episodes(Point(1, 10)) == PROTOCOL.episodes(Point(1, 10))


def test_no_episode_is_played_twice_at_a_point() -> None:
    perturbed = dataclasses.replace(PROTOCOL, perturb=True)
    for stage in perturbed.stages:
        for point in perturbed.points(stage):
            keys = perturbed.episodes(point)
            assert len(set(keys)) == len(keys)
