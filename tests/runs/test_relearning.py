"""Measurements around the stages of a run: the shift of the policy in each, and relearning after the last."""

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from eager import EAGER
from helpers import stage_policies

from clbench.base.cache import CacheError
from clbench.base.progress import no_progress
from clbench.base.seeding import torch_generator
from clbench.data.training_data import TrainingData
from clbench.evaluation.episodes import Trial
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.method import Method
from clbench.learning.registry import load_method
from clbench.learning.trainer import Trainer
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.records.record import Record, Relearning
from clbench.runs.length import run_length
from clbench.runs.relearning import relearn
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.spec.protocol import check_steps


@pytest.fixture(scope="module")
def policies(record: Record) -> list[Policy]:
    """The policies of its stages, made again."""
    return stage_policies(RunSpec(EAGER.id, "sft", seed=0).resolve())


@pytest.fixture(scope="module")
def data(policies: list[Policy]) -> TrainingData:
    return TrainingData.open(EAGER, policies[0].config)


def velocity(policy: Policy, batch: Batch) -> torch.Tensor:
    with torch.no_grad():
        return policy.predict(batch)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_the_shift_is_the_mean_squared_change_of_velocity_on_the_new_targets_data(
    seed: int, record: Record, policies: list[Policy], data: TrainingData, tmp_path: Path
) -> None:
    run = RunSpec(EAGER.id, "sft", seed).resolve()
    if seed:
        record = execute(run.spec, tmp_path / "records", checkpoints=tmp_path / "kept")
        policies = stage_policies(run, tmp_path / "kept")
    assert record.policy["shift"][0] is None
    for stage, task in enumerate(run.scenario.target, 1):
        batch = data.demonstrations(task).sample(256, torch_generator("shift", seed, stage))
        change = velocity(policies[stage], batch) - velocity(policies[stage - 1], batch)
        samples = [
            sum(float(change[row, step].square().mean()) for step in valid.nonzero()) / int(valid.sum())
            for row, valid in enumerate(batch.valid)
        ]
        assert record.policy["shift"][stage] == pytest.approx(sum(samples) / 256, rel=1e-4)
    mean = sum(record.policy["shift"][1:]) / 2
    assert measure("shift", Scores.from_record(record)) == pytest.approx(mean)


@pytest.mark.usefixtures("one_thread")
def test_an_instruction_is_captured_where_the_target_is_done_though_a_skill_is_asked(
    record: Record, policies: list[Policy]
) -> None:
    evaluator, skills, shares = Evaluator(EAGER, seed=0), EAGER.retained, []
    for policy, target in zip(policies[1:], EAGER.target, strict=True):
        done = []
        for number in range(EAGER.budget.test_episodes):
            skill = skills[number % len(skills)]
            wordings = {name: getattr(skill, name) for name in ("instructions", "test_instructions")}
            trial = Trial(dataclasses.replace(target, **wordings), "test", number)
            (episode,) = evaluator.play(policy, [trial])
            done.append(episode.success)
        shares.append(sum(done) / len(done))
    assert record.policy["captured"] == [None, *shares]
    assert any(shares)  # else words are read so well that the loop shows nothing
    assert measure("instruction_capture", Scores.from_record(record)) == pytest.approx(sum(shares) / 2)


@pytest.mark.usefixtures("one_thread")
def test_relearning_repeats_itself_in_a_loop_written_out(
    record: Record, policies: list[Policy], data: TrainingData
) -> None:
    policy, evaluator = policies[-1], Evaluator(EAGER, seed=0)
    successes = {
        task.name: sum(episode.success for episode in evaluator.evaluate(policy.eval(), [task]))
        for task in EAGER.retained
    }
    lost = min(EAGER.retained, key=lambda task: successes[task.name])
    demonstrations, generator = data.demonstrations(lost), torch_generator("relearning", 0)
    optimiser = torch.optim.AdamW(policy.parameters(), betas=(0.9, 0.95), weight_decay=1e-10, fused=True)
    steps = 0
    while sum(episode.success for episode in evaluator.evaluate(policy.eval(), [lost])) < 3:
        following = min(step for step in check_steps(200) if step > steps)
        for step in range(steps, following):
            optimiser.param_groups[0]["lr"] = 1e-3 * min(1.0, (step + 1) / 15)
            loss = policy.train().action_loss(demonstrations.sample(16, generator)).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimiser.step()
        steps = following
    evaluator.close()
    assert record.relearning == Relearning(lost.name, successes[lost.name], steps, True)
    assert steps > 0
    assert measure("relearning_steps", Scores.from_record(record)) == steps


@pytest.mark.parametrize(("left", "up", "lost"), [(3, 1, "up"), (1, 3, "left"), (2, 2, "left")])
def test_the_skill_that_is_relearned_is_the_one_with_the_fewest_successes(
    left: int, up: int, lost: str
) -> None:
    trainer = Trainer.open(EAGER, load_method("sft"), 0, "cpu")
    examiner: Any = SimpleNamespace(successes=lambda policy: {"left": left, "up": up})
    checked: list[str] = []
    checker: Any = SimpleNamespace(
        is_due=lambda point: True,
        check=lambda policy, skill, point: checked.append(skill.name),
        is_learned=lambda row: True,
    )
    assert relearn(trainer, examiner, checker, no_progress) == Relearning(lost, min(left, up), 0, True)
    assert checked == [lost]


@pytest.mark.long
@pytest.mark.usefixtures("one_thread")
def test_a_skill_is_relearned_by_plain_steps_of_the_scenarios_size_on_draws_of_the_runs_seed() -> None:
    trainer = Trainer.open(EAGER, lambda: load_method("sft")(step_factor=0.1), 1, "cpu")
    examiner: Any = SimpleNamespace(successes=lambda policy: {"left": 3, "up": 1})
    seen: list[Policy] = []
    checker: Any = SimpleNamespace(
        is_due=lambda point: point.step % 4 == 0,
        check=lambda policy, skill, point: seen.append(copy.deepcopy(policy)),
        is_learned=lambda row: len(seen) == 3,
    )
    assert relearn(trainer, examiner, checker, no_progress) == Relearning("up", 1, 8, True)
    policy = trainer.policy
    demonstrations, generator = (
        trainer.data.demonstrations(EAGER.task("up")),
        torch_generator("relearning", 1),
    )
    optimiser = torch.optim.AdamW(policy.parameters(), betas=(0.9, 0.95), weight_decay=1e-10, fused=True)
    for step in range(8):
        optimiser.param_groups[0]["lr"] = 1e-3 * (step + 1) / 15
        loss = policy.action_loss(demonstrations.sample(16, generator)).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()
    for one, other in zip(policy.parameters(), seen[-1].parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-7)


@pytest.mark.long
def test_a_skill_that_is_still_known_takes_no_steps_and_the_first_is_chosen_on_a_tie(tmp_path: Path) -> None:
    record = execute(RunSpec(EAGER.id, "frozen", seed=0), tmp_path)
    assert record.relearning == Relearning("left", 4, 0, True)
    assert record.policy["shift"] == [None, 0.0, 0.0]


@pytest.mark.long
def test_relearning_costs_the_run_nothing_but_seconds(record: Record, tmp_path: Path) -> None:
    ends = {row.stage: row.step for row in record.check_rows()}
    assert record.costs.optimiser_steps == sum(ends.values())
    assert record.timing["relearning"] > 0
    amounts: list[float] = []
    spec = RunSpec(EAGER.id, "sft", seed=0)
    execute(spec, tmp_path, amounts.append)
    run = spec.resolve()
    assert sum(amounts) == pytest.approx(run_length(run.scenario, run.protocol))


@pytest.mark.long
def test_adapters_are_relearned_with_all_that_they_adapt(tmp_path: Path) -> None:
    spec = RunSpec(EAGER.id, "lora", seed=0)
    record = execute(spec, tmp_path, checkpoints=tmp_path / "kept")
    assert record.relearning is not None
    assert record.relearning.met
    assert 0 < record.relearning.steps < 200
    assert all(shift > 0 for shift in record.policy["shift"][1:])
    # the run's own policy keeps the weights below its adapters
    first, *_, last = stage_policies(spec.resolve(), tmp_path / "kept")
    for (name, before), after in zip(first.named_parameters(), last.parameters(), strict=True):
        assert ("lora_" in name) or torch.equal(before, after), name


@pytest.mark.long
@pytest.mark.parametrize("method", ["sft", "lora"])
def test_what_a_policy_freezes_stays_frozen_in_relearning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    made, loss = TransformerPolicy.__init__, TransformerPolicy.action_loss
    frozen: list[set[str]] = []

    def half_frozen(self: TransformerPolicy, *args: Any, **kwargs: Any) -> None:
        made(self, *args, **kwargs)
        self.backbone_layers[0].requires_grad_(False)

    def watched(self: TransformerPolicy, *args: Any, **kwargs: Any) -> torch.Tensor:
        frozen.append({name for name, one in self.named_parameters() if not one.requires_grad})
        return loss(self, *args, **kwargs)

    monkeypatch.setattr(TransformerPolicy, "__init__", half_frozen)
    monkeypatch.setattr(TransformerPolicy, "action_loss", watched)
    spec = RunSpec(EAGER.id, method, seed=0)
    record = execute(spec, tmp_path)
    assert record.relearning is not None
    assert record.relearning.steps > 0
    policy = stage_policies(spec.resolve())[-1]
    layer = {id(one) for one in policy.backbone_layers[0].parameters()}
    of_layer = {name for name, one in policy.named_parameters() if id(one) in layer}
    assert {name for name in of_layer if "lora_" not in name} in frozen
    assert set() not in frozen


class Broken(TransformerPolicy):
    """A policy that cannot be fine-tuned: its loss is not finite."""

    def action_loss(self, batch: Batch, hidden: list[torch.Tensor] | None = None) -> torch.Tensor:
        return super().action_loss(batch, hidden) * float("nan")


@dataclass
class Breaking(Method):
    """A method that learns targets and leaves such a policy."""

    def loss(self, policy: Policy, batch: Batch, progress: object) -> torch.Tensor:
        assert isinstance(policy, TransformerPolicy)
        return TransformerPolicy.action_loss(policy, batch).mean()

    def load_state(self, policy: Policy, state: object) -> None:
        policy.__class__ = Broken


@pytest.mark.long
def test_a_policy_that_cannot_be_fine_tuned_is_not_relearned(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(EAGER.id, stranger(Breaking), seed=0), tmp_path)
    assert (record.status, record.relearning) == ("success", None)
    assert measure("relearning_steps", Scores.from_record(record)) is None


@pytest.mark.long
def test_a_tuning_run_relearns_nothing(tmp_path: Path) -> None:
    record = execute(RunSpec(EAGER.id, "sft", seed=0, split="validation"), tmp_path)
    assert (record.status, record.relearning) == ("success", None)


@pytest.mark.long
def test_a_scenario_of_equal_stages_has_a_shift_at_their_ends_and_no_relearning(tmp_path: Path) -> None:
    record = execute(RunSpec("clbench.testing:clbench/Toy-v0", "sft", seed=0), tmp_path)
    assert record.relearning is None
    shifts = zip(record.policy["stage"], record.policy["step"], record.policy["shift"], strict=True)
    assert [(stage, step) for stage, step, shift in shifts if shift is not None] == [(1, 60), (2, 60)]


def test_a_failure_of_the_machine_in_relearning_is_not_one_of_the_method() -> None:
    def check(*_: object) -> None:
        raise CacheError("the disk failed")

    trainer = Trainer.open(EAGER, load_method("sft"), 0, "cpu")
    examiner: Any = SimpleNamespace(successes=lambda policy: {"left": 3, "up": 1})
    checker: Any = SimpleNamespace(is_due=lambda point: True, check=check, is_learned=lambda row: True)
    with pytest.raises(CacheError):
        relearn(trainer, examiner, checker, no_progress)
