"""Adaptation: a method fine-tunes the policy on one target."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from clbench.method import Method, Progress, Stage
from clbench.policy import Policy
from clbench.task import Budget
from clbench.training import MethodError, optimise


def adapt(
    policy: Policy,
    method: Method,
    stage: Stage,
    budget: Budget,
    after: Callable[[int], None] = lambda _: None,
) -> int:
    """Let `method` fine-tune the policy on one target, in place, and return the optimiser steps done.

    Args:
        policy: What is trained.
        method: How.
        stage: Which target, with the data that the method may touch.
        budget: Step size.
        after: Called after each step with the number of steps done.
    """
    parameters = method.start_task(policy, stage)

    def loss_at(step: int) -> Tensor:
        batch = method.batch(stage.target, stage.prior)
        return method.loss(policy, batch, Progress(step, stage.steps))

    steps = optimise(
        parameters,
        budget.learning_rate,
        stage.steps,
        loss_at,
        lambda loss: method.gradients(policy, loss),
        after,
        lambda scheduled, step: method.learning_rate(scheduled, Progress(step, stage.steps)),
    )
    method.end_task(policy, stage)
    for name, parameter in policy.named_parameters():
        if not torch.isfinite(parameter).all():
            raise MethodError(f"The parameter {name} is not finite after {stage.task.name!r}.")
    return steps
