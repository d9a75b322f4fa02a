"""What the examiner writes about a policy that has diverged, although its weights are finite."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from eager import EAGER

from clbench.data.questions import Questions, scored_questions
from clbench.data.training_data import TrainingData
from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.examiner import Examiner, episode_row
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.method import Method, Stage
from clbench.learning.pretraining import policy_config
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.scores import Scores
from clbench.spec.protocol import Point, ScoredSplit


@dataclasses.dataclass
class Enlarging(Method):
    """Multiplies the weights after the last target."""

    factor: float = 1.0

    def end_task(self, policy: Policy, stage: Stage) -> None:
        if stage.number == 2:
            with torch.no_grad():
                for weight in policy.parameters():
                    weight.mul_(self.factor)


@pytest.mark.long
@pytest.mark.parametrize("factor", [1e5, 1e18])  # hidden states beyond what a reader takes, and infinite ones
def test_a_policy_whose_hidden_states_overflow_has_no_drift_and_a_record_that_can_be_read(
    factor: float, tmp_path: Path
) -> None:
    spec = RunSpec("tiny:me/Tiny-v0", f"{__name__}:Enlarging", 0, changes={"factor": factor})
    execute(spec, tmp_path)
    record = read_record(spec.path(tmp_path))
    assert record.status == "success"
    assert record.policy["activation_drift"][:-1].count(None) == 0
    assert record.policy["activation_drift"][-1] is None
    Scores.from_record(record)


@pytest.mark.parametrize("total", [float("nan"), float("inf"), float("-inf")])
def test_a_return_that_is_no_finite_number_is_recorded_as_missing(total: float) -> None:
    assert episode_row(Point(1, 60), Episode("left", "test", 0, False, total, 12)).total_reward is None


def test_a_return_is_recorded_with_four_digits() -> None:
    episode = Episode("left", "test", 0, False, -1.234567, 12)
    assert episode_row(Point(1, 60), episode).total_reward == -1.2346


def test_the_weights_that_moved_are_a_share_of_those_of_the_pretrained_policy() -> None:
    run = RunSpec("tiny:me/Tiny-v0", "sft", 0).resolve()
    config = policy_config(run.scenario)
    pretrained, policy = TransformerPolicy(config), TransformerPolicy(config)
    with torch.no_grad():
        for old, new in zip(pretrained.parameters(), policy.parameters(), strict=True):
            old.fill_(0.5)
            new.fill_(0.5 * (1 + 1.0005e-3))  # 0.9995e-3 of what it is
    record = Record("success", run.info, run.scenario_info)
    data = TrainingData.open(run.scenario, config)
    examiner = Examiner(run.scenario, run.protocol, data, pretrained, seed=0)
    examiner.examine(policy, run.protocol.end(0), record)
    examiner.close()
    assert record.policy["update_sparsity"] == [0.0]


def _moments(policy: Policy, questions: Questions, count: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return the mean and the deviation of each layer's hidden states on the questions that are scored."""
    _, asked = scored_questions(questions, count)
    with torch.no_grad():
        hidden = policy.eval().hidden_states(asked.state, asked.words, asked.image)
    read = policy.token_mask(asked.words)[:, 0, 0]
    rows = [states[read].double() for states in hidden]
    return [(one.mean(dim=0), (one.var(dim=0, correction=0) + 1e-6).sqrt()) for one in rows]


@pytest.mark.parametrize("split", ["test", "validation"])
def test_a_tuning_run_looks_at_training_questions_alone_and_the_drift_is_a_mean_over_layers(
    split: ScoredSplit,
) -> None:
    run = RunSpec("tiny:me/Tiny-v0", "sft", 0, split=split).resolve()
    config = dataclasses.replace(policy_config(run.scenario), layers=3)
    pretrained, policy = (TransformerPolicy(config, seed=1) for _ in range(2))
    generator, still, total = torch.Generator().manual_seed(0), 0, 0
    with torch.no_grad():
        for weight in policy.parameters():
            moves = torch.rand(weight.shape, generator=generator) < 0.5
            weight.add_(0.1 * (weight.abs() + 1) * moves)
            still += int((~moves).sum())
            total += weight.numel()
    data = TrainingData.open(run.scenario, config)
    record = Record("success", run.info, run.scenario_info)
    examiner = Examiner(run.scenario, run.protocol, data, pretrained, seed=0)
    examiner.examine(policy, run.protocol.end(0), record)
    examiner.close()
    questions = data.questions if split == "validation" else data.test_questions
    count = run.scenario.budget.test_questions
    before, now = (_moments(one, questions, count) for one in (pretrained, policy))
    away = [
        sum(float((one - other).square().sum()) for one, other in zip(new, old, strict=True))
        for new, old in zip(now, before, strict=True)
    ]
    assert record.policy["activation_drift"] == pytest.approx([sum(away) / 3], rel=1e-4)
    assert record.policy["update_sparsity"] == [still / total]
    kind, asked = scored_questions(questions, count)
    with torch.no_grad():
        right = policy.answer_logits(asked.state, asked.words, asked.image).argmax(dim=1) == asked.answer
    assert record.answers["asked"] == torch.bincount(kind).tolist()
    assert record.answers["correct"] == torch.bincount(kind, right.double()).int().tolist()


def test_a_tuning_run_plays_validation_episodes_alone_also_for_the_captured_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = RunSpec(EAGER.id, "sft", 0, split="validation").resolve()
    policy = TransformerPolicy(policy_config(run.scenario))
    data = TrainingData.open(run.scenario, policy.config)
    played: list[Trial] = []
    play = Evaluator.play

    def noted(self: Evaluator, policy: Policy, trials: Any, *rest: Any) -> Any:
        played.extend(trials)
        return play(self, policy, trials, *rest)

    monkeypatch.setattr(Evaluator, "play", noted)
    record = Record("success", run.info, run.scenario_info)
    skills = tuple(
        dataclasses.replace(skill, test_instructions=(f"now {skill.instructions[0]}",))
        for skill in run.scenario.retained
    )
    scenario = dataclasses.replace(run.scenario, retained=skills)
    examiner = Examiner(scenario, run.protocol, data, policy, seed=0)
    examiner.examine(policy, run.protocol.end(1), record, examiner.predictions(policy, 1))
    examiner.close()
    assert record.policy["captured"] != [None]
    assert {trial.split for trial in played} == {"validation"}
    # in the target's scenes, the skills take turns with their words of both splits
    target = scenario.target[0]
    told = [trial.task for trial in played[-run.protocol.captured_episodes :]]
    assert len(told) > len(skills) > 1
    assert {(task.name, task.world) for task in told} == {(target.name, target.world)}
    assert [(task.instructions, task.test_instructions) for task in told] == [
        (skill.instructions, skill.test_instructions) for skill in skills * len(told)
    ][: len(told)]
