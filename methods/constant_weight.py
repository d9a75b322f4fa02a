"""Constant weight: fine-tuning whose loss has ConSFT's mean weight, one for all samples of a step.

The control that tells the weighing of samples from the shrinking of the loss: what remains of ConSFT
(arXiv 2605.08879) when no sample is preferred.

Details:
1. The weights are those of ConSFT, with its constants, for the very losses of the step; each sample gets
   their mean.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Progress

from .consft import ConSFT


@dataclass
class ConstantWeight(ConSFT):
    """Weigh every sample by the mean of ConSFT's weights."""

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the mean weight for every sample (B,)."""
        weights = super().weights(losses, progress)
        return weights.mean().expand_as(weights)
