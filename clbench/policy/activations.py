"""Activations: the distribution of a policy's hidden states, and the distance that it has moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

VARIANCE_OFFSET = 1e-6
"""Added to each variance before its root, whose slope is infinite at 0."""


@dataclass(frozen=True)
class Gaussian:
    """A diagonal Gaussian for each of L layers with W channels."""

    mean: Tensor
    """Means, (L, W)."""
    deviation: Tensor
    """Standard deviations, (L, W)."""

    @classmethod
    def of(cls, hidden: Sequence[Tensor], mask: Tensor) -> Gaussian:
        """Return the mean and the deviation over all tokens that are read, in all samples.

        Args:
            hidden: Hidden states, one (B, P, W) per layer.
            mask: Mask of the tokens that are read, the result of `Backbone.mask`, (B, 1, 1, P).
        """
        weight = (mask[:, 0, 0, :, None] / mask.sum()).to(hidden[0].dtype)
        states = torch.stack(list(hidden))
        mean = (states * weight).sum(dim=(1, 2))
        variance = ((states - mean[:, None, None]).square() * weight).sum(dim=(1, 2))
        return cls(mean, (variance + VARIANCE_OFFSET).sqrt())

    def distance(self, other: Gaussian) -> Tensor:
        """Return the squared 2-Wasserstein distance to `other`, layer by layer, (L,).

        For diagonal Gaussians it equals ||mean - mean'||^2 + ||deviation - deviation'||^2.
        """
        return (self.mean - other.mean).square().sum(dim=1) + (self.deviation - other.deviation).square().sum(
            dim=1
        )
