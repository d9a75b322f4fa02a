"""Shuffled weights: ConSFT's weights, dealt out to the samples of the batch at random.

The control that tells which samples weigh little from that some do: what remains of ConSFT (arXiv 2605.08879)
when a weight says nothing of its own sample.

Details:
1. The weights are those of ConSFT, with its constants, for the losses of the step, in a random order.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Progress

from .consft import ConSFT


@dataclass
class ShuffledWeights(ConSFT):
    """Give each sample the weight of another one."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return ConSFT's weights (B,) in a random order."""
        weights = super().weights(losses, progress)
        return weights[torch.randperm(len(weights)).to(weights.device)]
