"""One-sided projection of gradients: A-GEM's rule for one block of parameters."""

from collections.abc import Sequence

import torch
from torch import Tensor


def inner(first: Sequence[Tensor], second: Sequence[Tensor]) -> float:
    """Return the inner product of two blocks of tensors of equal shapes."""
    return float(
        sum(torch.dot(one.flatten(), other.flatten()) for one, other in zip(first, second, strict=True))
    )


@torch.no_grad()
def project_out(gradient: Sequence[Tensor], against: Sequence[Tensor]) -> float:
    """Remove from `gradient`, in place, its part along `against` if their inner product is negative.

    Returns:
        The energy that was removed, ||before||^2 - ||after||^2: 0 if the product is not negative, or if
        `against` is zero and so has no direction.
    """
    product, norm = inner(gradient, against), inner(against, against)
    if product >= 0 or norm == 0:
        return 0.0
    for one, other in zip(gradient, against, strict=True):
        one.sub_(other, alpha=product / norm)
    return product * product / norm
