"""Shuffled weights: ConSFT's weights, assigned to the samples of the batch at random.

A control. It separates the choice of which samples get a small weight from the fact that some do: it keeps
ConSFT's (arXiv 2605.08879) distribution of weights, but a weight no longer depends on its own sample. As with
`constant_weight`, the loss is on average larger than ConSFT's.

Details:
1. The weights are those of `ConSFTCalibrated`, for the losses of the same step, in a random order.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Progress

from ._consft_weights import CalibratedSFT


@dataclass
class ShuffledWeights(CalibratedSFT):
    """Give the samples of a batch each other's weights, in a random order."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return ConSFT's weights (B,) in a random order."""
        weights = self.confidence(losses, progress)
        return weights[torch.randperm(len(weights)).to(weights.device)]
