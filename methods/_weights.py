"""Copies of a policy's weights, and the pull back to them that several methods share."""

from collections.abc import Mapping

import torch
from torch import Tensor

from clbench.policy.policy import Policy

Weights = dict[str, Tensor]


def copy_of(policy: Policy) -> Weights:
    """Return a copy of all parameters by name."""
    return {name: parameter.detach().clone() for name, parameter in policy.named_parameters()}


@torch.no_grad()
def pull_back(
    policy: Policy,
    anchor: Mapping[str, Tensor],
    strength: float,
    importance: Mapping[str, Tensor] | None = None,
) -> None:
    """Add to the gradients that of (strength / 2) sum_i importance_i (weight_i - anchor_i)^2.

    Args:
        policy: What is trained; parameters without a gradient are left alone.
        anchor: Where the weights are pulled to, by name.
        strength: Factor of the penalty.
        importance: Of each weight, by name; 1 if None.
    """
    for name, parameter in policy.named_parameters():
        if parameter.grad is None:
            continue
        away = parameter - anchor[name]
        if importance is not None:
            away.mul_(importance[name])
        parameter.grad.add_(away, alpha=strength)


def packed(prefix: str, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights under names that begin with `prefix`, for a method's `state`."""
    return {f"{prefix}.{name}": value for name, value in weights.items()}


def unpacked(prefix: str, state: Mapping[str, object]) -> Weights:
    """Return what `packed` put into `state`."""
    start = f"{prefix}."
    return {
        name.removeprefix(start): value
        for name, value in state.items()
        if name.startswith(start) and isinstance(value, Tensor)
    }
