"""Methods with faults of the constructor and of state: `tests/testing/test_contract.py` must find each."""

import dataclasses
import os
import random
import sys
import time
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from clbench.learning.method import Method, MethodState, Progress, Stage
from clbench.learning.prior import Prior, Source
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy


@dataclasses.dataclass
class AnnotatedStrength(Method):
    """Makes the name of its strength a hyper-parameter."""

    strength: float = 1.0
    tunes: tuple[str, tuple[float, float]] = ("strength", (0.1, 10.0))  # type: ignore[misc] # the fault


@dataclasses.dataclass
class Demanding(Method):
    """Has a hyper-parameter without a default."""

    rate: float


@dataclasses.dataclass
class Prepared(Method):
    """Sets what it learns in the constructor."""

    def __post_init__(self) -> None:
        self.buffer: list[Tensor] = []


@dataclasses.dataclass
class Capped(Method):
    """Takes no more rounds than its default."""

    rounds: int = 2

    def __post_init__(self) -> None:
        self.rounds = min(self.rounds, 2)


@dataclasses.dataclass
class Rounding(Method):
    """Changes its argument."""

    rate: float = 0.5

    def __post_init__(self) -> None:
        self.rate = round(self.rate)


@dataclasses.dataclass
class Loaded(Method):
    """Has a tensor as hyper-parameter."""

    weights: Tensor = dataclasses.field(default_factory=lambda: torch.zeros(2))


@dataclasses.dataclass
class Named(Method):
    """Has a dictionary as hyper-parameter."""

    factors: object = dataclasses.field(default_factory=lambda: {"backbone": 0.1})


@dataclasses.dataclass(eq=False)
class Unequal(Method):
    """Has objects that differ."""


@dataclasses.dataclass
class Learned(Method):
    """Has a field for what it learns."""

    anchor: float = dataclasses.field(default=0.0, init=False)


@dataclasses.dataclass
class Seeded(Method):
    """Seeds in the constructor."""

    def __post_init__(self) -> None:
        torch.manual_seed(0)


@dataclasses.dataclass
class Picky(Method):
    """Refuses its own defaults."""

    def __post_init__(self) -> None:
        raise ValueError("never")


# ---- faults of repetition and state ------------------------------------------------------------------------


@dataclasses.dataclass
class Timed(Method):
    """Weighs by the clock."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.action_loss(batch).mean() * (1 + time.perf_counter() % 1)


@dataclasses.dataclass
class Remembers(Method):
    """Counts in its class."""

    runs: ClassVar[list[int]] = []

    def prepare(self, policy: Policy, prior: Prior) -> None:
        self.runs.append(1)

    def diagnostics(self) -> dict[str, Any]:
        return {"runs": len(self.runs)}


@dataclasses.dataclass
class Reseeds(Method):
    """Seeds before it draws."""

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        np.random.seed(0)  # noqa: NPY002 - the fault
        return target.sample(target.batch_size)


@dataclasses.dataclass
class Anchored(Method):
    """Keeps the anchor in the object alone."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        self.anchor = policy.state_mean.clone()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.action_loss(batch).mean() + self.anchor.sum()


@dataclasses.dataclass
class Restarts(Method):
    """Restarts its count silently."""

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        self.count = getattr(self, "count", 0) + 1
        loss.backward()  # type: ignore[no-untyped-call]
        for parameter in policy.parameters():
            if parameter.grad is not None:
                parameter.grad.mul_(0.1**self.count)


@dataclasses.dataclass
class Structured(Method):
    """Has a list as state."""

    def state(self) -> MethodState:
        return {"losses": [0.5]}  # type: ignore[dict-item] # the fault


@dataclasses.dataclass
class Bundles(Method):
    """Has a batch as state."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        self.buffer = stage.target.sample(4)

    def state(self) -> MethodState:
        return {"buffer": self.buffer} if hasattr(self, "buffer") else {}  # type: ignore[dict-item] # the fault


@dataclasses.dataclass
class OneWay(Method):
    """Cannot load its state."""

    def state(self) -> MethodState:
        return {"count": 1}


@dataclasses.dataclass
class Grows(Method):
    """Adds a parameter and never again."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        policy.register_parameter("scale", nn.Parameter(torch.ones(3)))


@dataclasses.dataclass
class Draws(Method):
    """Draws in its diagnostics."""

    def diagnostics(self) -> dict[str, Any]:
        return {"luck": bool(random.random() < 2)}


# ---- faults that persist in the process --------------------------------------------------------------------


@dataclasses.dataclass
class Threads(Method):
    """Takes more threads."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        torch.set_num_threads(2)


@dataclasses.dataclass
class Doubles(Method):
    """Changes the default dtype."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        torch.set_default_dtype(torch.float64)


@dataclasses.dataclass
class Blind(Method):
    """Turns gradients off."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        torch.set_grad_enabled(False)


@dataclasses.dataclass
class Careless(Method):
    """Allows nondeterministic algorithms."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        torch.use_deterministic_algorithms(False)
        return policy.parameters()


@dataclasses.dataclass
class Approximate(Method):
    """Allows TF32."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        torch.backends.cuda.matmul.fp32_precision = "tf32"


@dataclasses.dataclass
class Exports(Method):
    """Sets a variable of the environment."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        os.environ["LIVELY"] = "1"


@dataclasses.dataclass
class Moves(Method):
    """Changes the working directory."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        os.chdir("/")


@dataclasses.dataclass
class Paths(Method):
    """Changes the search path of modules."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        sys.path.append("/nowhere")


@dataclasses.dataclass
class Quiet(Method):
    """Silences warnings."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        warnings.simplefilter("ignore")


@dataclasses.dataclass
class Writes(Method):
    """Writes a file."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        Path("losses.txt").write_text("0.5")


@dataclasses.dataclass
class Patches(Method):
    """Changes the class of all policies."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        setattr(Policy, "predict", Policy.act)  # noqa: B010 - mypy minds an assignment


# ---- faults of learning ------------------------------------------------------------------------------------


@dataclasses.dataclass
class Standstill(Method):
    """Takes steps of length 0."""

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        return 0.0


@dataclasses.dataclass
class Backwards(Method):
    """Ascends."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return -policy.action_loss(batch).mean()


FAULTS_OF_STATE: list[tuple[Any, str, str, str]] = [
    (AnnotatedStrength, "declaration", "without an annotation", "tunes is a field of the dataclass"),
    (Demanding, "constructor", "a default for every hyper-parameter", "rate has none"),
    (Prepared, "constructor", "only hyper-parameters to be stored", "it sets buffer"),
    (Rounding, "constructor", "to be kept unchanged", "rate=0.5 becomes 0"),
    (Capped, "constructor", "to be kept unchanged", "rounds=3 becomes 2"),
    (Loaded, "constructor", "numbers, Booleans, strings", "weights is a Tensor"),
    (Named, "constructor", "numbers, Booleans, strings", "factors is a dict, {'backbone': 0.1}"),
    (Unequal, "constructor", "equal objects from equal arguments", "two objects with the defaults differ"),
    (Learned, "constructor", "every field to be a hyper-parameter", "anchor has init=False"),
    (
        Seeded,
        "constructor",
        "a constructor that only stores values",
        "torch's random generator was moved or set",
    ),
    (Picky, "constructor", "the defaults to make an object", "ValueError: never"),
    (Timed, "same numbers", "two runs with one seed to be equal", "differs in stage 1 (right) by up to"),
    (Remembers, "same numbers", "two runs with one seed to be equal", "diagnostics differs in prepare"),
    (Reseeds, "seeding", "draw, but do not seed", "after batch() numpy.random is in the same state"),
    (Anchored, "state", "a new object that has only what load_state() sets", "no attribute 'anchor'"),
    (Restarts, "state", "state() to return everything that later stages need", "differs in stage 2 (down)"),
    (Structured, "state", "a flat dictionary of tensors, strings, numbers", "a list, 'losses'"),
    (
        Bundles,
        "state",
        "a flat dictionary of tensors",
        "a Batch, 'buffer'; store its tensors, {**vars(batch)}",
    ),
    (OneWay, "state", "load_state() to run without an error", "returns a state() but has no load_state()"),
    (Grows, "state", "load_state() to add to a plain policy what prepare() added", "scale"),
    (Draws, "global state", "as it was", "after diagnostics() Python's random generator was moved"),
    (Threads, "global state", "as it was", "after prepare() torch.get_num_threads() is 2, was 1"),
    (Doubles, "global state", "as it was", "torch.get_default_dtype() is torch.float64"),
    (Blind, "global state", "as it was", "after end_task() torch.is_grad_enabled() is False"),
    (Careless, "global state", "as it was", "are_deterministic_algorithms_enabled() is False"),
    (Approximate, "global state", "as it was", "torch.backends.cuda.matmul.fp32_precision is tf32"),
    (Exports, "global state", "as it was", "os.environ differs in LIVELY"),
    (Moves, "global state", "as it was", "os.getcwd() is /"),
    (Paths, "global state", "as it was", "sys.path differs in /nowhere"),
    (Quiet, "global state", "as it was", "warnings.filters differs in"),
    (Writes, "global state", "only in clbench's cache", "losses.txt is written"),
    (Patches, "global state", "as it was", "the class clbench.Policy differs in predict"),
    (Standstill, "learning", "a mean return of -", "before"),
    (Backwards, "learning", "only a reference, `uses = Uses(reference=True)`, may learn nothing", "before"),
]
