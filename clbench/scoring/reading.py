"""Rows of a record, checked against its evaluation protocol: what scores are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from clbench.records.reader import RecordError
from clbench.records.record import FARTHEST, CheckRow, EpisodeRow, Record
from clbench.scoring.layout import Array
from clbench.spec.protocol import SPLITS, Point, Protocol, check_steps

MOST = 10**9
"""More steps, episodes or questions than any run has: a larger number is a sign of damage."""

MOST_OF_ALL = 1e18
"""Greatest number, of anything, that can be used."""

MOST_POINTS = 100
"""Most evaluation points of a stage."""

MOST_CELLS = 20_000
"""Most cells of a table of rates, for example stages x points x tasks: 2,000 replicates of it take 320 MB.
FetchPixels-v0 has 240, a sequence of 40 targets among 50 tasks 8,200."""

_HIGHEST = {"update_sparsity": 1.0, "activation_drift": FARTHEST, "shift": FARTHEST, "captured": 1.0}
"""Greatest possible value of each change of the policy, in the order of the columns."""


def read_protocol(record: Record) -> Protocol:
    """Return the evaluation protocol that a record states.

    Raises:
        RecordError: Names of tasks, evaluation steps or counts of episodes are impossible, or the scenario is
            too large to be shown.
    """
    scenario = record.scenario
    names = [*scenario.retained, *scenario.target, *scenario.held_out]
    tasks = len(names)
    if len(set(names)) != tasks:
        raise RecordError("scenario: a task name occurs twice.")
    _check_evaluation_steps(scenario.evaluation_steps)
    for name in ("validation_episodes", "test_episodes", "curve_episodes"):
        count = scenario.budget.get(name)
        if type(count) is not int or not 0 <= count <= MOST:
            raise RecordError(f"scenario: {name} of its budget must be a whole number, not {count!r}.")
    # few rows may ask for more memory than there is
    check_cells("stages x points x tasks", len(scenario.target) + 1, len(scenario.evaluation_steps), tasks)
    episodes = max(scenario.budget[f"{name}_episodes"] for name in ("validation", "test", "curve"))
    check_cells("tasks x episodes", tasks, episodes)
    criterion = scenario.budget.get("criterion")
    if criterion is None:
        if any(record.checks.values()):
            raise RecordError("checks: its budget has no criterion that could have been checked.")
        return scenario.protocol(record.run.split, record.run.perturb)
    if not is_number(criterion, 0, 1) or len(scenario.evaluation_steps) != 1:
        raise RecordError("scenario: a criterion must be a success rate, with one evaluation step.")
    if record.run.trained_elsewhere:  # it chose its own steps; its stages count as full ones
        if any(record.checks.values()):
            raise RecordError("checks: a policy that was trained elsewhere is not checked.")
        ends = tuple(scenario.evaluation_steps * len(scenario.target))
    else:
        ends = _read_ends(record)
    return scenario.protocol(record.run.split, record.run.perturb, ends)


def _read_ends(record: Record) -> tuple[int, ...]:
    """Return the steps of each stage, from its checks.

    Raises:
        RecordError: A check is impossible, a stage does not end with its criterion or its last step, or the
            run states fewer optimiser steps.
    """
    protocol = record.scenario.protocol(record.run.split, record.run.perturb)
    by_stage: dict[int, list[CheckRow]] = {stage: [] for stage in protocol.stages[1:]}
    for number, row in enumerate(record.check_rows()):
        where = f"checks: row {number}"
        if any(type(value) is not int for value in row) or row.stage not in by_stage:
            raise RecordError(f"{where} must hold whole numbers, and a stage of the run.")
        if not 0 <= row.successes <= row.episodes <= protocol.validation_episodes:
            raise RecordError(f"{where} has impossible counts of episodes.")
        by_stage[row.stage].append(row)
    planned = check_steps(protocol.steps[-1])
    for stage, rows in by_stage.items():
        where = f"checks: those of stage {stage}"
        if tuple(row.step for row in rows) != planned[: len(rows)] or not rows:
            raise RecordError(f"{where} are not at the steps that the protocol demands.")
        learned = [protocol.is_learned(row.successes) for row in rows]
        if any(learned[:-1]):
            raise RecordError(f"{where} go on after the criterion was met.")
        # a method that trains nothing is checked once
        if not learned[-1] and rows[-1].step not in (0, planned[-1]):
            raise RecordError(f"{where} end before the criterion was met.")
    ends = tuple(rows[-1].step for rows in by_stage.values())
    costs = record.costs
    least = sum(ends) + (costs.preparation_steps or 0)
    if costs.optimiser_steps is not None and costs.optimiser_steps < least:
        raise RecordError(
            f"costs: {costs.optimiser_steps} optimiser steps are fewer than the {least} of the preparation "
            "and of the stages, by its checks."
        )
    return ends


def read_checks(record: Record, protocol: Protocol) -> tuple[Array, Array]:
    """Return the steps to the criterion of each stage, and whether it was met, (targets,); NaN without one.

    A stage that never met it counts as the full budget of steps, even for a method that trains nothing and is
    checked once.
    """
    ends = dict.fromkeys(protocol.stages[1:], (math.nan, math.nan))
    for row in record.check_rows():
        met = protocol.is_learned(row.successes)
        ends[row.stage] = float(row.step if met else protocol.steps[-1]), float(met)
    steps, learned = np.array(list(ends.values())).reshape(-1, 2).T
    return steps, learned


def read_relearning(record: Record, protocol: Protocol) -> Array:
    """Return the optimiser steps to relearn the skill that succeeds least, (); NaN if not measured.

    Raises:
        RecordError: The skill, the successes or the steps are impossible.
    """
    found = record.relearning
    if found is None:
        return np.array(math.nan)
    if protocol.criterion is None:
        raise RecordError("relearning: its budget has no criterion that could have been met.")
    if found.skill not in protocol.retained:
        raise RecordError(f"relearning: {found.skill!r} is not a retained skill.")
    if not 0 <= found.successes <= protocol.validation_episodes:
        raise RecordError("relearning: it has an impossible number of successes.")
    planned = check_steps(protocol.steps[-1])
    if found.steps not in planned:
        raise RecordError("relearning: its steps are not those of a check.")
    if not found.met and found.steps != planned[-1]:
        raise RecordError("relearning: it ends before the criterion was met.")
    return np.array(float(found.steps))


def _check_evaluation_steps(steps: list[int]) -> None:
    """Refuse evaluation steps that are impossible, or too many to be shown."""
    if not steps or not 0 < min(steps) <= max(steps) <= MOST or steps != sorted(set(steps)):
        raise RecordError("scenario: evaluation_steps must be a list of rising whole numbers above 0.")
    if len(steps) > MOST_POINTS:
        raise RecordError(f"scenario: {len(steps):,} evaluation_steps; the limit is {MOST_POINTS}.")


def check_cells(what: str, *sizes: int) -> None:
    """Refuse a table that is too large to be resampled."""
    if math.prod(sizes) > MOST_CELLS:
        text = " x ".join(f"{size:,}" for size in sizes)
        raise RecordError(f"it is too large to be shown: {what} are {text}, and the limit is {MOST_CELLS:,}.")


def place(protocol: Protocol, point: Point) -> int:
    """Return the index of a point among the evaluation steps; the end of a stage may have index -1."""
    return protocol.steps.index(point.step) if point.stage and protocol.ends is None else -1


class _Points:
    """The evaluation points of a protocol, to check rows of tables against."""

    def __init__(self, protocol: Protocol) -> None:
        self.last = protocol.stages[-1]
        self.points = {point for stage in protocol.stages for point in protocol.points(stage)}

    def check(self, where: str, stage: Any, step: Any) -> Point:
        """Return the point of a row; refuse one that the protocol does not have."""
        whole = type(stage) is int and type(step) is int
        if not (whole and 0 <= stage <= self.last and 0 <= step <= MOST):
            raise RecordError(f"{where} has an impossible stage or step.")
        point = Point(stage, step)
        if point not in self.points:
            raise RecordError(f"{where} is of stage {stage}, step {step}, which is not an evaluation point.")
        return point


def read_episodes(record: Record, protocol: Protocol) -> list[EpisodeRow]:
    """Return all episodes of a record, each checked.

    Raises:
        RecordError: An episode is impossible, occurs twice, or is of another kind of run.
    """
    rows, known, points = record.episode_rows(), set(protocol.tasks), _Points(protocol)
    for number, row in enumerate(rows):
        where = f"episodes: row {number}"
        points.check(where, row.stage, row.step)
        if type(row.episode) is not int or not 0 <= row.episode <= MOST:
            raise RecordError(f"{where} has an impossible number of an episode.")
        if row.task not in known:
            raise RecordError(f"{where} is of a task that is not in the scenario: {row.task!r}.")
        if row.split not in SPLITS:
            raise RecordError(f"{where} has the split {row.split!r}, which is none of {', '.join(SPLITS)}.")
        if row.success not in (0, 1):
            raise RecordError(f"{where} has the success {row.success!r}, neither true nor false.")
        if row.total_reward is not None and not is_number(row.total_reward, -FARTHEST, FARTHEST):
            raise RecordError(f"{where} has an impossible return.")
        if type(row.length) is not int or not 0 <= row.length <= MOST:
            raise RecordError(f"{where} has an impossible length.")
    if len({row[:5] for row in rows}) != len(rows):
        raise RecordError("episodes: an episode is there twice.")
    _check_kinds(protocol, rows)
    check_cells("tasks x episodes", len(protocol.tasks), len(numbers(rows)))
    return rows


def _check_kinds(protocol: Protocol, rows: Iterable[EpisodeRow]) -> None:
    """Refuse a record without scored episodes, or with episodes that its kind of run does not have."""
    splits = {row.split for row in rows}
    if protocol.split not in splits:
        raise RecordError(f"episodes: there is no {protocol.split} episode.")
    if protocol.split == "validation" and len(splits) > 1:
        raise RecordError("episodes: a tuning run has only validation episodes.")
    if "perturbed" in splits and not protocol.perturb:
        raise RecordError("episodes: there are perturbed ones, but its run does not say perturb.")


def read_perturbed(
    protocol: Protocol, rows: Iterable[EpisodeRow], episodes: Iterable[int]
) -> list[EpisodeRow]:
    """Return the perturbed episodes among `rows`: all that the protocol demands, and no others.

    Args:
        protocol: Protocol of the run.
        rows: All episodes.
        episodes: Numbers of the scored episodes.

    Raises:
        RecordError: One is missing, or must not be there.
    """
    rule = "the retained skills and the stage's target have perturbed test episodes at the end of each stage"
    scored = set(episodes)
    found = [row for row in rows if row.split == "perturbed"]
    for row in found:
        tasks = protocol.perturbed_tasks(row.point.stage)
        if not (protocol.is_end(row.point) and row.task in tasks and row.episode in scored):
            where = f"of {row.task} at stage {row.point.stage}, step {row.point.step}"
            raise RecordError(
                f"episodes: the perturbed episode {row.episode} {where}, must not be there: {rule}."
            )
    tasks_played = sum(len(protocol.perturbed_tasks(stage)) for stage in protocol.stages)
    count = tasks_played * len(scored) if protocol.perturb else 0
    if len(found) != count:
        raise RecordError(f"episodes: {len(found):,} are perturbed, not {count:,}: {rule}.")
    return found


def numbers(rows: Iterable[EpisodeRow]) -> tuple[int, ...]:
    """Return the numbers of the episodes among `rows`, rising."""
    return tuple(sorted({row.episode for row in rows}))


def read_answers(record: Record, protocol: Protocol) -> tuple[tuple[str, ...], Array]:
    """Return the kinds of questions, and the counts of questions and of correct answers.

    Returns:
        The kinds, sorted, and the counts, (2, stages + 1, points, kinds).

    Raises:
        RecordError: A count is impossible, or a kind occurs twice at one point.
    """
    rows, points = record.answer_rows(), _Points(protocol)
    for number, (stage, step, kind, asked, correct) in enumerate(rows):
        where = f"answers: row {number}"
        points.check(where, stage, step)
        if any(type(value) is not int for value in (asked, correct)) or not isinstance(kind, str):
            raise RecordError(f"{where} must hold whole numbers and the name of a kind.")
        if not 0 <= correct <= asked <= MOST:
            raise RecordError(f"{where} has impossible numbers.")
    if len({row[:3] for row in rows}) != len(rows):
        raise RecordError("answers: a kind is there twice at one evaluation point.")
    kinds = tuple(sorted({row[2] for row in rows}))
    shape = len(protocol.stages), len(protocol.steps), len(kinds)
    check_cells("stages x points x kinds of questions", *shape)
    counts = np.zeros((2, *shape))
    for stage, step, kind, asked, correct in rows:
        counts[:, stage, place(protocol, Point(stage, step)), kinds.index(kind)] = asked, correct
    return kinds, counts


def read_policy(record: Record, protocol: Protocol) -> tuple[Array, Array, Array, Array]:
    """Return the changes of the policy.

    Returns:
        The update sparsity and the activation drift at the points of each stage, both (targets, points), and
        the shift and the captured share in each stage, both (targets,).

    Raises:
        RecordError: A value is impossible, or a point occurs twice.
    """
    rows, points = record.policy_rows(), _Points(protocol)
    found = np.full((len(_HIGHEST), len(protocol.stages), len(protocol.steps)), np.nan)
    for number, (stage, step, *values) in enumerate(rows):
        where = f"policy: row {number}"
        point = points.check(where, stage, step)
        for value, (name, high) in zip(values, _HIGHEST.items(), strict=True):
            if value is not None and not is_number(value, 0, high):
                raise RecordError(f"{where} has an impossible {name}.")
        if values[2:] != [None, None] and not (stage and protocol.is_end(point)):
            raise RecordError(f"{where} has a shift or a share, which only the end of a target's stage has.")
        found[:, stage, place(protocol, point)] = [np.nan if value is None else value for value in values]
    if len({row[:2] for row in rows}) != len(rows):
        raise RecordError("policy: an evaluation point is there twice.")
    sparsity, drift, shift, captured = found[:, 1:]
    return sparsity, drift, shift[:, -1], captured[:, -1]


def is_number(value: Any, low: float = -MOST_OF_ALL, high: float = MOST_OF_ALL) -> bool:
    """Return whether a value that a stranger wrote is a number from `low` to `high`."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
