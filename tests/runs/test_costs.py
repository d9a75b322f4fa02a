"""What a run counts, and what it refuses: steps outside of the loop, buffers, and draws of the target."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from clbench.learning.method import Method, MethodState, Stage
from clbench.policy.policy import Policy
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.testing import TOY

ID = "clbench.testing:clbench/Toy-v0"
STEPS = TOY.budget.adaptation_steps
BATCH = TOY.budget.batch_size


def train(policy: Policy, batches: Any, steps: int) -> None:
    """Take steps with an optimiser of one's own."""
    optimiser = torch.optim.SGD(policy.parameters(), lr=1e-5)
    for _ in range(steps):
        optimiser.zero_grad()
        torch.autograd.backward(policy.action_loss(batches()).mean())
        optimiser.step()


@dataclasses.dataclass
class Consolidating(Method):
    """Trains after each stage, as methods do that consolidate what they learned."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        train(policy, lambda: stage.target.sample(BATCH), 7)


@dataclasses.dataclass
class Preparing(Method):
    """Trains before the first target, and declares fewer steps than it takes."""

    uses = dataclasses.replace(Method.uses, demonstrations="prepare")

    def prepare(self, policy: Policy, prior: Any) -> int:
        train(policy, lambda: prior.demonstrations.sample(BATCH), 5)
        return 3


@dataclasses.dataclass
class Hiding(Method):
    """Keeps samples in a buffer of the policy."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_buffer("memory", torch.zeros(16))

    def load_state(self, policy: Policy, state: MethodState) -> None:
        policy.register_buffer("memory", torch.ones(16))


@dataclasses.dataclass
class Forgetful(Hiding):
    """Adds a buffer and does not add it again."""

    def load_state(self, policy: Policy, state: MethodState) -> None:
        pass


@dataclasses.dataclass
class Endless(Hiding):
    """Adds a buffer that no checkpoint can hold."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_buffer("mask", torch.full((2,), -torch.inf))


@dataclasses.dataclass
class Greedy(Method):
    """Draws a second batch of the target from its third step on."""

    def loss(self, policy: Policy, batch: Any, progress: Any) -> torch.Tensor:
        if progress.step >= 2:
            batch = self.target.sample(BATCH)
        return policy.action_loss(batch).mean()

    def start_task(self, policy: Policy, stage: Stage) -> Any:
        self.target = stage.target
        return policy.parameters()


@dataclasses.dataclass
class Hoarding(Method):
    """Keeps the sources of a stage for the next one."""

    def start_task(self, policy: Policy, stage: Stage) -> Any:
        SOURCES.append(stage.target)
        SOURCES[0].sample(1)
        return policy.parameters()


SOURCES: list[Any] = []


@pytest.mark.long
@pytest.mark.parametrize(("method", "more"), [(Consolidating, 2 * 7), (Preparing, 5)])
def test_steps_outside_of_the_loop_are_counted(
    method: type[Method], more: int, stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    record = execute(RunSpec(ID, stranger(method), seed=0), tmp_path)
    assert record.costs.optimiser_steps == 2 * STEPS + more


@pytest.mark.long
def test_a_buffer_that_the_method_added_is_kept_data(
    stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    record = execute(RunSpec(ID, stranger(Hiding), seed=0), tmp_path)
    assert record.costs.bytes_kept == 16 * 4


@pytest.mark.parametrize(
    ("method", "where", "message"),
    [
        (Forgetful, "load_state() after stage 0", "load_state() must give a new policy the parameters and "),
        (Endless, "prepare", "The buffer mask is not finite after prepare()."),
        (
            Greedy,
            "loss() of stage 1 (right)",
            f"draws {2 * BATCH} samples of the target in a step: {BATCH}, its",
        ),
        (Hoarding, "start_task() of stage 2 (down)", "draws from data after the hooks that received it"),
    ],
)
def test_a_method_is_told_what_it_did_wrong(
    method: type[Method],
    where: str,
    message: str,
    stranger: Callable[[type[Method]], str],
    tmp_path: Path,
) -> None:
    SOURCES.clear()
    record = execute(RunSpec(ID, stranger(method), seed=0), tmp_path)
    assert record.error is not None
    assert record.error["where"] == where
    assert message in record.error["message"]
