"""Completeness: a record holds exactly the results that its budget demands."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence, Set
from itertools import groupby
from operator import attrgetter

from clbench.records.reader import RecordError
from clbench.records.record import EpisodeRow, Record
from clbench.spec.policies import is_built_in
from clbench.spec.protocol import Point, Protocol

_Key = tuple[str, str, int]
"""The fields of an `EpisodeKey`."""


def check_complete(record: Record, rows: Iterable[EpisodeRow], protocol: Protocol) -> None:
    """Refuse a record that does not hold what its budget demands: left-out results would change the scores.

    A method of whole stages, and a policy that was trained elsewhere, are evaluated only at the ends of
    stages. A policy that was trained elsewhere has no answers and no changes of the policy, and a policy that
    is not built in may have no answers.

    Args:
        record: The record; its values have been checked one by one.
        rows: Its episodes.
        protocol: Its protocol.

    Raises:
        RecordError: Something is missing, or must not be there.
    """
    points = _check_episodes(rows, protocol)
    elsewhere = record.run.trained_elsewhere
    demanded = 0 if elsewhere else record.scenario.budget.get("test_questions", 0)
    if not is_built_in(record.run.policy) and not sum(record.answers["asked"]):
        demanded = 0
    _check_answers(record, points, demanded)
    moved = [Point(row.stage, row.step) for row in record.policy_rows()]
    _check_points("policy", moved, () if elsewhere else points)


def _check_answers(record: Record, points: Sequence[Point], demanded: int) -> None:
    """Check that the same questions were asked at all points, and as many as the budget demands."""
    asked: dict[Point, dict[str, int]] = {}
    for row in record.answer_rows():
        asked.setdefault(Point(row.stage, row.step), {})[row.kind] = row.asked
    if not asked and not demanded:  # a scenario without questions
        return
    _check_points("answers", asked, points)
    for point in points:
        if asked[point] != asked[points[0]]:
            raise RecordError(f"answers: {_at(point)} other questions were asked than before any target.")
    total = sum(asked[points[0]].values())
    if total != demanded:
        raise RecordError(f"answers: {total:,} questions were asked, not {demanded:,}.")


def _check_episodes(rows: Iterable[EpisodeRow], protocol: Protocol) -> Sequence[Point]:
    """Check the episodes, and return the points at which the policy was evaluated, in their order."""
    played: dict[Point, set[_Key]] = defaultdict(set)
    # by groups: with objects for each row, a board of 832 records took 43 s instead of 37
    for (stage, step), at_point in groupby(rows, key=attrgetter("stage", "step")):
        played[Point(stage, step)].update(map(attrgetter("task", "split", "episode"), at_point))
    ends = [protocol.end(stage) for stage in protocol.stages]
    every = [point for stage in protocol.stages for point in protocol.points(stage)]
    expected = ends if set(played) <= set(ends) else every
    _check_points("episodes", played, expected)
    for point in expected:
        demanded: set[_Key] = set(protocol.episodes(point))
        _refuse(demanded - played[point], "is missing", point)
        _refuse(played[point] - demanded, "must not be there", point)
    return expected


def _refuse(keys: Set[_Key], why: str, point: Point) -> None:
    """Refuse a record with wrong episodes at a point, if there are any."""
    if keys:
        task, split, number = min(keys)
        others = f" (and {len(keys) - 1} others)" if len(keys) > 1 else ""
        raise RecordError(f"episodes: the {split} episode {number} of {task}{others} {why} {_at(point)}.")


def _check_points(table: str, found: Iterable[Point], expected: Sequence[Point]) -> None:
    missing, foreign = set(expected) - set(found), set(found) - set(expected)
    if missing:
        raise RecordError(f"{table}: there are none {_at(min(missing))}.")
    if foreign:
        raise RecordError(f"{table}: there must be none {_at(min(foreign))}.")


def _at(point: Point) -> str:
    return f"at stage {point.stage}, step {point.step}"
