"""The method: hooks around a loop that is ours. A method file holds only what differs from fine-tuning."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from clbench.base.errors import InputError, WrongTypeError
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.spec.task import Task

MethodState = dict[str, Tensor | str | float | int | bool | None]


_TEXTS = {
    "authors": (r"(?=\S).{1,200}", "printable text of at most 200 characters"),
    "link": (
        r"https?://[A-Za-z0-9][A-Za-z0-9.-]*(:\d{1,5})?(/[A-Za-z0-9._~:/?#@!$&()*+,;=%-]{0,300})?",
        "a web address that begins with http:// or https://",
    ),
    "licence": (r"[A-Za-z0-9][A-Za-z0-9 .()+-]{0,99}", 'an SPDX expression, as "MIT" or "Apache-2.0"'),
    "version": (r"[A-Za-z0-9][A-Za-z0-9.+!_-]{0,49}", 'a version, as "1.0"'),
}
"""What the texts of `Metadata` must match, and the same in words."""


@dataclass(frozen=True)
class Metadata:
    """Who made a method, and on what terms; None is not said.

    Raises:
        ValueError: A text is not of its kind: all of them are shown on a page that strangers read.
    """

    authors: str | None = None
    """Names of who made it."""
    link: str | None = None
    """Of the paper, or of the code."""
    licence: str | None = None
    """Of the code, as an SPDX expression."""
    version: str | None = None
    """Of the code."""

    def __post_init__(self) -> None:
        for name, (pattern, words) in _TEXTS.items():
            text = getattr(self, name)
            if text is None:
                continue
            if not (isinstance(text, str) and text.isprintable() and re.fullmatch(pattern, text)):
                raise InputError(f"{name} in the metadata must be {words}, not {text!r}.")


@dataclass(frozen=True)
class Stage:
    """One target task of the sequence, as a method meets it."""

    number: int
    """1 for the first target."""
    task: Task
    """What is learned."""
    seed: int
    """For the method's own random draws in this stage."""
    steps: int
    """Optimiser steps of the budget."""
    target: Source[Batch]
    """The task's demonstrations."""
    prior: Prior
    """What may be touched of what was learned before."""


@dataclass(frozen=True)
class Progress:
    """How far the adaptation to a target has come."""

    step: int
    """Optimiser steps done in this stage."""
    steps: int
    """Optimiser steps of the whole stage."""


class Method:
    """A rule for fine-tuning: a dataclass whose fields are its hyper-parameters.

    The constructor only stores, and `__post_init__` refuses what is out of range; what a method learns is set
    by the hooks. Override what differs from plain fine-tuning, and declare in `uses` the prior data it needs.
    """

    uses: Uses = Uses()
    metadata: Metadata = Metadata()
    whole_stages: bool = False
    """Whether the policy is what the method means it to be at the end of a stage only, as one that `end_task`
    merges: it is then not evaluated on the way."""

    def prepare(self, policy: Policy, prior: Prior) -> int | None:
        """Prepare for the sequence, once, before stage 1: anchors, vectors, adapters, frozen copies.

        Returns:
            The optimiser steps that it took, or that what it found in a cache once took; none if None.
        """

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter] | list[dict[str, Any]]:
        """Return the parameters to train on this target, or optimiser groups of them."""
        return policy.parameters()

    def batch(self, target: Source[Batch], prior: Prior) -> Any:
        """Return what to train on at this step; it goes to `loss` as it is."""
        return target.sample(target.batch_size)

    def loss(self, policy: Policy, batch: Any, progress: Progress) -> Tensor:
        """Return the scalar to descend."""
        return policy.action_loss(batch).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the trained parameters."""
        loss.backward()  # type: ignore[no-untyped-call]

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return the step size of this step, asked for after `loss` and `gradients`, for each group."""
        return scheduled

    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Merge or consolidate after a target."""

    def state(self) -> MethodState:
        """Return all that later hooks need, tensors and plain values by name; its bytes count as kept.

        Every stage begins with a new object of the method that has this state and nothing else, whether the
        run was interrupted or not.
        """
        return {}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Take back what `state` returned, and add to a plain policy what `prepare` added, as adapters."""
        if state:
            raise WrongTypeError(f"{type(self).__name__} returns a state() but has no load_state().")

    def diagnostics(self) -> dict[str, Any]:
        """Return what the method tells about the stage that ends, or about `prepare`, as JSON."""
        return {}
