"""The trainer: what a stage trains on, step by step, and which prior data a method gets."""

import copy
import dataclasses
import importlib.metadata
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import build_method
from tiny import TINY

from clbench.base.seeding import torch_generator
from clbench.data.demonstrations import Demonstrations
from clbench.learning.adaptation import Step
from clbench.learning.method import Method, MethodState, Progress, Stage
from clbench.learning.prior import UndeclaredAccessError
from clbench.learning.trainer import Trainer, training_inputs
from clbench.policy.policy import Policy

pytestmark = pytest.mark.usefixtures("one_thread")

SEED = 3
STEPS = TINY.budget.adaptation_steps


def _trainer(method: str) -> Trainer:
    trainer = Trainer.open(TINY, lambda: build_method(method, {}), SEED, "cpu")
    trainer.prepare()
    return trainer


def _go_on(step: Step) -> None:
    pass


def test_each_stage_repeats_itself_in_a_loop_written_out() -> None:
    trainer = _trainer("sft")
    for number, task in enumerate(TINY.target, 1):
        policy = copy.deepcopy(trainer.policy)
        assert trainer.learn(number, _go_on) == STEPS
        demonstrations, generator = trainer.data.demonstrations(task), torch_generator("target", SEED, number)
        optimiser = torch.optim.AdamW(policy.parameters(), betas=(0.9, 0.95), weight_decay=1e-10, fused=True)
        for step in range(STEPS):
            # one step of warm-up, then a cosine down to a tenth
            fallen = max(0, step - 1) / (STEPS - 1)
            share = 0.1 + 0.45 * (1 + math.cos(math.pi * fallen))
            optimiser.param_groups[0]["lr"] = TINY.budget.learning_rate * share
            loss = policy.action_loss(demonstrations.sample(TINY.budget.batch_size, generator)).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimiser.step()
        learned = dict(trainer.policy.named_parameters())
        for name, weight in policy.named_parameters():
            torch.testing.assert_close(weight, learned[name], rtol=0, atol=1e-7)


def _columns(rows: Any) -> list[torch.Tensor]:
    return [getattr(rows, field.name) for field in dataclasses.fields(rows)]


@pytest.mark.parametrize("number", [1, 2])
def test_prior_data_are_those_of_skills_and_earlier_targets_with_draws_of_their_own_in_each_stage(
    number: int,
) -> None:
    trainer = _trainer("joint")
    before = TINY.retained + TINY.target[: number - 1]
    demonstrations = Demonstrations.cat([trainer.data.demonstrations(task) for task in before])
    prior = trainer.prior(number, ("throughout",))
    for source, data, name in (
        (prior.demonstrations, demonstrations, "prior demonstrations"),
        (prior.questions, trainer.data.questions, "prior questions"),
    ):
        expected = data.sample(40, torch_generator(name, SEED, number))
        drawn = source.sample(40)
        assert len(source) == len(data)
        assert all(one.equal(other) for one, other in zip(_columns(drawn), _columns(expected), strict=True))


def test_the_hooks_of_each_stage_have_a_seed_of_their_own() -> None:
    seeds = []
    for seed in (SEED, SEED + 1):
        trainer = Trainer.open(TINY, lambda: build_method("from_scratch", {}), seed, "cpu")
        for number in (1, 2):
            trainer.learn(number, lambda step: True)
            seeds.append(trainer.policy.state_dict()["head.embed.weight"].flatten().tolist()[0])
    assert len(set(seeds)) == 4


@dataclasses.dataclass
class Fixed(Method):
    """Takes steps of one size, whatever is scheduled."""

    scheduled: list[float] = dataclasses.field(default_factory=list)

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        self.scheduled.append(scheduled)
        return 2e-4


def test_the_step_factor_changes_the_scheduled_rate_and_not_the_one_that_a_method_returns() -> None:
    trainer, rates = _trainer("sft"), list[float | None]()
    trainer.method = method = Fixed(step_factor=0.5)
    trainer.learn(1, lambda step: rates.append(step.learning_rate))
    assert rates == [2e-4] * STEPS
    assert max(method.scheduled) == pytest.approx(0.5 * TINY.budget.learning_rate)


@dataclasses.dataclass
class Watching(Method):
    """Trains the head alone, keeps its target, draws whenever it can, and takes two steps of its own."""

    whole_stages = True
    target: Any = None
    left: bool = False

    def start_task(self, policy: Policy, stage: Stage) -> Any:
        self.target = stage.target
        return policy.head.parameters()

    def gradients(self, policy: Policy, loss: torch.Tensor) -> None:
        self.left |= any(parameter.grad is not None for parameter in policy.parameters())
        super().gradients(policy, loss)

    def end_task(self, policy: Policy, stage: Stage) -> None:
        torch.rand(())
        optimiser = torch.optim.SGD(policy.head.parameters(), 1e-6)
        for _ in range(2):
            optimiser.step()

    def state(self) -> MethodState:
        return {"learned": True}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        torch.rand(())


def _same_draws(action: Callable[[], object]) -> bool:
    """Return whether an action leaves the random draws of the program as they were."""
    before = torch.get_rng_state()
    action()
    return torch.get_rng_state().equal(before)


def test_looks_at_a_policy_count_no_steps_and_neither_they_nor_loading_it_move_a_draw(tmp_path: Path) -> None:
    trainer = _trainer("sft")
    trainer.method, trainer.new_method = Watching(), Watching
    kept = list[bool]()
    trainer.learn(1, lambda step: kept.append(_same_draws(trainer.finished)))
    assert all(kept)
    assert trainer.extra_steps == 2  # of the end of the stage alone
    trainer.save(tmp_path, trainer.state(1))
    assert _same_draws(lambda: trainer.load(tmp_path, 1))


def test_gradients_begin_empty_in_each_step_even_of_what_is_not_trained() -> None:
    trainer = _trainer("sft")
    trainer.method = method = Watching()
    trainer.learn(1, _go_on)
    assert not method.left


def test_the_target_of_a_stage_closes_after_it() -> None:
    trainer = _trainer("sft")
    trainer.method = method = Watching()
    trainer.learn(1, _go_on)
    with pytest.raises(UndeclaredAccessError, match="after the hooks that received it"):
        method.target.sample(1)


def test_the_key_of_a_run_names_the_version_of_the_package_that_only_methods_use() -> None:
    assert training_inputs(TINY, SEED)["versions"] == {"peft": importlib.metadata.version("peft")}
