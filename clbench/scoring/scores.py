"""Scores: what a record says as arrays, and the rates that metrics are computed from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from clbench.records.reader import RecordError
from clbench.records.record import EPISODE_COLUMNS, Record
from clbench.scoring.layout import Array, Layout, average
from clbench.scoring.rates import Rates, _check_same, combine
from clbench.spec.protocol import SPLITS
from clbench.spec.scenario import Group

MOST = 10**9
"""More steps, episodes or questions than any run has: a number beyond it is damage."""

MOST_POINTS = 100
"""Evaluation points of a stage."""

MOST_CELLS = 20_000
"""Cells of a table of rates, such as stages x points x tasks: 2,000 replicates of it take 320 MB. Fetch-v0
has 240, a sequence of 40 targets among 50 tasks 8,200."""

FARTHEST = 1e18
"""A greater activation drift than any policy has whose hidden states are numbers of any use."""


@dataclass(frozen=True, eq=False)
class Scores:
    """What a record says, as arrays, NaN where missing. The success of an episode is 0 or 1.

    The scored episodes are the test episodes, in a tuning run the validation episodes.
    """

    layout: Layout
    """What the axes stand for."""
    success: Array
    """Success at the end of each stage, (stages + 1, tasks, episodes)."""
    on_the_way: Array
    """Success at the points of each stage before its end, (targets, points - 1, tasks, curve episodes)."""
    perturbed: Array
    """Success on the retained skills at the ends of stages, perturbed, (stages + 1, retained, episodes)."""
    validation: Array
    """Success rate on target k over the validation episodes at the points of stage k, (targets, points)."""
    asked: Array
    """Questions asked at the end of each stage, (stages + 1, kinds)."""
    correct: Array
    """Questions answered rightly, (stages + 1, kinds)."""
    answer_curves: Array
    """Share of all questions answered rightly at the points of each stage, (targets, points)."""
    update_sparsity: Array
    """Share of the parameters that have hardly changed since pretraining, (targets, points)."""
    activation_drift: Array
    """Distance of the hidden states from those of the pretrained policy, (targets, points)."""

    @classmethod
    def from_record(cls, record: Record) -> Scores:
        """Return the scores in `record`.

        Raises:
            RecordError: The record contradicts itself: tasks, stages, steps or values that cannot be.
        """
        retained, target, held_out = (_names(record, group) for group in ("retained", "target", "held_out"))
        tasks = retained + target + held_out
        if len(set(tasks)) != len(tasks):
            raise RecordError("scenario: a task name occurs twice.")
        split, steps = _split(record), _steps(record)
        rows = _episodes(record, tasks, len(target), steps)
        scored = [row for row in rows if row.split == split]
        if not scored:
            raise RecordError(f"episodes: there is no {split} episode.")
        if split == "validation" and len(scored) < len(rows):
            raise RecordError("episodes: a tuning run has validation episodes alone.")
        on_the_way = [row for row in scored if row.stage and row.step < steps[-1]]
        chosen_on = [
            row
            for row in rows
            if row.split == "validation" and row.stage and row.task == target[row.stage - 1]
        ]
        kinds, counts = _answers(record, len(target), steps)
        # few rows may ask for more memory than there is
        _check_cells("stages x points x tasks", len(target) + 1, len(steps), len(tasks))
        _check_cells("tasks x episodes", len(tasks), len(_numbers(rows)))
        layout = Layout(
            retained,
            target,
            held_out,
            episodes=_numbers(scored),
            # a method that is evaluated at the ends alone has none, and belongs to the others all the same
            curve_episodes=_numbers(on_the_way) or _curve_episodes(record, split, _numbers(scored)),
            validation_episodes=_numbers(chosen_on),
            steps=steps,
            kinds=kinds,
        )
        # one table for all points, with a place for the pretrained policy's; the end is the last point
        success = np.full((len(target) + 1, len(steps), len(tasks), len(layout.episodes)), np.nan)
        of_task, of_episode = _places(tasks), _places(layout.episodes)
        perturbed = np.full((len(target) + 1, len(retained), len(layout.episodes)), np.nan)
        for row in _perturbed(record, rows, layout):
            perturbed[row.stage, of_task[row.task], of_episode[row.episode]] = row.success
        for row in scored:
            where = (
                row.stage,
                _point(row.stage, row.step, steps),
                of_task[row.task],
                of_episode[row.episode],
            )
            success[where] = row.success
        on_validation = np.full((len(target), len(steps), len(layout.validation_episodes)), np.nan)
        of_validation = _places(layout.validation_episodes)
        for row in chosen_on:
            on_validation[row.stage - 1, steps.index(row.step), of_validation[row.episode]] = row.success
        in_curves = [of_episode[number] for number in layout.curve_episodes]
        sparsity, drift = _policy(record, len(target), steps)
        return cls(
            layout,
            success=success[:, -1],
            on_the_way=success[1:, :-1][..., in_curves],
            perturbed=perturbed,
            validation=average(on_validation),
            asked=counts[0, :, -1],
            correct=counts[1, :, -1],
            answer_curves=_shares(*counts[:, 1:]),
            update_sparsity=sparsity,
            activation_drift=drift,
        )

    def rates(self, counts: Array | None = None) -> Rates:
        """Return the success rates with the batch axes of `counts`.

        At the points before the end of a stage fewer episodes are run. There the counts are weights: the
        rate is the mean over the episodes drawn of those that are run, however many these are. Where none
        of them was drawn all weigh the same.

        Args:
            counts: How often each episode is in, the same for all stages and points, (..., tasks, episodes).
                They add up to the number of episodes. Once each, without batch axes, if None.
        """
        layout, number = self.layout, len(self.layout.episodes)
        if counts is None:
            counts = np.ones((len(layout.tasks), number))
        batch = counts.shape[:-2]

        def spread(array: Array) -> Array:
            return np.broadcast_to(array, batch + array.shape)

        success = np.einsum("lte,...te->...lt", self.success, counts) / number
        if np.isnan(self.perturbed).all():  # most runs have none, and to count them takes long
            perturbed = spread(np.full(self.perturbed.shape[:-1], np.nan))
        else:
            of_retained = counts[..., layout.columns("retained"), :]
            perturbed = np.einsum("lre,...re->...lr", self.perturbed, of_retained) / number
        if layout.curve_episodes:
            weights = counts[..., np.searchsorted(layout.episodes, layout.curve_episodes)]
            weights = np.where(weights.sum(axis=-1, keepdims=True) > 0, weights, 1.0)
            weights = weights / weights.sum(axis=-1, keepdims=True)
            on_the_way = np.einsum("kpte,...te->...kpt", self.on_the_way, weights)
        else:
            on_the_way = spread(np.full(self.on_the_way.shape[:-1], np.nan))
        return Rates(
            layout,
            success=success,
            curves=np.concatenate([on_the_way, success[..., 1:, None, :]], axis=-2),
            perturbed=perturbed,
            validation=spread(self.validation),
            asked=spread(self.asked),
            correct=spread(self.correct),
            answer_curves=spread(self.answer_curves),
            update_sparsity=spread(self.update_sparsity),
            activation_drift=spread(self.activation_drift),
        )


# ---- reading a record --------------------------------------------------------------------------------------


class _Episode(NamedTuple):
    stage: int
    step: int
    task: str
    split: str
    episode: int
    success: float


def _names(record: Record, group: Group) -> tuple[str, ...]:
    names = record.scenario.get(group)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise RecordError(f"scenario: {group} must be a list of task names.")
    return tuple(names)


def _steps(record: Record) -> tuple[int, ...]:
    steps = record.scenario.get("evaluation_steps")
    if (
        not isinstance(steps, list)
        or not steps
        or any(type(step) is not int or not 0 < step <= MOST for step in steps)
        or steps != sorted(set(steps))
    ):
        raise RecordError("scenario: evaluation_steps must be a list of rising whole numbers above 0.")
    if len(steps) > MOST_POINTS:
        raise RecordError(f"scenario: {len(steps):,} evaluation_steps; {MOST_POINTS} are the most.")
    return tuple(steps)


def _places(names: Sequence[Any]) -> dict[Any, int]:
    return {name: place for place, name in enumerate(names)}


def _check_cells(what: str, *sizes: int) -> None:
    """Refuse a table that is too large to be resampled."""
    if math.prod(sizes) > MOST_CELLS:
        text = " x ".join(f"{size:,}" for size in sizes)
        raise RecordError(f"it is too large to be shown: {what} are {text}, and {MOST_CELLS:,} are the most.")


def _split(record: Record) -> str:
    split = record.run.get("split", "test")
    if split not in ("test", "validation"):
        raise RecordError(f"run: split must be report or selection, not {split!r}.")
    return str(split)


def _check_when(where: str, stage: Any, step: Any, stages: int, steps: tuple[int, ...]) -> None:
    """Refuse a stage that is not in the scenario, and a step after which it is not evaluated."""
    whole = type(stage) is int and type(step) is int
    if not (whole and 0 <= stage <= min(stages, MOST) and 0 <= step <= MOST):
        raise RecordError(f"{where} has an impossible stage or step.")
    if step not in (steps if stage else (0,)):
        raise RecordError(f"{where} is of stage {stage}, step {step}, which is no evaluation point.")


def _point(stage: int, step: int, steps: tuple[int, ...]) -> int:
    """Return the evaluation point of `step`; the pretrained policy, which has one, is at its end."""
    return steps.index(step) if stage else -1


def _episodes(record: Record, tasks: tuple[str, ...], stages: int, steps: tuple[int, ...]) -> list[_Episode]:
    """Return the episodes, each checked."""
    rows, known = [], set(tasks)
    columns = (record.episodes[name] for name in EPISODE_COLUMNS)
    for number, values in enumerate(zip(*columns, strict=True)):
        stage, step, task, split, episode, success, total_reward, length = values
        where = f"episodes: row {number}"
        _check_when(where, stage, step, stages, steps)
        if type(episode) is not int or not 0 <= episode <= MOST:
            raise RecordError(f"{where} has an impossible number of an episode.")
        if not isinstance(task, str) or task not in known:
            raise RecordError(f"{where} is of a task that is not in the scenario: {task!r}.")
        if split not in SPLITS:
            raise RecordError(f"{where} has the split {split!r}, which is none of {', '.join(SPLITS)}.")
        if success not in (0, 1):
            raise RecordError(f"{where} has the success {success!r}, neither true nor false.")
        if total_reward is not None and not _is_number(total_reward, FARTHEST, -FARTHEST):
            raise RecordError(f"{where} has an impossible return.")
        if type(length) is not int or not 0 <= length <= MOST:
            raise RecordError(f"{where} has an impossible length.")
        rows.append(_Episode(stage, step, task, split, episode, float(success)))
    if len({row[:5] for row in rows}) != len(rows):
        raise RecordError("episodes: an episode is there twice.")
    return rows


def _perturbed(record: Record, rows: Iterable[_Episode], layout: Layout) -> list[_Episode]:
    """Return the perturbed episodes: all that a run has which says `perturb`, and none otherwise."""
    found = [row for row in rows if row.split == "perturbed"]
    perturb = record.run.get("perturb", False)
    if found and not perturb:
        raise RecordError("episodes: there are perturbed ones, but its run does not say perturb.")
    rule = "each retained skill has those of the report, at the end of each stage"
    retained, numbers = set(layout.retained), set(layout.episodes)
    for row in found:
        at_an_end = row.step == (layout.steps[-1] if row.stage else 0)
        if not (at_an_end and row.task in retained and row.episode in numbers):
            where = f"of {row.task} at stage {row.stage}, step {row.step}"
            raise RecordError(
                f"episodes: the perturbed episode {row.episode} {where}, must not be there: {rule}."
            )
    count = (len(layout.target) + 1) * len(retained) * len(numbers) if perturb else 0
    if len(found) != count:
        raise RecordError(f"episodes: {len(found):,} are perturbed, not {count:,}: {rule}.")
    return found


def _curve_episodes(record: Record, split: str, episodes: tuple[int, ...]) -> tuple[int, ...]:
    """Return which of `episodes` the budget has run on the way."""
    budget = record.scenario.get("budget")
    count = budget.get("curve_episodes") if isinstance(budget, dict) else None
    if type(count) is not int:
        raise RecordError(f"scenario: curve_episodes of its budget must be a whole number, not {count!r}.")
    return episodes if split == "validation" else tuple(number for number in episodes if number < count)


def _numbers(rows: Iterable[_Episode]) -> tuple[int, ...]:
    return tuple(sorted({row.episode for row in rows}))


def _answers(record: Record, stages: int, steps: tuple[int, ...]) -> tuple[tuple[str, ...], Array]:
    """Return the kinds of questions, and the counts asked and answered, (2, stages + 1, points, kinds)."""
    rows = list(zip(*record.answers.values(), strict=True))
    for number, (stage, step, kind, asked, correct) in enumerate(rows):
        where = f"answers: row {number}"
        _check_when(where, stage, step, stages, steps)
        if any(type(value) is not int for value in (asked, correct)) or not isinstance(kind, str):
            raise RecordError(f"{where} must hold whole numbers and the name of a kind.")
        if not 0 <= correct <= asked <= MOST:
            raise RecordError(f"{where} has impossible numbers.")
    if len({row[:3] for row in rows}) != len(rows):
        raise RecordError("answers: a kind is there twice at one evaluation point.")
    kinds = tuple(sorted({row[2] for row in rows}))
    _check_cells("stages x points x kinds of questions", stages + 1, len(steps), len(kinds))
    counts = np.zeros((2, stages + 1, len(steps), len(kinds)))
    for stage, step, kind, asked, correct in rows:
        counts[:, stage, _point(stage, step, steps), kinds.index(kind)] = asked, correct
    return kinds, counts


def _shares(asked: Array, correct: Array) -> Array:
    """Return the share of right answers (...) of counts (..., kinds), NaN where a kind was not asked."""
    complete = (asked > 0).all(axis=-1) & (asked.sum(axis=-1) > 0)
    return np.where(complete, correct.sum(axis=-1) / np.maximum(asked.sum(axis=-1), 1), np.nan)


def _policy(record: Record, stages: int, steps: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the update sparsity and the activation drift at the points of each stage, (targets, points)."""
    rows = list(zip(*record.policy.values(), strict=True))
    values = np.full((2, stages + 1, len(steps)), np.nan)
    for number, (stage, step, *both) in enumerate(rows):
        where = f"policy: row {number}"
        _check_when(where, stage, step, stages, steps)
        for value, name, high in zip(
            both, ("update_sparsity", "activation_drift"), (1, FARTHEST), strict=True
        ):
            if value is not None and not _is_number(value, high):
                raise RecordError(f"{where} has an impossible {name}.")
        values[:, stage, _point(stage, step, steps)] = [np.nan if value is None else value for value in both]
    if len({row[:2] for row in rows}) != len(rows):
        raise RecordError("policy: an evaluation point is there twice.")
    return values[0, 1:], values[1, 1:]


def _is_number(value: Any, high: float, low: float = 0) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def rates_of(runs: Sequence[Scores], references: Mapping[str, Sequence[Scores]]) -> Rates:
    """Return the success rates of `runs`, with the batch axis (runs,).

    Args:
        runs: One or more runs.
        references: Runs of reference methods by name: the same seeds in the same order.

    Raises:
        ValueError: The layouts differ.
    """
    _check_same(run.layout for run in (*runs, *chain.from_iterable(references.values())))
    rates = combine([run.rates() for run in runs], np.stack)
    return replace(rates, references={name: rates_of(them, {}) for name, them in references.items()})
