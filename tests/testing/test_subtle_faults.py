"""The contract on rare cases: right methods that look wrong pass, and faults that look right are found."""

import dataclasses
from collections.abc import Iterable
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from clbench.learning.method import Method, MethodState, Progress, Stage
from clbench.learning.prior import Prior, Source
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.testing import ContractError, check_method, method_checks

# mypy: disable-error-code="assignment, attr-defined, dict-item, misc, no-any-return, operator, union-attr"
# A type checker finds many of these faults.


# ---- right methods -----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Groups(Method):
    """Has groups of parameters, as PyTorch's documentation writes them."""

    def start_task(self, policy: Policy, stage: Stage) -> list[dict[str, Any]]:
        return [{"params": policy.backbone.parameters()}, {"params": policy.head.parameters(), "lr": 2e-3}]


@dataclasses.dataclass
class Single(Method):
    """Has one group for each parameter."""

    def start_task(self, policy: Policy, stage: Stage) -> list[dict[str, Any]]:
        return [{"params": parameter} for parameter in policy.parameters()]


@dataclasses.dataclass
class Named(Method):
    """Returns parameters with their names."""

    def start_task(self, policy: Policy, stage: Stage) -> Any:
        return policy.named_parameters()


@dataclasses.dataclass
class Slots(Method):
    """Keeps a table whose empty slots are NaN, and a number of NumPy that JSON can hold."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        self.table = torch.full((4,), float("nan"))

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.table[stage.number] = 1.0

    def state(self) -> MethodState:
        return {"table": self.table, "share": np.float64(0.5)}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        self.table = state["table"]


@dataclasses.dataclass
class Structured(Method):
    """Has a helper, a helper class, constants, and fields of all types."""

    class Adapter(nn.Module):
        """A class that no hook is confused with."""

    LIMIT = 3.0
    powers: ClassVar[tuple[int, ...]] = (1, 2)
    mode: Literal["plain", "odd"] = "plain"
    share: float = 1
    layers: list[int] = dataclasses.field(default_factory=lambda: [1])
    cap: float | None = None
    tunes = ("mode", ("plain", "odd"))

    @torch.no_grad()
    def helper(self) -> int:
        """Is called by a hook."""
        return 1

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return super().loss(policy, batch, progress) * self.helper()


_cache: dict[str, float] = {}


@dataclasses.dataclass
class Caches(Method):
    """Keeps a factor for later that it could compute again."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return _cache.setdefault("factor", 1.0) * super().loss(policy, batch, progress)


@dataclasses.dataclass
class Merges(Method):
    """Merges what it can copy, and what there is after no step."""

    whole_stages = True

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        self.losses: list[float] = []
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        loss = super().loss(policy, batch, progress)
        self.losses.append(loss.item())
        return loss

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.mean = sum(self.losses) / max(len(self.losses), 1)


@pytest.mark.long
@pytest.mark.parametrize("cls", [Groups, Single, Named, Slots, Structured, Caches, Merges])
def test_a_right_method_passes(cls: type[Method]) -> None:
    check_method(cls)


# ---- faults ------------------------------------------------------------------------------------------------


class Mixin:
    """Misspells a hook of the method that it is mixed into."""

    def end_tsk(self, policy: Policy, stage: Stage) -> None: ...


@dataclasses.dataclass
class Mixed(Mixin, Method):
    """Has its hook from another class."""


@dataclasses.dataclass
class Fixed(Method):
    """Forgets the type of a hyper-parameter."""

    strength = 1.0


@dataclasses.dataclass
class Overridden(Method):
    """Means to change a default, which the dataclass does not see."""

    step_factor = 0.5


@dataclasses.dataclass
class Texts(Method):
    """Has a text where a number belongs."""

    strength: float = "0.5"


@dataclasses.dataclass
class Fractions(Method):
    """Has a fraction where a whole number belongs."""

    count: int = 0.5


@dataclasses.dataclass
class TunesNothing(Method):
    """Tunes a field that there is not."""

    strength: float = 1.0
    tunes = ("strenth", (0.1, 10.0))


@dataclasses.dataclass
class TunesFlat(Method):
    """Lists its values without a tuple."""

    strength: float = 1.0
    tunes = ("strength", 0.1, 10.0)


@dataclasses.dataclass
class TunesRefused(Method):
    """Tunes a value that it refuses."""

    strength: float = 1.0
    tunes = ("strength", (0.1, -1.0))

    def __post_init__(self) -> None:
        if self.strength < 0:
            raise ValueError("strength must not be negative")


@dataclasses.dataclass
class Late(Method):
    """Takes a second batch from the third step on."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        self.target = stage.target
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        more = [self.target.sample(1)] if progress.step > 1 else []
        return policy.action_loss(Batch.cat([batch, *more])).mean()


@dataclasses.dataclass
class Typo(Method):
    """Misspells one of its attributes."""

    strength: float = 1.0

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return self.stregth * super().loss(policy, batch, progress)


@dataclasses.dataclass
class LosesAttribute(Method):
    """Gives the policy an attribute that a checkpoint does not hold."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        policy.factor = 1.0

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.factor * super().loss(policy, batch, progress)


def replay(target: Source[Batch], memory: Iterable[Batch]) -> Batch:
    new = target.sample(target.batch_size)
    return Batch.cat([new, *(kept[torch.randint(len(kept), (8,))] for kept in memory)])


@dataclasses.dataclass
class ClassMemory(Method):
    """Replays from a list that all objects share."""

    memory: ClassVar[list[Batch]] = []

    def prepare(self, policy: Policy, prior: Prior) -> None:
        self.memory.clear()

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        return replay(target, self.memory)

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.memory.append(stage.target.sample(16))


_memory: dict[int, Batch] = {}


def _remember(number: int, samples: Batch) -> None:
    _memory[number] = samples


@dataclasses.dataclass
class ModuleMemory(Method):
    """Replays from a dictionary of the module, which a function fills."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        _memory.clear()

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        return replay(target, _memory.values())

    def end_task(self, policy: Policy, stage: Stage) -> None:
        _remember(stage.number, stage.target.sample(16))


@dataclasses.dataclass
class Masks(Method):
    """Begins each stage with the same mask."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        self.mask = torch.ones(2, dtype=torch.bool)

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.mask = ~self.mask

    def state(self) -> MethodState:
        return {"mask": self.mask}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        self.mask = torch.ones(2, dtype=torch.bool)


@dataclasses.dataclass
class Infinite(Method):
    """Has a state that JSON cannot hold."""

    def state(self) -> MethodState:
        return {"best": float("inf")}


@dataclasses.dataclass
class Sparse(Method):
    """Has a state that safetensors cannot hold."""

    def state(self) -> MethodState:
        return {"mask": torch.eye(3).to_sparse()}


@dataclasses.dataclass
class Integers(Method):
    """Has a number of NumPy as state."""

    def state(self) -> MethodState:
        return {"count": torch.ones(1, dtype=torch.int64).numpy()[0]}


@dataclasses.dataclass
class Steps(Method):
    """Counts on a step in each stage."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        self.last = progress.step
        return super().loss(policy, batch, progress)

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.seen = self.last


@dataclasses.dataclass
class LastStep(Method):
    """Waits for the last step."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        if progress.step == progress.steps - 1:
            self.average = 1.0
        return super().loss(policy, batch, progress)

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.mean = self.average


@dataclasses.dataclass
class MergesTooEarly(Steps):
    """Merges at the end of a stage, and counts on a step."""

    whole_stages = True


@dataclasses.dataclass
class KeepsGraphs(Method):
    """Keeps a loss with its graph, which cannot be copied."""

    whole_stages = True

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        self.kept = super().loss(policy, batch, progress)
        return self.kept


FAULTS: list[tuple[type[Method], str, str, str]] = [
    (Mixed, "declaration", "Did you mean 'end_task()'?", "end_tsk() is never called"),
    (Fixed, "declaration", "with an annotation, `strength: float = 1.0`", "`strength = 1.0`"),
    (Overridden, "declaration", "no run could change step_factor", "`step_factor = 0.5`"),
    (Texts, "constructor", "a default of the annotated type", "strength='0.5' is a string, not 0.5"),
    (Fractions, "constructor", "a default of the annotated type", "count must be a whole number, not 0.5"),
    (TunesNothing, "declaration", "the name of a field and two values of it", "strenth"),
    (TunesFlat, "declaration", "(name, (a, b))", "('strength', 0.1, 10.0)"),
    (TunesRefused, "declaration", "values in tunes that the class takes", "strength must not be negative"),
    (Late, "declared data", "at most a batch of the target in a step", "17 samples of the target in a step"),
    (
        Typo,
        "sound hooks",
        "loss() to run without an error",
        "'stregth' in the Typo. Did you mean 'strength'?",
    ),
    (
        LosesAttribute,
        "state",
        "only what load_state() sets",
        "no attribute 'factor' in the TransformerPolicy",
    ),
    (ClassMemory, "state", "an interrupted run loses attributes of the class", "differs in stage 2 (down)"),
    (ModuleMemory, "state", "loses attributes of the class and global variables", "stage 2 (down)"),
    (
        Masks,
        "state",
        "state() to return everything",
        "state 'mask' differs in state() after stage 2 by up to 1",
    ),
    (Infinite, "state", "finite numbers", "'best': a number that is not finite"),
    (Sparse, "state", "dense tensors", "a sparse one, 'mask'; store mask.to_dense()"),
    (Integers, "state", "a flat dictionary of tensors", "a int64, 'count'; store count.item()"),
    (
        Steps,
        "criterion",
        "after any number of steps, also after none",
        "end_task() finds no attribute 'last'",
    ),
    (LastStep, "criterion", "after any number of steps", "end_task() finds no attribute 'average'"),
    (MergesTooEarly, "criterion", "the first check before the first step", "end_task() finds no attribute"),
    (KeepsGraphs, "criterion", "detach the tensors that it keeps", "Only Tensors created explicitly"),
]


@pytest.mark.long
@pytest.mark.parametrize(("cls", "clause", "expected", "found"), FAULTS)
def test_a_subtle_fault_is_found(cls: type[Method], clause: str, expected: str, found: str) -> None:
    with pytest.raises(ContractError) as caught:
        check_method(cls)
    error = caught.value
    assert error.clause == clause
    assert expected in f"expected: {error.expected}"
    assert found in f"found:    {error.found}"


@pytest.mark.long
def test_what_a_class_and_its_module_hold_is_back_after_a_check() -> None:
    held, memory = ClassMemory.memory, _memory
    for cls in (ClassMemory, ModuleMemory):
        with pytest.raises(ContractError):
            check_method(cls)
    assert ClassMemory.memory is held
    assert _memory is memory


@dataclasses.dataclass
class Demanding(Method):
    """Has a hyper-parameter without a default."""

    rate: float


def test_a_class_that_makes_no_object_is_named_by_every_check_that_needs_one() -> None:
    found = []
    for check in method_checks(Demanding):
        try:
            check()
        except ContractError as error:
            found.append((str(check), error.clause))
    needless = ("declaration", "declared_data")  # it declares no data
    names = [str(check) for check in method_checks(Demanding)]
    assert found == [(name, "constructor") for name in names if name not in needless]


@pytest.mark.long
def test_a_check_passes_where_the_missing_default_is_given() -> None:
    (check,) = (check for check in method_checks(Demanding, rate=0.5) if str(check) == "sound_hooks")
    check()
