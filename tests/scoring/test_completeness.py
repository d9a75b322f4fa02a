"""A record holds what its budget demands: what is left out, or added, is refused with its place."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from clbench.records.reader import RecordError
from clbench.records.record import EXTERNAL_USES, AnswerRow, EpisodeRow, PolicyRow, Record
from clbench.scoring.scores import Scores

ANSWERS = {(stage, kind): (25, 20) for stage in range(3) for kind in ("left", "above")}


@pytest.fixture
def record(make_record: Callable[..., Record]) -> Record:
    """A whole record of two targets, with 50 questions at each point."""
    given = {"curves": np.full((2, 3), 0.4), "retained_curves": np.full((2, 3, 2), 0.7)}
    return make_record(np.full((3, 5), 0.5), answers=ANSWERS, curve_episodes=10, **given)


def without(columns: dict[str, list[Any]], keep: Callable[[tuple[Any, ...]], bool]) -> dict[str, list[Any]]:
    """Return the columns of a table without the rows that are not to be kept."""
    rows = [row for row in zip(*columns.values(), strict=True) if keep(row)]
    return {name: [row[place] for row in rows] for place, name in enumerate(columns)}


def refused(record: Record, words: str) -> None:
    with pytest.raises(RecordError, match=words):
        Scores.from_record(record)
    Scores.from_record(record, partial=True)  # nothing in it is impossible


def test_a_whole_record_counts(record: Record) -> None:
    assert Scores.from_record(record).asked.sum(axis=-1).tolist() == [50, 50, 50]


def at_the_ends_alone(record: Record) -> None:
    """Leave nothing in a record but what was measured at the ends of stages."""
    for name in ("episodes", "answers", "policy"):
        setattr(record, name, without(getattr(record, name), lambda row: row[1] in (0, 400)))


@pytest.mark.parametrize("demanded", [40, 60])
def test_as_many_questions_as_the_budget_demands_must_be_asked(record: Record, demanded: int) -> None:
    record.scenario.budget["test_questions"] = demanded
    refused(record, f"answers: 50 questions were asked, not {demanded}")


def test_at_every_point_the_same_questions_must_be_asked(record: Record) -> None:
    rows = zip(record.answers["stage"], record.answers["step"], strict=True)
    first = list(rows).index((1, 400))
    record.answers["asked"][first : first + 2] = [24, 26]  # as many in all, of other kinds
    refused(record, "answers: at stage 1, step 400 other questions were asked than before any target")


def test_only_a_policy_that_is_not_built_in_may_have_no_answers(record: Record) -> None:
    record.answers = {name: [] for name in record.answers}
    refused(record, "answers: there are none at stage 0, step 0")
    record.run.policy = "mine:Policy"
    assert Scores.from_record(record).asked.sum() == 0


def test_a_policy_that_is_not_built_in_and_answers_questions_is_asked_all_of_them(record: Record) -> None:
    record.run.policy = "mine:Policy"
    assert Scores.from_record(record).asked.sum(axis=-1).tolist() == [50, 50, 50]
    record.scenario.budget["test_questions"] = 60
    refused(record, "answers: 50 questions were asked, not 60")


def test_a_policy_that_was_trained_elsewhere_has_neither_answers_nor_changes_of_the_policy(
    record: Record,
) -> None:
    at_the_ends_alone(record)
    record.run.uses = dict(EXTERNAL_USES)
    refused(record, "answers: 50 questions were asked, not 0")
    record.answers = {name: [] for name in record.answers}
    refused(record, "policy: there must be none at stage 0, step 0")
    record.policy = {name: [] for name in record.policy}
    assert record.scenario.budget["test_questions"] == 50
    scores = Scores.from_record(record)
    assert scores.asked.sum() == 0
    assert np.isnan(scores.activation_drift).all()


@pytest.mark.parametrize(
    ("step", "task", "split", "number"),
    [
        (100, "target_0", "test", 9),
        (400, "unseen_0", "test", 0),
        (400, "target_0", "validation", 9),
    ],
)
def test_an_episode_that_is_left_out_is_named(
    step: int, task: str, split: str, number: int, record: Record
) -> None:
    lost = (1, step, task, split, number)
    record.episodes = without(record.episodes, lambda row: row[:5] != lost)
    refused(record, f"the {split} episode {number} of {task} is missing at stage 1, step {step}")


def test_an_episode_that_is_not_planned_at_its_point_is_named(record: Record) -> None:
    record.add_episode(EpisodeRow(1, 100, "target_0", "test", 10, 1, 1.0, 5))  # ten are played on the way
    refused(record, "the test episode 10 of target_0 must not be there at stage 1, step 100")


def test_a_record_with_the_ends_of_stages_alone_is_whole_and_one_with_some_points_is_not(
    record: Record,
) -> None:
    at_the_ends_alone(record)
    ends = Scores.from_record(record)
    assert np.isnan(ends.on_the_way).all()
    assert ends.layout.curve_episodes == tuple(range(10))  # those that others have
    record.add_episode(EpisodeRow(1, 100, "target_0", "test", 0, 1, 1.0, 5))
    refused(record, "episodes: there are none at stage 1, step 200")


def test_the_policy_is_measured_at_all_points_and_at_no_other(record: Record) -> None:
    whole = record.policy
    record.policy = without(whole, lambda row: row[:2] != (2, 300))
    refused(record, "policy: there are none at stage 2, step 300")
    tables = ("episodes", "answers")
    for name in tables:
        setattr(record, name, without(getattr(record, name), lambda row: row[1] in (0, 400)))
    record.policy = without(whole, lambda row: row[1] in (0, 400))
    record.add_policy(PolicyRow(1, 200, None, None, None, None))
    refused(record, "policy: there must be none at stage 1, step 200")


def test_questions_are_asked_only_where_episodes_are_played(record: Record) -> None:
    at_the_ends_alone(record)
    record.add_answers(AnswerRow(1, 200, "left", 25, 20))
    refused(record, "answers: there must be none at stage 1, step 200")
