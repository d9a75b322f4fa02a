"""Constant weight: the loss is scaled by the mean of ConSFT's weights, the same for all samples of a step.

This control separates the effect of weighting samples from the effect of small weights: it keeps the mean of
ConSFT's weights (arXiv 2605.08879), but prefers no sample. Its loss is therefore larger than that of ConSFT,
which gives small weights to large losses. Adam nearly cancels a mean that stays the same. This control
therefore differs from plain fine-tuning mostly where the mean rises: detail 6 of `consft`.

Details:
1. The weights are those of `ConSFTCalibrated`, for the losses of the same step. Each sample gets their mean.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Progress

from ._consft_weights import CalibratedSFT


@dataclass
class ConstantWeight(CalibratedSFT):
    """Weight every sample by the mean of ConSFT's weights."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the mean of ConSFT's weights for every sample (B,)."""
        weights = self.confidence(losses, progress)
        return weights.mean().expand_as(weights)
