"""The method: hooks of a training loop. A method file contains only its differences from fine-tuning."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor, nn

from clbench.base.errors import InputError, WrongTypeError
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.spec.task import Task

MethodState = dict[str, Tensor | str | float | int | bool | None]
"""State of a method: a flat dictionary of tensors and plain values, written as safetensors and JSON."""

_TEXTS = {
    "authors": (r"(?=\S).{1,200}", "printable text of at most 200 characters"),
    "link": (
        r"https?://[A-Za-z0-9][A-Za-z0-9.-]*(:\d{1,5})?(/[A-Za-z0-9._~:/?#@!$&()*+,;=%-]{0,300})?",
        "a web address that begins with http:// or https://",
    ),
    "licence": (r"[A-Za-z0-9][A-Za-z0-9 .()+-]{0,99}", 'an SPDX expression such as "MIT" or "Apache-2.0"'),
    "version": (r"[A-Za-z0-9][A-Za-z0-9.+!_-]{0,49}", 'a version such as "1.0"'),
}
"""Pattern that each text of `Metadata` must match, and its description."""


@dataclass(frozen=True)
class Metadata:
    """Authors and licence of a method; None leaves a field out.

    Raises:
        InputError: A text does not match its pattern. All texts appear on a public page.
    """

    authors: str | None = None
    """Names of the authors."""
    link: str | None = None
    """Web address of the paper or of the code."""
    licence: str | None = None
    """Licence of the code, as an SPDX expression."""
    version: str | None = None
    """Version of the code."""

    def __post_init__(self) -> None:
        for name, (pattern, words) in _TEXTS.items():
            text = getattr(self, name)
            if text is None:
                continue
            if not (isinstance(text, str) and text.isprintable() and re.fullmatch(pattern, text)):
                raise InputError(f"{name} in the metadata must be {words}, not {text!r}.")


@dataclass(frozen=True)
class Stage:
    """One target task of the sequence, with the data for it."""

    number: int
    """Number of the target, from 1."""
    task: Task
    """Task to learn."""
    seed: int
    """Seed for the method's own random draws in this stage."""
    steps: int
    """Maximum number of optimiser steps of the stage, which ends earlier if it meets a criterion."""
    target: Source[Batch]
    """Demonstrations of the task."""
    prior: Prior
    """Data of earlier tasks that the method may use."""


@dataclass(frozen=True)
class Progress:
    """Progress of a stage, or of the pretraining in `watch_pretraining`."""

    step: int
    """Number of optimiser steps done."""
    steps: int
    """Maximum number of optimiser steps of the stage, or number of steps of the pretraining."""
    to_criterion: bool = False
    """Whether the stage ends as soon as the target is learned; False in the pretraining."""


@dataclass(kw_only=True, eq=False)
class Method:
    """A rule for fine-tuning: a dataclass whose fields are its hyper-parameters.

    The constructor only stores values, and `__post_init__` refuses values out of range; the hooks set all
    learned values. Override the hooks that differ from plain fine-tuning, and declare in `uses` the prior
    data that the method needs.
    """

    step_factor: float = 1.0
    """Factor of the scenario's learning rate. Tuning tries 1, 0.3, 0.1 and 0.03 for every method, and then
    two values of the method's own strength; a method without a strength gets two more factors instead."""

    uses: ClassVar[Uses] = Uses()
    """Prior data that the method reads; it decides the division in which the row competes."""
    metadata: ClassVar[Metadata] = Metadata()
    """Authors, link, licence and version, which the page of the board shows."""
    tunes: ClassVar[tuple[str, tuple[Any, Any]] | None] = None
    """Hyper-parameter that sets how strongly the method protects what is known, and two values that tuning
    tries besides the default. None: tuning tries further learning rates instead."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Abilities that the policy must have besides the protocol: "hidden_states", "answers". A policy without
    them is refused by name."""
    whole_stages: ClassVar[bool] = False
    """Whether the policy is ready only at the end of a stage, for example because `end_task` merges it. Such
    a policy is not evaluated within a stage. Where a criterion ends the stage, each check plays the policy
    that `end_task` would leave then."""

    def watch_pretraining(self, policy: Policy, progress: Progress) -> None:
        """Watch the pretraining: called before its first step, as step 0, and after each step.

        If a method overrides this hook, the pretraining is repeated before `prepare`, in every scenario, and
        its steps count as the method's. The loss of the pretraining is the mean action loss on the skills
        (and the background, if there is one) plus, for a policy that answers, the mean answer loss on
        questions; without skills, it is the answer loss alone. `parameter.grad` holds the clipped gradient of
        the step just taken. Change nothing. Another object runs `prepare`: it gets what `state` returns after
        the last step. `uses` must declare prior demonstrations, and need not declare questions.

        Args:
            policy: Policy that is being pretrained.
            progress: Progress of the pretraining.
        """

    def prepare(self, policy: Policy, prior: Prior) -> int | None:
        """Prepare for the sequence, once, before stage 1: anchors, vectors, adapters, frozen copies.

        Args:
            policy: Pretrained policy; changes stay.
            prior: Data of the retained skills that `uses` declares. It closes after this hook.

        Returns:
            The number of optimiser steps that it took, or that a cached result once took; None counts as 0.
        """

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter] | list[dict[str, Any]]:
        """Return the parameters to train on this target, or optimiser groups of them.

        Where a criterion ends the stage, this hook must take no optimiser steps: only the steps of the loop
        are checked against the criterion.

        Args:
            policy: Policy to train.
            stage: The target and its data, open until the end of `end_task`.
        """
        return policy.parameters()

    def batch(self, target: Source[Batch], prior: Prior) -> Any:
        """Return the training data of this step; it is passed to `loss` unchanged.

        Args:
            target: Demonstrations of the target. A step may draw at most `target.batch_size` of them.
            prior: Data of earlier tasks that `uses` declares "throughout".

        Raises:
            MissingDataError: The hook calls `sample` of a source without data.
        """
        return target.sample(target.batch_size)

    def loss(self, policy: Policy, batch: Any, progress: Progress) -> Tensor:
        """Return the loss to minimise, a finite scalar with a gradient, shape ().

        Args:
            policy: Policy to train.
            batch: What `batch` returned.
            progress: Progress of the stage; `progress.step` is 0 in the first step.
        """
        return policy.action_loss(batch).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the trained parameters; they are clipped afterwards, and must be finite.

        Args:
            policy: Policy to train.
            loss: What `loss` returned.
        """
        loss.backward()  # type: ignore[no-untyped-call]

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return the learning rate of an optimiser group; called for each after `loss` and `gradients`.

        Args:
            scheduled: The scenario's learning rate, or the group's own, times `step_factor` and the schedule.
            progress: Progress of the stage.
        """
        return scheduled

    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Merge or consolidate after a target.

        Args:
            policy: Policy after the last step of the stage; changes stay.
            stage: The target and its data, as in `start_task`.
        """

    def state(self) -> MethodState:
        """Return everything that later hooks need; its tensors, strings and numbers count as bytes kept.

        Every stage begins with a new object of the method that receives only this state, whether or not the
        run was interrupted.

        Returns:
            A flat dictionary of tensors, strings, numbers, Booleans and None. `**vars(batch)` stores the
            tensors of a `Batch`, and `Batch(**state)` rebuilds it.
        """
        return {}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Restore what `state` returned, and add to a plain policy what `prepare` added, such as adapters.

        Args:
            policy: Plain policy. It may get its weights, and its device, only afterwards: use neither here.
            state: What `state` returned, with its tensors on the run's device.

        Raises:
            WrongTypeError: The method returns a state, but does not override this hook.
        """
        if state:
            raise WrongTypeError(f"{type(self).__name__} returns a state() but has no load_state().")

    def diagnostics(self) -> dict[str, Any]:
        """Return the method's report on the stage that ends, or on `prepare`, as JSON."""
        return {}
