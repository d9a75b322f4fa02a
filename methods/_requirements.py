"""Checks of a method's hyper-parameters and of its policy, made before any training."""

import math

import torch

from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.spec.language import TEXT_LENGTH


def require_hidden_states(policy: Policy, method: str) -> None:
    """Refuse a policy that does not return its hidden states.

    Raises:
        TypeError: The policy has no `hidden_states`.
    """
    if not hasattr(policy, "hidden_states"):
        raise TypeError(
            f"{method} needs the hidden states of every backbone layer; {type(policy).__name__} has no "
            "hidden_states(state, words, image) that returns them."
        )


def require_loss_per_sample(policy: Policy, method: str) -> None:
    """Refuse a policy whose action loss is not one number per sample; two blank samples are tried.

    Raises:
        TypeError: `action_loss` of two samples does not have the shape (2,).
    """
    with torch.no_grad():
        shape = tuple(policy.action_loss(blank_batch(policy, 2)).shape)
    if shape != (2,):
        raise TypeError(
            f"{method} looks at samples one by one: action_loss of {type(policy).__name__} must return one "
            f"loss per sample, shape (2,) for two; its shape is {shape}."
        )


def blank_batch(policy: Policy, count: int) -> Batch:
    """Return `count` empty samples of the shapes that a policy reads."""
    config = policy.config
    chunks = (count, config.chunk, config.action_size)
    blank = Batch(
        state=torch.zeros(count, config.state_size),
        words=torch.ones(count, TEXT_LENGTH, dtype=torch.int64),
        action=torch.zeros(chunks),
        valid=torch.ones(chunks[:2]),
        draw=torch.full((count,), 0.5),
        noise=torch.zeros(chunks),
        image=torch.zeros(count, config.image_size, config.image_size, 3, dtype=torch.uint8),
    )
    return blank.to(policy.state_mean.device)


def in_range(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Refuse a hyper-parameter outside its range, ends included.

    Raises:
        ValueError: `value` is outside the range, or not a finite number.
    """
    if not (low <= value <= high and math.isfinite(value)):
        allowed = f"from {low:g}" + (f" to {high:g}" if high < float("inf") else "")
        raise ValueError(f"{name} must be {allowed}, not {value}.")
