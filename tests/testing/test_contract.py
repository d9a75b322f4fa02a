"""The contract: planted faults are found, each with its own message; sound methods pass."""

import dataclasses
import os
import pickle
import random
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from faults_of_state import FAULTS_OF_STATE, Doubles, Draws, Exports, Moves, Patches, Seeded, Threads
from torch import Tensor, nn

from clbench.learning.method import Method, MethodState, Progress, Stage
from clbench.learning.prior import Prior, Source, Uses
from clbench.learning.registry import load_method
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.testing import Check, ContractError, check_method, method_checks
from clbench.testing.toy_run import HOOKS, ToyRun

# mypy: disable-error-code="arg-type, assignment, attr-defined, dict-item, misc, override"
# A type checker finds many of these faults.

CONTRACT = Path(__file__).parents[2] / "docs" / "guide" / "contract.md"


# ---- faults of the class -----------------------------------------------------------------------------------


class Plain(Method):
    """Is not a dataclass."""


@dataclasses.dataclass
class Silent(Method):  # noqa: D101 - the fault
    rate: float = 0.5


@dataclasses.dataclass
class Annotated(Method):
    """Makes its declaration a hyper-parameter."""

    uses: Uses = Uses(questions="prepare")  # noqa: RUF009 - the fault


@dataclasses.dataclass
class Undeclared(Method):
    """Declares its use with a string."""

    uses = "questions"


@dataclasses.dataclass
class Misspelt(Method):
    """Misspells a hook."""

    def gradient(self, policy: Policy, loss: Tensor) -> None: ...


HELPS = {"__doc__": "Has a public function that is no hook.", "compute_loss": lambda self: None}
Helpful: Any = dataclasses.dataclass(type("Helpful", (Method,), HELPS))


@dataclasses.dataclass
class Forgetful(Method):
    """Leaves out an argument of a hook."""

    def loss(self, policy: Policy, batch: Batch) -> Tensor:
        return policy.action_loss(batch).mean()


# ---- faults of a hook --------------------------------------------------------------------------------------


@dataclasses.dataclass
class Counts(Method):
    """Returns a share of steps."""

    def prepare(self, policy: Policy, prior: Prior) -> float:
        return 0.5


@dataclasses.dataclass
class Idle(Method):
    """Trains nothing and competes."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        return ()


@dataclasses.dataclass
class Nameless(Method):
    """Returns names and no parameters."""

    def start_task(self, policy: Policy, stage: Stage) -> list[str]:
        return [name for name, _ in policy.named_parameters()]


@dataclasses.dataclass
class Freezes(Method):
    """Freezes the parameters that it returns."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        return policy.requires_grad_(False).parameters()


@dataclasses.dataclass
class Greedy(Method):
    """Takes two batches in a step."""

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        return target.sample(2 * target.batch_size)


@dataclasses.dataclass
class PerSample(Method):
    """Takes no mean."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.action_loss(batch)


@dataclasses.dataclass
class Diverges(Method):
    """Has a loss that is not a number."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.action_loss(batch).mean() * float("nan")


@dataclasses.dataclass
class Detached(Method):
    """Has a loss without a gradient."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.action_loss(batch).mean().detach()


@dataclasses.dataclass
class NoGradients(Method):
    """Computes no gradients."""

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        pass


@dataclasses.dataclass
class Whole(Method):
    """Has an integer as learning rate."""

    def learning_rate(self, scheduled: float, progress: Progress) -> int:
        return 1


@dataclasses.dataclass
class Poisons(Method):
    """Leaves weights that are not numbers."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        policy.state_dict()["head.position"].fill_(float("nan"))


@dataclasses.dataclass
class Breaks(Method):
    """Raises an error."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        raise RuntimeError(f"cannot merge {stage.task.name}")


@dataclasses.dataclass
class Boasts(Method):
    """Returns diagnostics that JSON cannot hold."""

    def diagnostics(self) -> dict[str, Any]:
        return {"gain": float("inf")}


# ---- faults of data ----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Sneaks(Method):
    """Replays without a declaration."""

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        return prior.demonstrations.sample(4)


@dataclasses.dataclass
class Lingers(Method):
    """Replays data that it declares only for the preparation."""

    uses = Uses(demonstrations="prepare")

    def prepare(self, policy: Policy, prior: Prior) -> None:
        prior.demonstrations.sample(1)

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        return prior.demonstrations.sample(4)


@dataclasses.dataclass
class Hoards(Method):
    """Continues to draw from the first target."""

    kept: ClassVar[list[Source[Batch]]] = []

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        self.kept.append(target)
        return self.kept[0].sample(4)


@dataclasses.dataclass
class Modest(Method):
    """Declares data that it does not use."""

    uses = Uses(questions="throughout")


@dataclasses.dataclass
class Early(Method):
    """Declares more than it uses."""

    uses = Uses(demonstrations="throughout")

    def prepare(self, policy: Policy, prior: Prior) -> None:
        prior.demonstrations.sample(8)


FAULTS: list[tuple[Any, str, str, str]] = [
    (3, "declaration", "a subclass of clbench.Method", "found:    3"),
    (Plain, "declaration", "a dataclass", "Plain is not decorated"),
    (Silent, "declaration", "a class docstring", "none"),
    (Annotated, "declaration", "without an annotation", "uses is a field of the dataclass"),
    (Undeclared, "declaration", "uses to be a Uses", "'questions'"),
    (Helpful, "declaration", "Names of helpers begin with _", "compute_loss() is never called"),
    (Misspelt, "declaration", "Did you mean 'gradients()'?", "gradient() is never called"),
    (Forgetful, "declaration", "loss(self, policy, batch, progress)", "loss(self, policy, batch)"),
    (Counts, "sound hooks", "the number of optimiser steps that it took, or None", "0.5"),
    (Idle, "sound hooks", "only a reference, `uses = Uses(reference=True)`, may train none", "none"),
    (Nameless, "sound hooks", "an iterable of the policy's parameters", "the params is str"),
    (Freezes, "sound hooks", "parameters that require a gradient", "one that does not"),
    (Greedy, "declared data", "at most a batch of the target in a step", "draws 32 samples of the target"),
    (PerSample, "sound hooks", "a finite scalar tensor", "loss must be a scalar, shape (), not (16,)"),
    (Diverges, "sound hooks", "a finite scalar tensor", "loss is nan, not finite"),
    (Detached, "sound hooks", "tensor that has a gradient", "loss has no gradient; was it detached?"),
    (NoGradients, "sound hooks", "finite gradients of the trained parameters", "no parameter"),
    (
        Whole,
        "sound hooks",
        "a finite float of at least 0",
        "the learning rate must be a finite float of at least 0, not 1",
    ),
    (Poisons, "sound hooks", "a policy of finite weights", "head.position is not finite after 'right'"),
    (Breaks, "sound hooks", "end_task() to run without an error", "RuntimeError: cannot merge right"),
    (Boasts, "sound hooks", "values that JSON can hold", "not JSON compliant"),
    (
        Sneaks,
        "declared data",
        "prior data that `uses` declares",
        "prior demonstrations that it does not declare",
    ),
    (Lingers, "declared data", "prior data that `uses` declares", "does not declare for this hook"),
    (Hoards, "declared data", "to draw from its arguments", "after the hooks that received it"),
    (Modest, "declared data", "prior questions to be drawn", "they are never drawn; leave them out"),
    (Early, "declared data", "prior demonstrations to be drawn", "in prepare() alone; declare 'prepare'"),
    *FAULTS_OF_STATE,
]


@pytest.mark.long
@pytest.mark.parametrize(("cls", "clause", "expected", "found"), FAULTS)
def test_a_planted_fault_is_found_with_its_own_message(
    cls: Any, clause: str, expected: str, found: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ContractError) as caught:
        check_method(cls)
    error = caught.value
    assert error.clause == clause
    assert expected in f"expected: {error.expected}"
    assert found in f"found:    {error.found}"


def test_no_two_faults_have_the_same_message() -> None:
    assert len({(expected, found) for _, _, expected, found in FAULTS}) == len(FAULTS)


@pytest.mark.long
def test_changes_that_a_faulty_method_leaves_behind_are_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def process() -> list[Any]:
        torch_settings = (torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled())
        generators = (random.getstate(), str(np.random.get_state()), torch.get_rng_state().tolist())  # noqa: NPY002
        return [*torch_settings, *generators, dict(os.environ), Path.cwd(), list(sys.path), Policy.predict]

    before = process()
    for cls in (Seeded, Threads, Doubles, Exports, Moves, Patches, Draws):
        with pytest.raises(ContractError):
            check_method(cls)
    assert process() == before


def test_a_message_shows_the_expectation_the_finding_and_the_place() -> None:
    with pytest.raises(ContractError) as caught:
        check_method(Forgetful)
    assert str(caught.value).splitlines() == [
        "The method breaks the contract: declaration.",
        "  expected: loss(self, policy, batch, progress)",
        "  found:    loss(self, policy, batch)",
        "  look at:  loss(); docs/guide/contract.md#declaration",
    ]


def test_an_error_can_be_sent_from_another_process() -> None:
    error = ContractError("state", "one", "two", "three")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_the_page_of_the_contract_has_a_heading_for_each_clause_in_order() -> None:
    lines = CONTRACT.read_text(encoding="utf-8").splitlines()
    headings = [line.removeprefix("## ") for line in lines if line.startswith("## ")]
    assert headings == [str(check).replace("_", " ").capitalize() for check in method_checks(Method)]


@dataclasses.dataclass
class Sound(Method):
    """Draws from every generator, keeps a state, and uses all data that it declares."""

    share: float = 0.5
    words: str = "a text"

    uses = Uses(demonstrations="prepare", questions="throughout")

    def prepare(self, policy: Policy, prior: Prior) -> int:
        self.anchor = prior.demonstrations.sample(4).state.mean(dim=0)
        return 1

    def batch(self, target: Source[Batch], prior: Prior) -> Any:
        return target.sample(round(self.share * target.batch_size)), prior.questions.sample(2)

    def loss(self, policy: Policy, batch: Any, progress: Progress) -> Tensor:
        demonstrations, questions = batch
        noise = torch.rand(()) + random.random() + float(np.random.rand())  # noqa: NPY002 - it may
        pull: Tensor = noise * (policy.state_mean - self.anchor).sum()
        return policy.action_loss(demonstrations).mean() + policy.answer_loss(questions).mean() + pull

    def state(self) -> MethodState:
        return {"anchor": self.anchor, "words": self.words}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        self.anchor = state["anchor"]


@dataclasses.dataclass
class Seldom(Method):
    """Asks questions at a few of the steps."""

    uses = Uses(questions="throughout")

    def batch(self, target: Source[Batch], prior: Prior) -> Any:
        self.step += 1
        return target.sample(target.batch_size), prior.questions.sample(4) if self.step % 9 == 0 else None

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        self.step = 0
        return policy.parameters()

    def loss(self, policy: Policy, batch: Any, progress: Progress) -> Tensor:
        demonstrations, questions = batch
        loss = policy.action_loss(demonstrations).mean()
        return loss if questions is None else loss + policy.answer_loss(questions).mean()


@pytest.mark.long
def test_prior_data_may_be_drawn_at_few_steps() -> None:
    check_method(Seldom)


@dataclasses.dataclass
class Generous(Method):
    """Draws more than there is, but of the target no more than a batch in a step."""

    uses = Uses(demonstrations="throughout")

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        self.batches = [one.sample(2 * len(one)) for one in (stage.target, stage.prior.demonstrations)]
        return policy.parameters()

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        return Batch.cat([target.sample(target.batch_size), prior.demonstrations.sample(99), *self.batches])

    def end_task(self, policy: Policy, stage: Stage) -> None:
        stage.target.sample(2 * len(stage.target))


@pytest.mark.long
def test_only_the_draws_of_the_target_in_a_step_are_limited() -> None:
    check_method(Generous)


CHECKS = method_checks(Sound)


@pytest.mark.parametrize("check", CHECKS, ids=str)
def test_a_sound_method_keeps_every_clause(check: Check) -> None:
    check()


def test_the_checks_have_names() -> None:
    assert [str(check) for check in CHECKS][:3] == ["declaration", "constructor", "sound_hooks"]


@pytest.mark.long
def test_settings_can_shorten_a_preparation() -> None:
    ewc = load_method("ewc")
    (check,) = (check for check in method_checks(ewc, samples=1) if str(check) == "sound_hooks")
    assert check.subject.build() == ewc(samples=1)  # type: ignore[call-arg]
    check()


def test_the_hooks_are_called_in_the_order_of_the_page() -> None:
    called: list[str] = []

    def recorded(hook: str) -> Any:
        def call(self: Method, *arguments: Any) -> Any:
            called.append(hook)
            return getattr(Method, hook)(self, *arguments)

        return call

    recording: type[Method] = dataclasses.dataclass(
        type("Recording", (Method,), {hook: recorded(hook) for hook in HOOKS if hook != "watch_pretraining"})
    )
    ToyRun(recording, targets=2, steps=2)
    step = ["batch", "loss", "gradients", "learning_rate"]
    stage = ["load_state", "start_task", *step, *step, "end_task", "diagnostics", "state"]
    assert called == ["prepare", "diagnostics", "state", *stage, *stage, "load_state"]
