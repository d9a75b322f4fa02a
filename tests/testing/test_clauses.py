"""The contract on what a policy does: merges, training at the end, copies, own steps, episodes in hooks."""

import dataclasses
import functools
import types
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import pytest
import torch
from torch import Tensor, nn

import clbench.testing
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.method import Method, MethodState, Progress, Stage
from clbench.learning.prior import Prior
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.runs.fingerprint import arithmetic_hash
from clbench.testing import ContractError, method_checks
from clbench.testing.clauses import actions_of, check_copy, moved
from clbench.testing.small import SMALL, toy_source
from clbench.testing.toy_run import ToyRun, toy_data

# mypy: disable-error-code="attr-defined, method-assign, union-attr"

RATE = 1e-3


def train(weights: Iterable[nn.Parameter], loss_of: Callable[[], Tensor], rate: float = RATE) -> None:
    """Take a step with an optimiser of its own."""
    optimiser = torch.optim.SGD(weights, lr=rate)
    optimiser.zero_grad()
    torch.autograd.backward(loss_of())
    optimiser.step()


# ---- the end of a stage ------------------------------------------------------------------------------------


@dataclasses.dataclass
class Merges(Method):
    """Moves the weights at the end of a stage, and declares nothing."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        with torch.no_grad():
            for one in policy.parameters():
                one.mul_(0.99)


@dataclasses.dataclass
class MergesWhole(Merges):
    """Moves the weights at the end of a stage, and says so."""

    whole_stages = True


@dataclasses.dataclass
class TrainsAtEnd(Method):
    """Trains the policy where no step to the criterion counts."""

    whole_stages = True

    def end_task(self, policy: Policy, stage: Stage) -> None:
        batch = stage.target.sample(4)
        train(policy.parameters(), lambda: policy.action_loss(batch).mean(), rate=0.1)


@dataclasses.dataclass
class TrainsAtFixedEnd(TrainsAtEnd):
    """Trains the policy at the end of a stage that no criterion ends."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        self.fixed = False
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        self.fixed = not progress.to_criterion
        return policy.action_loss(batch).mean()

    def end_task(self, policy: Policy, stage: Stage) -> None:
        if self.fixed:
            super().end_task(policy, stage)


@dataclasses.dataclass
class Generates(Method):
    """Trains a model of the states, which no action depends on, at the end of a stage."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        model, states = nn.Linear(4, 4), stage.target.sample(4).state.cpu()
        train(model.parameters(), lambda: model(states).square().mean())


@dataclasses.dataclass
class TrainsInCopy(TrainsAtEnd):
    """Trains a copy, and gives its weights to the policy."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        twin = TransformerPolicy(policy.config)
        twin.load_state_dict(policy.state_dict())
        super().end_task(twin, stage)
        policy.load_state_dict(twin.state_dict())


# ---- copies of the policy ----------------------------------------------------------------------------------


def pull(policy: Policy, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
    """Act with half of the noise."""
    return type(policy).act(policy, state, words, noise / 2, image)


@dataclasses.dataclass
class Closes(Method):
    """Replaces `act` by a function that closes over the policy."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        policy.act = lambda *arguments: pull(policy, *arguments)

    def load_state(self, policy: Policy, state: MethodState) -> None:
        self.prepare(policy, Prior({}))


@dataclasses.dataclass
class Binds(Closes):
    """Replaces `act` by a method of the policy."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        policy.act = types.MethodType(pull, policy)


@dataclasses.dataclass
class Partial(Closes):
    """Replaces `act` by a function whose first argument a copy replaces."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        policy.act = functools.partial(pull, policy)


@dataclasses.dataclass
class KeepsGraph(Method):
    """Gives the policy a tensor with a graph."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        return policy.head.parameters()

    def end_task(self, policy: Policy, stage: Stage) -> None:
        policy.kept = next(policy.parameters()).sum()

    def load_state(self, policy: Policy, state: MethodState) -> None:
        policy.kept = next(policy.parameters()).sum()


# ---- groups and steps of the method's own ------------------------------------------------------------------


@dataclasses.dataclass
class WrongKey(Method):
    """Gives a group a learning rate under a name that PyTorch ignores."""

    def start_task(self, policy: Policy, stage: Stage) -> list[dict[str, Any]]:
        return [{"params": policy.parameters(), "learning_rate": RATE}]


@dataclasses.dataclass
class RightKeys(Method):
    """Names its groups, and gives one of them a learning rate."""

    def start_task(self, policy: Policy, stage: Stage) -> list[dict[str, Any]]:
        body = {"params": policy.backbone.parameters(), "name": "backbone", "weight_decay": 0.1}
        return [body, {"params": policy.head.parameters(), "lr": 2 * RATE}]


@dataclasses.dataclass
class OwnRate(Method):
    """Takes steps that `step_factor` does not change."""

    def _rate(self) -> float:
        return 0.05

    @torch.no_grad()
    def gradients(self, policy: Policy, loss: Tensor) -> None:
        torch.autograd.backward(loss)
        for one in policy.parameters():
            if one.grad is not None:
                one.sub_(self._rate() * one.grad)

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        return 0.0


@dataclasses.dataclass
class ScaledRate(OwnRate):
    """Takes steps that `step_factor` scales."""

    def _rate(self) -> float:
        return 0.05 * self.step_factor


# ---- episodes in a hook ------------------------------------------------------------------------------------


def play(task: str) -> None:
    env = gymnasium.make("clbench/Toy-v0", task=task)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


@dataclasses.dataclass
class PlaysSkill(Method):
    """Plays a skill that it does not declare, with Gymnasium alone."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        play("left")


@dataclasses.dataclass
class PlaysTarget(Method):
    """Plays its own target."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        play(stage.task.name)


@dataclasses.dataclass
class PlaysTests(Method):
    """Plays test episodes of its own target."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        Evaluator(clbench.testing.TOY, 0).evaluate(policy, [stage.task], "test")


FAULTS: list[tuple[type[Method], str, str, str]] = [
    (Merges, "criterion", "`whole_stages = True`", "whole_stages is False, and end_task() changes"),
    (TrainsAtEnd, "criterion", "without training", "changes the actions, with 1 optimiser step"),
    (TrainsInCopy, "criterion", "without training", "changes the actions, with 1 optimiser step"),
    (Closes, "sound hooks", "to act with its own weights", "change with the weights of the original"),
    (KeepsGraph, "sound hooks", "that copy.deepcopy() can copy", "Only Tensors created explicitly"),
    (WrongKey, "sound hooks", "such as `lr`", "'learning_rate', which no step reads"),
    (OwnRate, "learning", "other weights with a smaller step_factor", "with 0.3 times the step_factor"),
    (PlaysSkill, "declared data", "its own target", "runs episodes of left, which its `uses` does not"),
    (PlaysTests, "declared data", "play validation episodes", "runs test episodes of right"),
]


def check_clause(cls: type[Method], clause: str) -> None:
    """Check one clause; data that a hook must not use are found as soon as it runs."""
    named = "sound hooks" if clause == "declared data" else clause
    (check,) = (one for one in method_checks(cls) if str(one) == named.replace(" ", "_"))
    check()


@pytest.mark.long
@pytest.mark.parametrize(("cls", "clause", "expected", "found"), FAULTS)
def test_a_fault_in_what_the_policy_does_is_found(
    cls: type[Method], clause: str, expected: str, found: str
) -> None:
    with pytest.raises(ContractError) as caught:
        check_clause(cls, clause)
    error = caught.value
    assert error.clause == clause
    assert expected in error.expected
    assert found in error.found


RIGHT: list[tuple[type[Method], str]] = [
    (MergesWhole, "criterion"),
    (TrainsAtFixedEnd, "criterion"),
    (Generates, "criterion"),
    (Binds, "sound hooks"),
    (Partial, "sound hooks"),
    (RightKeys, "sound hooks"),
    (ScaledRate, "learning"),
    (PlaysTarget, "declared data"),
]


@pytest.mark.long
@pytest.mark.parametrize(("cls", "clause"), RIGHT)
def test_what_resembles_such_a_fault_passes(cls: type[Method], clause: str) -> None:
    check_clause(cls, clause)


def test_rounding_and_numbers_that_are_not_finite_are_no_merge() -> None:
    actions = torch.rand(4, 8, 2)
    assert not moved(actions, actions + 1e-6)
    assert not moved(actions, actions * float("nan"))
    assert moved(actions, actions + 1e-3)


def test_the_check_of_a_copy_leaves_the_weights_as_they_were() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right").sample(4)
    kept = {name: one.clone() for name, one in policy.state_dict().items()}
    check_copy(policy, batch)
    assert all(one.equal(kept[name]) for name, one in policy.state_dict().items())


def test_asking_for_actions_draws_nothing() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right").sample(4)
    policy.act = lambda *_: torch.rand(4, 8, 2)
    torch.manual_seed(0)
    first = torch.rand(1)
    torch.manual_seed(0)
    actions_of(policy, batch)
    assert torch.rand(1).equal(first)


@dataclasses.dataclass
class Fingerprints(Method):
    """Asks for the arithmetic of the processor, which three optimiser steps of clbench measure."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        arithmetic_hash()


@pytest.mark.long
def test_optimiser_steps_of_clbench_itself_do_not_count_as_those_of_a_method() -> None:
    toy_data.cache_clear()
    arithmetic_hash.cache_clear()
    assert ToyRun(Fingerprints, 1, 1).outcomes["prepare", "steps"] == 0
