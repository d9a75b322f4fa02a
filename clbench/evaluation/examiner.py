"""The examiner: evaluates a policy at a point of the protocol, and writes the outcome into a record."""

from __future__ import annotations

from functools import cached_property

import torch

from clbench.base.progress import ProgressCallback, no_progress
from clbench.data.questions import scored_questions
from clbench.data.training_data import TrainingData
from clbench.evaluation.answers import answer
from clbench.evaluation.probes import activations, update_sparsity
from clbench.evaluation.rollouts import Episode, Evaluator, Trial
from clbench.policy.activations import Gaussian
from clbench.policy.batch import QuestionBatch
from clbench.policy.policy import Policy
from clbench.records.record import AnswerRow, EpisodeRow, PolicyRow, Record
from clbench.spec.protocol import EPISODE_WEIGHT, Point, Protocol
from clbench.spec.scenario import Scenario


class Examiner:
    """Evaluates the policies of one run: episodes, questions, and how far the weights and activations moved.

    Args:
        scenario: Scenario with the targets that are learned.
        protocol: Evaluation protocol of the run.
        data: Questions of the scenario.
        pretrained: The pretrained policy, with which later policies are compared.
        seed: Seed of the run: it chooses the initial states.
        progress: Called with the length of the work done since its last call, in optimiser steps.
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
        self._pretrained, self._progress = pretrained, progress
        self._evaluator = Evaluator(scenario, seed)

    @cached_property
    def _asked(self) -> tuple[torch.Tensor, QuestionBatch]:
        """Kinds and questions to score: a tuning run must not see the test questions."""
        tuning = self._protocol.split == "validation"
        questions = self._data.questions if tuning else self._data.test_questions
        return scored_questions(questions, self._scenario.budget.test_questions)

    @cached_property
    def _anchor(self) -> Gaussian:
        """Hidden states of the pretrained policy on the scored questions."""
        return self._activations(self._pretrained)

    def examine(self, policy: Policy, point: Point, record: Record) -> None:
        """Evaluate `policy` at `point`, and append the rows to the tables of `record`."""
        trials: list[Trial] = [
            (self._scenario.task(key.task), key.split, key.number) for key in self._protocol.episodes(point)
        ]
        policy.eval()
        episodes = self._evaluator.play(policy, trials, lambda count: self._progress(EPISODE_WEIGHT * count))
        policy.train()
        for episode in episodes:
            record.add_episode(episode_row(point, episode))
        for kind, asked, correct in answer(policy, self._data.questions.kinds, *self._asked):
            record.add_answers(AnswerRow(*point, kind, asked, correct))
        drift = float(self._activations(policy).distance(self._anchor).mean())
        record.add_policy(PolicyRow(*point, update_sparsity(policy, self._pretrained), drift))

    def _activations(self, policy: Policy) -> Gaussian:
        return activations(policy, self._asked[1].to(self._pretrained.state_mean.device))

    def close(self) -> None:
        """Close all worlds."""
        self._evaluator.close()


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
