"""Checks of a method's hyper-parameters, and blank samples of a policy's shapes."""

import math

import torch

from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.spec.language import TEXT_LENGTH


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
    return blank.to(policy.device)


def in_range(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Refuse a hyper-parameter outside its range, ends included.

    Raises:
        ValueError: `value` is outside the range, or not a finite number.
    """
    if not (low <= value <= high and math.isfinite(value)):
        allowed = f"from {low:g}" + (f" to {high:g}" if high < float("inf") else "")
        raise ValueError(f"{name} must be {allowed}, not {value}.")
