"""Training: the only place that steps an optimiser."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from clbench.base.errors import ClbenchError

GRADIENT_NORM = 1.0
"""Gradients are clipped at this norm, after the method has set them."""

BETAS = (0.9, 0.95)
"""Of AdamW, as the three seed papers and openpi have them; weight decay 1e-10 likewise."""


class MethodError(ClbenchError, RuntimeError):
    """A method did something that the loop cannot go on with."""


def learning_rate_factor(step: int, steps: int) -> float:
    """Return the share of the peak step size at `step`: 5 % linear warm-up, then a cosine down to a tenth."""
    warm_up = max(1, round(0.05 * steps))
    if step < warm_up:
        return (step + 1) / warm_up
    fraction = (step - warm_up) / max(1, steps - warm_up)
    return 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * fraction))


@contextmanager
def deterministic() -> Iterator[None]:
    """One thread and deterministic kernels, so that a computation repeats itself bit for bit."""
    threads, algorithms = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(algorithms)


def optimise(
    parameters: Iterable[nn.Parameter] | list[dict[str, Any]],
    learning_rate: float,
    steps: int,
    loss_at: Callable[[int], Tensor],
    gradients: Callable[[Tensor], None] = Tensor.backward,
    after: Callable[[int], None] = lambda _: None,
    rate: Callable[[float, int], float] = lambda scheduled, _: scheduled,
) -> int:
    """Descend a loss with AdamW and return the number of steps done; without parameters none is.

    Args:
        parameters: What is trained, or optimiser groups of it.
        learning_rate: Peak step size, for groups that have none of their own.
        steps: How often.
        loss_at: Returns the scalar loss of a step.
        gradients: Sets the gradients from the loss.
        after: Called after each step with the number of steps done.
        rate: Maps the scheduled step size of a group, and the steps done, to the one that is taken.

    Raises:
        MethodError: The loss is not a finite scalar with a gradient, or a step size is no positive number.
    """
    groups: list[Any] = list(parameters)
    if not groups:
        for step in range(steps):
            after(step + 1)
        return 0
    optimiser = torch.optim.AdamW(groups, lr=learning_rate, betas=BETAS, weight_decay=1e-10, fused=True)
    peaks = [group["lr"] for group in optimiser.param_groups]
    trained = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for step in range(steps):
        loss = loss_at(step)
        _check_loss(loss, step)
        optimiser.zero_grad()
        gradients(loss)
        _clip(trained, step)
        for group, peak in zip(optimiser.param_groups, peaks, strict=True):
            group["lr"] = _checked_rate(rate(peak * learning_rate_factor(step, steps), step), step)
        optimiser.step()
        after(step + 1)
    return steps


def _checked_rate(rate: float, step: int) -> float:
    if not (isinstance(rate, float) and 0.0 <= rate < math.inf):
        raise MethodError(f"step {step}: the step size must be a number from 0, not {rate!r}.")
    return rate


def _clip(trained: list[nn.Parameter], step: int) -> None:
    try:
        nn.utils.clip_grad_norm_(trained, GRADIENT_NORM, error_if_nonfinite=True)
    except RuntimeError as error:
        raise MethodError(f"step {step}: a gradient is not finite.") from error


def _check_loss(loss: Any, step: int) -> None:
    if not isinstance(loss, Tensor):
        raise MethodError(f"step {step}: loss must be a tensor, not {type(loss).__name__}.")
    if loss.shape != ():
        raise MethodError(
            f"step {step}: loss must be a scalar, shape (), not {tuple(loss.shape)}; take its mean."
        )
    if not torch.isfinite(loss):
        raise MethodError(f"step {step}: loss is {loss.item()}, not finite.")
    if not loss.requires_grad:
        raise MethodError(f"step {step}: loss has no gradient; was it detached?")
