"""Operations on blocks of tensors: A-GEM's one-sided projection, and random directions for controls."""

from collections.abc import Sequence

import torch
from torch import Tensor


def inner(first: Sequence[Tensor], second: Sequence[Tensor]) -> float:
    """Return the inner product of two blocks of tensors with equal shapes."""
    return float(
        sum(torch.dot(one.flatten(), other.flatten()) for one, other in zip(first, second, strict=True))
    )


@torch.no_grad()
def project_out(gradient: Sequence[Tensor], against: Sequence[Tensor]) -> float:
    """Remove from `gradient`, in place, the part along `against` if their inner product is negative.

    Returns:
        The removed energy, ||before||^2 - ||after||^2. It is 0 if the product is not negative, or if
        `against` is zero and so has no direction.
    """
    product, norm = inner(gradient, against), inner(against, against)
    if product >= 0 or norm == 0:
        return 0.0
    for one, other in zip(gradient, against, strict=True):
        one.sub_(other, alpha=product / norm)
    return product * product / norm


def random_like(block: Sequence[Tensor]) -> list[Tensor]:
    """Return a random direction with the norm of the block."""
    drawn = [torch.randn_like(one) for one in block]
    scale = (inner(block, block) / inner(drawn, drawn)) ** 0.5
    return [one * scale for one in drawn]
