"""Adaptation: a method fine-tunes the policy on one target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from clbench.base.text import counted
from clbench.learning.method import Method, Progress, Stage
from clbench.learning.optimise import GradientError, MethodError, optimise, steps_counted, warm_up
from clbench.learning.prior import begin_step, end_steps
from clbench.policy.policy import Policy
from clbench.spec.budget import Budget


@dataclass(frozen=True)
class Step:
    """One optimiser step of a stage."""

    done: int
    """Number of steps done in the stage, this one included."""
    loss: Tensor | None
    """Loss of the step, a scalar; None before the first step, and if the method trains nothing."""
    learning_rate: float | None
    """Learning rate of the last optimiser group; None where there is no loss."""


def adapt(
    policy: Policy,
    method: Method,
    stage: Stage,
    budget: Budget,
    after: Callable[[Step], bool | None] = lambda _: None,
) -> int:
    """Let `method` fine-tune the policy on one target, in place, and return the number of optimiser steps.

    Without a criterion every stage has the same number of steps, and the learning rate falls along a cosine.
    With a criterion the stage ends when `after` returns True, and the learning rate is constant after its
    warm-up. `after` is then also called before the first step: a policy that already knows the target takes
    no step.

    Args:
        policy: Policy to train.
        method: Method that trains it.
        stage: Stage of the target, with the data that the method may use.
        budget: Budget that gives the learning rate and the criterion.
        after: Called after each step; the stage ends if it returns True.

    Raises:
        GradientError: A gradient is not finite; the message names its parameter.
        MethodError: Optimisation fails, or leaves a parameter that is not finite. Or `start_task` takes
            optimiser steps of its own although a criterion ends the stage.
    """
    with steps_counted() as taken:
        chosen = method.start_task(policy, stage)
        parameters: list[Any] | None = None if chosen is None else list(chosen)  # runs a generator
    if budget.criterion is not None and taken():
        raise MethodError(
            f"start_task() took {counted(taken(), 'optimiser step')}. With a criterion it must take none: "
            "only the steps that follow it count, and their checks end the stage."
        )
    if parameters is None:
        raise MethodError(
            "start_task() must return the parameters to train, not None: `return policy.parameters()` "
            "trains all of them."
        )
    to_criterion = budget.criterion is not None
    loss: Tensor | None = None
    learning_rate: float | None = None

    def progress(step: int) -> Progress:
        return Progress(step, stage.steps, to_criterion)

    def loss_at(step: int) -> Tensor:
        nonlocal loss
        begin_step(stage.target)
        batch = method.batch(stage.target, stage.prior)
        loss = method.loss(policy, batch, progress(step))
        return loss

    def gradients(loss: Tensor) -> None:
        policy.zero_grad()  # also of parameters that are not trained: they would add up over the stage
        method.gradients(policy, loss)

    def rate(scheduled: float, step: int) -> float:
        nonlocal learning_rate
        learning_rate = method.learning_rate(method.step_factor * scheduled, progress(step))
        return learning_rate

    learned = to_criterion and after(Step(0, None, None))
    try:
        steps = optimise(
            parameters,
            budget.learning_rate,
            0 if learned or (to_criterion and not parameters) else stage.steps,
            loss_at,
            gradients,
            lambda done: after(Step(done, loss, learning_rate)),
            rate,
            warm_up if to_criterion else None,
        )
    except GradientError as error:
        raise GradientError(f"{str(error).rstrip('.')}: {_not_finite(policy)}.") from error
    end_steps(stage.target)
    method.end_task(policy, stage)
    check_finite(policy, repr(stage.task.name))
    return steps


def check_finite(policy: Policy, after: str) -> None:
    """Refuse a policy that no checkpoint can hold.

    Args:
        policy: The policy.
        after: What the method has just done, for the message.

    Raises:
        MethodError: A parameter or a persistent buffer is not finite.
    """
    parameters = dict(policy.named_parameters(remove_duplicate=False))
    for name, value in policy.state_dict().items():  # without buffers that are made again, such as masks
        if isinstance(value, Tensor) and not torch.isfinite(value).all():
            kind = "parameter" if name in parameters else "buffer"
            raise MethodError(f"The {kind} {name} is not finite after {after}.")


def _not_finite(policy: Policy) -> str:
    """Return the first parameter whose gradient is not finite, and the number of others, for a message."""
    names = [
        name
        for name, parameter in policy.named_parameters()
        if parameter.grad is not None and not torch.isfinite(parameter.grad).all()
    ]
    if not names:  # finite numbers whose squares overflow
        return "its norm overflows"
    return f"that of {names[0]}" + (f", and {len(names) - 1} more" if names[1:] else "")
