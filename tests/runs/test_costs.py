"""What a run counts, and what it refuses: steps, parameters, kept data, seconds, and draws of the target."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny import TINY

from clbench.data.training_data import TrainingData
from clbench.learning.method import Method, MethodState, Stage
from clbench.learning.pretraining import pretrained_policy
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

STEPS = TINY.budget.adaptation_steps
BATCH = TINY.budget.batch_size


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
class Dropping(Method):
    """Keeps data in tensors, text and numbers, and nothing after the last target."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.is_over = stage.number == len(TINY.target)

    def state(self) -> Any:
        if getattr(self, "is_over", False):
            return {}
        return {"tensor": torch.zeros(3).double(), "text": "café!", "one": 1, "half": 0.5, "mark": True}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        pass


@dataclasses.dataclass
class Growing(Method):
    """Adds five parameters to the policy."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_parameter("scale", torch.nn.Parameter(torch.zeros(5)))

    def load_state(self, policy: Policy, state: MethodState) -> None:
        self.prepare(policy, None)


@dataclasses.dataclass
class Keeping(Method):
    """Keeps all demonstrations to the end."""

    uses = dataclasses.replace(Method.uses, demonstrations="throughout")


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
class Masked(Method):
    """Adds a mask that checkpoints leave out, because it is made again."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_buffer("mask", torch.full((2,), -torch.inf), persistent=False)


@dataclasses.dataclass
class Listing(Method):
    """Keeps a list, of which nobody counts the bytes."""

    def state(self) -> Any:
        return {"losses": [0.5] * 1000}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        pass


@dataclasses.dataclass
class Silent(Method):
    """Forgets to return its state."""

    def state(self) -> Any:
        pass


@dataclasses.dataclass
class Wordy(Method):
    """Has a state with a name that no file of a state may have."""

    def state(self) -> MethodState:
        return {"w" * 201: 1}


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


@pytest.mark.long
@pytest.mark.parametrize(("method", "more"), [(Consolidating, 2 * 7), (Preparing, 5)])
def test_steps_outside_of_the_loop_are_counted(
    method: type[Method], more: int, stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    record = execute(RunSpec(TINY.id, stranger(method), seed=0), tmp_path)
    assert record.costs.optimiser_steps == 2 * STEPS + more


@pytest.mark.long
def test_a_buffer_that_the_method_added_is_kept_data(
    stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    record = execute(RunSpec(TINY.id, stranger(Hiding), seed=0), tmp_path)
    assert record.costs.bytes_kept == 16 * 4


@pytest.mark.long
def test_numbers_and_text_are_kept_data_also_in_a_state_that_the_last_stage_drops(
    stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    record = execute(RunSpec(TINY.id, stranger(Dropping), seed=0), tmp_path)
    assert record.status == "success"  # else the last stage dropped nothing
    assert record.costs.bytes_kept == 3 * 8 + 6 + 2 * 8  # "é" takes two bytes; a mark is no data


@pytest.mark.long
def test_demonstrations_that_are_kept_to_the_end_are_those_of_the_skills_and_of_earlier_targets(
    stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    policy, _ = pretrained_policy(TINY, 0)
    data = TrainingData.open(TINY, policy.config)
    skills = sum(data.demonstrations(task).bytes for task in TINY.retained)
    kept = [
        execute(RunSpec(TINY.id, stranger(Keeping), seed=0, targets=count), tmp_path).costs.bytes_kept
        for count in (1, 2)
    ]
    assert kept == [skills, skills + data.demonstrations(TINY.target[0]).bytes]


@pytest.mark.long
@pytest.mark.usefixtures("empty_caches")
def test_all_parameters_are_counted_also_frozen_ones_and_those_that_the_method_added(
    stranger: Callable[[type[Method]], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = TransformerPolicy.__init__

    def half_frozen(self: TransformerPolicy, *args: Any, **kwargs: Any) -> None:
        make(self, *args, **kwargs)
        self.backbone_layers[0].requires_grad_(False)

    monkeypatch.setattr(TransformerPolicy, "__init__", half_frozen)
    record = execute(RunSpec(TINY.id, stranger(Growing), seed=0, targets=1), tmp_path)
    policy, _ = pretrained_policy(TINY, 0)
    assert record.costs.parameters == sum(value.numel() for value in policy.parameters())
    assert record.costs.parameters_added == 5


def test_the_seconds_of_a_run_hold_those_of_its_preparation_and_of_relearning(
    stranger: Callable[[type[Method]], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = time.perf_counter()
    now = [begin]

    def taking(seconds: float) -> Callable[..., None]:
        def wait(*_: Any) -> None:
            now[0] += seconds

        return wait

    module = "clbench.runs.run"
    monkeypatch.setattr(f"{module}.time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(f"{module}.relearns", lambda _: True)
    for name, seconds in (("relearn", 50), ("evaluate_start", 1000)):
        monkeypatch.setattr(f"{module}.{name}", taking(seconds))
    monkeypatch.setattr(Growing, "prepare", taking(10_000))
    monkeypatch.setattr(Growing, "load_state", lambda *_: None)
    record = execute(RunSpec(TINY.id, stranger(Growing), seed=0, targets=1), tmp_path)
    assert (record.timing["preparation"], record.timing["relearning"]) == (10_000, 50)
    # the run itself takes its beginning from the real clock, a little later than here
    late = 11_050 - record.timing["seconds"]
    assert -0.01 < late < time.perf_counter() - begin + 0.01


def test_a_mask_that_no_checkpoint_holds_need_not_be_finite(
    stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    record = execute(RunSpec(TINY.id, stranger(Masked), seed=0, targets=1), tmp_path)
    assert record.status == "success", record.error


@pytest.mark.parametrize(
    ("method", "where", "message"),
    [
        (Forgetful, "load_state() after stage 0", "load_state() must give a new policy the parameters and "),
        (Listing, "state() after stage 0", "Booleans and None, not a list, 'losses'."),
        (Silent, "state() after stage 0", "state() must return a dictionary, not NoneType."),
        (
            Wordy,
            "state() after stage 0",
            "short names (a tensor may hold any number), not an entry: a name of 201",
        ),
        (Endless, "prepare", "The buffer mask is not finite after prepare()."),
        (
            Greedy,
            "loss() of stage 1 (right)",
            f"draws {2 * BATCH} samples of the target in a step: the budget of every method is {BATCH}, the",
        ),
    ],
)
def test_a_method_is_told_what_it_did_wrong(
    method: type[Method],
    where: str,
    message: str,
    stranger: Callable[[type[Method]], str],
    tmp_path: Path,
) -> None:
    record = execute(RunSpec(TINY.id, stranger(method), seed=0), tmp_path)
    assert record.error is not None
    assert record.error["where"] == where
    assert message in record.error["message"]
