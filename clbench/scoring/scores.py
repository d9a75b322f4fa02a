"""Scores: the outcomes in a record as arrays, and the rates that metrics are computed from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, groupby
from operator import attrgetter
from typing import Any

import numpy as np

from clbench.records.record import EpisodeRow, Record
from clbench.scoring.completeness import check_complete
from clbench.scoring.layout import Array, Layout
from clbench.scoring.rates import MEASURED, Measured, Rates, check_same, share_of_correct, stacked
from clbench.scoring.reading import (
    numbers,
    place,
    read_answers,
    read_checks,
    read_episodes,
    read_perturbed,
    read_policy,
    read_protocol,
    read_relearning,
)
from clbench.spec.protocol import Point, Protocol

WEAK = 0.8
"""Success of the pretrained policy on the retained skills below which there is little to forget."""

WEAK_WARNING = (
    "That is low: a policy cannot forget what it never could do, so low retention need not mean forgetting."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Scores(Measured):
    """The outcomes in a record as arrays, NaN where missing. The success of an episode is 0 or 1.

    The scored episodes are the test episodes or, in a tuning run, the validation episodes.
    """

    success: Array
    """Success at the end of each stage, (stages + 1, tasks, episodes)."""
    on_the_way: Array
    """Success at the points of each stage before its end, (targets, points - 1, tasks, curve episodes)."""
    perturbed: Array
    """Success in perturbed episodes at the ends of stages, (stages + 1, tasks, episodes)."""

    @classmethod
    def from_record(cls, record: Record, partial: bool = False) -> Scores:
        """Return the scores in `record`.

        Args:
            record: A record.
            partial: Whether to accept a record that lacks some of the results that its budget demands;
                metrics that need them then have no value.

        Raises:
            RecordError: The record contradicts itself: impossible tasks, stages, steps or values, or results
                that are missing or must not be there.
        """
        protocol = read_protocol(record)
        rows = read_episodes(record, protocol)
        kinds, counts = read_answers(record, protocol)
        sparsity, drift, shift, captured = read_policy(record, protocol)
        if not partial:
            check_complete(record, rows, protocol)
        scored = [row for row in rows if row.split == protocol.split]
        on_the_way = [row for row in scored if not protocol.is_end(row.point)]
        episodes = numbers(scored)
        # a method that is evaluated only at the ends has none, and must still combine with the others
        count = protocol.scored_episodes(at_end=False)
        planned = episodes if protocol.split == "validation" else tuple(n for n in episodes if n < count)
        layout = Layout(
            protocol.retained,
            protocol.target,
            protocol.held_out,
            episodes=episodes,
            curve_episodes=numbers(on_the_way) or planned,
            validation_episodes=numbers(_chosen_on(rows, protocol)),
            steps=protocol.steps,
            kinds=kinds,
            to_criterion=protocol.criterion is not None,
        )
        # one table for all points, with a place for the pretrained policy's; the end is the last point
        success = _success(protocol, scored, layout)
        perturbed = _success(protocol, read_perturbed(protocol, rows, episodes), layout)[:, -1]
        in_curves = [episodes.index(number) for number in layout.curve_episodes]
        steps, met = read_checks(record, protocol)
        return cls(
            layout=layout,
            success=success[:, -1],
            on_the_way=success[1:, :-1][..., in_curves],
            perturbed=perturbed,
            asked=counts[0, :, -1],
            correct=counts[1, :, -1],
            answer_curves=share_of_correct(*counts[:, 1:]),
            update_sparsity=sparsity,
            activation_drift=drift,
            shift=shift,
            captured=captured,
            steps=steps,
            met=met,
            relearning_steps=read_relearning(record, protocol),
        )

    def rates(self, counts: Array | None = None) -> Rates:
        """Return the success rates with the batch axes of `counts`.

        Before the end of a stage fewer episodes are run. There the counts are weights: the rate is the
        weighted mean over the episodes that are run. If none of them was drawn, all weigh the same.

        Args:
            counts: Number of draws of each episode, the same for all stages and points, (..., tasks,
                episodes). They add up to the number of episodes. If None, each episode is drawn once,
                without batch axes.
        """
        return self._plain_rates if counts is None else self._rates(counts)

    @cached_property
    def _plain_rates(self) -> Rates:
        """The rates that every comparison of the run needs; a board asks for them 50 times."""
        return self._rates(np.ones((len(self.layout.tasks), len(self.layout.episodes))))

    def _rates(self, counts: Array) -> Rates:
        layout, number, batch = self.layout, len(self.layout.episodes), counts.shape[:-2]

        def spread(array: Array) -> Array:
            return np.broadcast_to(array, batch + array.shape)

        success = _sums(self.success, counts) / number
        if np.isnan(self.perturbed).all():  # most runs have none, and counting them takes long
            perturbed = spread(np.full(self.perturbed.shape[:-1], np.nan))
        else:
            perturbed = _sums(self.perturbed, counts) / number
        if layout.curve_episodes:
            weights = counts[..., np.searchsorted(layout.episodes, layout.curve_episodes)]
            weights = np.where(weights.sum(axis=-1, keepdims=True) > 0, weights, 1.0)
            total = weights.sum(axis=-1)[..., None, None, :]
            on_the_way = _sums(self.on_the_way, weights) / total
        else:
            on_the_way = spread(np.full(self.on_the_way.shape[:-1], np.nan))
        measured: dict[str, Any] = {name: spread(getattr(self, name)) for name in MEASURED}
        return Rates(
            layout=layout,
            success=success,
            curves=np.concatenate([on_the_way, success[..., 1:, None, :]], axis=-2),
            perturbed=perturbed,
            **measured,
        )


def _chosen_on(rows: Sequence[EpisodeRow], protocol: Protocol) -> list[EpisodeRow]:
    """Return the validation episodes of each stage's target, on which choices may be based."""
    own = [row for row in rows if row.split == "validation" and row.stage > 0]
    return [row for row in own if row.task == protocol.target[row.stage - 1]]


def _sums(values: Array, counts: Array) -> Array:
    """Return the sums of values (..., tasks, episodes) over episodes, each weighted by its count.

    Args:
        values: Values, (*shape, tasks, episodes).
        counts: How often each episode counts, (*batch, tasks, episodes).

    Returns:
        The sums, (*batch, *shape, tasks).
    """
    shape, batch = values.shape[:-1], counts.shape[:-2]
    tasks, episodes = counts.shape[-2:]
    # one product of matrices for each task: three times as fast as numpy.einsum
    left = np.moveaxis(counts, -2, 0).reshape(tasks, -1, episodes)
    right = np.moveaxis(values.reshape(-1, tasks, episodes), 0, -1)
    return np.ascontiguousarray(np.moveaxis(left @ right, 0, -1)).reshape(*batch, *shape)


def _places(names: Sequence[Any]) -> dict[Any, int]:
    return {name: place for place, name in enumerate(names)}


def _success(protocol: Protocol, rows: Sequence[EpisodeRow], layout: Layout) -> Array:
    """Return the success in episodes, (stages + 1, points, tasks, episodes); an end has the last point."""
    shape = len(protocol.stages), len(protocol.steps), len(layout.tasks), len(layout.episodes)
    found = np.full(shape, np.nan)
    of_task, of_episode = _places(layout.tasks), _places(layout.episodes)
    for (stage, step), at_point in groupby(rows, key=attrgetter("stage", "step")):
        there = found[stage, place(protocol, Point(stage, step))]
        for row in at_point:
            there[of_task[row.task], of_episode[row.episode]] = row.success
    return found


def rates_of(runs: Sequence[Scores], references: Mapping[str, Sequence[Scores]]) -> Rates:
    """Return the success rates of `runs`, with the batch axis (runs,).

    Args:
        runs: One or more runs.
        references: Runs of reference methods by name: the same seeds in the same order.

    Raises:
        InputError: The layouts differ.
    """
    check_same(run.layout for run in (*runs, *chain.from_iterable(references.values())))
    found = {name: stacked([run.rates() for run in them]) for name, them in references.items()}
    return replace(stacked([run.rates() for run in runs]), references=found)
