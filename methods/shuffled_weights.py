"""Shuffled weights: ConSFT's weights, assigned to the samples of the batch at random.

This control keeps ConSFT's (arXiv 2605.08879) distribution of weights, but a weight no longer depends on its
own sample. It shows whether it matters which samples get a small weight, or only that some do. As with
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
    """Weight the samples of a batch by ConSFT's weights, in a random order."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return ConSFT's weights (B,) in a random order."""
        weights = self.confidence(losses, progress)
        return weights[torch.randperm(len(weights)).to(weights.device)]
