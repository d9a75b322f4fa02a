"""Copies of a policy's weights, and a penalty on moving away from them, for several methods."""

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
    """Add the gradient of (strength / 2) sum_i importance_i (weight_i - anchor_i)^2 to the gradients.

    Args:
        policy: Policy in training. Parameters without a gradient do not change.
        anchor: Weights to pull back to, by name.
        strength: Factor of the penalty.
        importance: Importance of each weight, by name; 1 if None.
    """
    for name, parameter in policy.named_parameters():
        if parameter.grad is None:
            continue
        away = parameter - anchor[name]
        if importance is not None:
            away.mul_(importance[name])
        parameter.grad.add_(away, alpha=strength)


def packed(prefix: str, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights with `prefix` before each name, for a method's `state`."""
    return {f"{prefix}.{name}": value for name, value in weights.items()}


def unpacked(prefix: str, state: Mapping[str, object]) -> Weights:
    """Return the weights that `packed` put into `state`."""
    start = f"{prefix}."
    return {
        name.removeprefix(start): value
        for name, value in state.items()
        if name.startswith(start) and isinstance(value, Tensor)
    }
