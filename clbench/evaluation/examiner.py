"""The examiner: evaluates a policy at a point of the protocol, and writes the outcome into a record."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import torch_generator
from clbench.data.training_data import TrainingData
from clbench.evaluation.answers import answer
from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.probes import activations, predictions, shift, update_sparsity
from clbench.evaluation.rollouts import Evaluator
from clbench.policy.activations import Gaussian
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import Policy
from clbench.records.record import FARTHEST, AnswerRow, EpisodeRow, PolicyRow, Record
from clbench.spec.protocol import EPISODE_WEIGHT, Point, Protocol
from clbench.spec.scenario import Scenario

SHIFT_SAMPLES = 256
"""Samples of a target's demonstrations on which the shift of a policy is measured."""


class Examiner:
    """Evaluates the policies of one run: episodes, questions, and how far the weights and activations moved.

    Args:
        scenario: Scenario with the targets that are learned.
        protocol: Evaluation protocol of the run.
        data: Demonstrations and questions of the scenario.
        pretrained: The pretrained policy, with which later policies are compared.
        seed: Seed of the run: it chooses the initial states.
        progress: Called with the amount of work done since its last call, in optimiser steps.
    """

    def __init__(
        self,
        scenario: Scenario,
        protocol: Protocol,
        data: TrainingData,
        pretrained: Policy,
        seed: int,
        progress: ProgressCallback = no_progress,
    ) -> None:
        self._scenario, self._protocol, self._data = scenario, protocol, data
        self._pretrained, self._seed, self._progress = pretrained, seed, progress
        self._evaluator = Evaluator(scenario, seed)

    @cached_property
    def _asked(self) -> tuple[Tensor, QuestionBatch]:
        """Kinds and questions to score."""
        return self._data.scored_questions(self._protocol.split)

    @cached_property
    def _anchor(self) -> Gaussian | None:
        """Hidden states of the pretrained policy on the scored questions."""
        return self._activations(self._pretrained)

    def examine(
        self, policy: Policy, point: Point, record: Record, predictions_before: Tensor | None = None
    ) -> None:
        """Evaluate `policy` at `point`, and append the rows to the tables of `record`.

        Args:
            policy: Policy to evaluate.
            point: Point of the run.
            record: Record of the run.
            predictions_before: Result of `predictions` before the stage, if `point` is the end of the stage,
                where the shift and the captured share are measured; None elsewhere.
        """
        keys = self._protocol.episodes(point)
        episodes = self._play(
            policy, [Trial(self._scenario.task(key.task), key.split, key.number) for key in keys]
        )
        for episode in episodes:
            record.add_episode(episode_row(point, episode))
        for kind, asked, correct in answer(policy, self._data.questions.kinds, *self._asked):
            record.add_answers(AnswerRow(*point, kind, asked, correct))
        moved = captured = None
        if predictions_before is not None:
            moved = self._shift(policy, point.stage, predictions_before)
            captured = self._captured(policy, point.stage)
        sparsity = update_sparsity(policy, self._pretrained)
        record.add_policy(PolicyRow(*point, sparsity, self._drift(policy), moved, captured))

    def predictions(self, policy: Policy, stage: int) -> Tensor:
        """Return the predictions (B, H, A) of `policy` on a fixed batch of a stage's target."""
        return predictions(policy, self._batch(stage))

    def successes(self, policy: Policy) -> dict[str, int]:
        """Return the successes of `policy` in the validation episodes of each retained skill, in order."""
        skills, numbers = self._scenario.retained, range(self._protocol.validation_episodes)
        trials = [Trial(skill, "validation", number) for skill in skills for number in numbers]
        found = dict.fromkeys((skill.name for skill in skills), 0)
        for episode in self._play(policy, trials):
            found[episode.task] += episode.success
        return found

    def _play(self, policy: Policy, trials: Sequence[Trial]) -> list[Episode]:
        return self._evaluator.play(policy, trials, lambda count: self._progress(EPISODE_WEIGHT * count))

    def _drift(self, policy: Policy) -> float | None:
        """Return how far the hidden states are from the pretrained ones, None for a policy without any."""
        now, anchor = self._activations(policy), self._anchor
        return None if now is None or anchor is None else _known(float(now.distance(anchor).mean()))

    def _activations(self, policy: Policy) -> Gaussian | None:
        if "hidden_states" not in policy.abilities:
            return None
        return activations(policy, self._asked[1].to(self._device))

    def _shift(self, policy: Policy, stage: int, before: Tensor) -> float | None:
        """Return the shift since `before`."""
        return _known(shift(before, self.predictions(policy, stage), self._batch(stage).valid))

    def _captured(self, policy: Policy, stage: int) -> float | None:
        """Return the share of episodes in which `policy` does a stage's target although told to do a skill.

        The episodes begin like the scored episodes of the target. Skills take turns, and so do wordings. If
        their numbers have a common factor, only some wordings of each skill are used.
        """
        if not self._protocol.captured_episodes:
            return None
        target, skills = self._scenario.target[stage - 1], self._scenario.retained
        told = [
            dataclasses.replace(
                target, instructions=skill.instructions, test_instructions=skill.test_instructions
            )
            for skill in skills
        ]
        numbers = range(self._protocol.captured_episodes)
        split = self._protocol.split
        episodes = self._play(policy, [Trial(told[number % len(told)], split, number) for number in numbers])
        return sum(episode.success for episode in episodes) / len(episodes)

    def _batch(self, stage: int) -> Batch:
        """Return the batch of a stage's target on which the shift is measured: the same at each call."""
        data = self._data.demonstrations(self._scenario.target[stage - 1])
        return data.sample(SHIFT_SAMPLES, torch_generator("shift", self._seed, stage)).to(self._device)

    @property
    def _device(self) -> torch.device:
        return self._pretrained.device

    def close(self) -> None:
        """Close all worlds."""
        self._evaluator.close()


def _known(moved: float) -> float | None:
    """Return how far a policy moved, None for a diverged one: readers accept no infinite or NaN numbers."""
    return moved if moved <= FARTHEST else None


def episode_row(point: Point, episode: Episode) -> EpisodeRow:
    """Return the row of `Record.episodes` for an episode at `point`."""
    total_reward = round(episode.total_reward, 4) if abs(episode.total_reward) < float("inf") else None
    return EpisodeRow(
        *point,
        episode.task,
        episode.split,
        episode.number,
        int(episode.success),
        total_reward,
        episode.length,
    )
