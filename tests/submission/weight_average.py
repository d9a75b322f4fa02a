"""Weight average: the policy of a stage is the moving average of its weights (Polyak and Juditsky 1992).

Details:
1. The average begins with the weights at the start of each target.
2. The policy is the average at the end of a target only, and is evaluated there.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from clbench import Batch, Metadata, Method, Policy, Progress, Stage


@dataclass
class WeightAverage(Method):
    """Fine-tune, and keep the moving average of the weights."""

    decay: float = 0.9
    """Share of the average that a step leaves as it is."""

    whole_stages = True
    metadata = Metadata(
        authors="A. Stranger",
        link="https://example.org/averaging",
        licence="MIT",
        version="0.1.0",
    )

    def __post_init__(self) -> None:
        if not 0 <= self.decay < 1:
            raise ValueError(f"decay must be from 0 and below 1, not {self.decay}.")

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and begin the average."""
        self.average = [parameter.detach().clone() for parameter in policy.parameters()]
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the action loss; the weights after the last step enter the average."""
        self._enter(policy)
        return super().loss(policy, batch, progress)

    @torch.no_grad()
    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Put the average in the place of the weights."""
        self._enter(policy)
        for parameter, average in zip(policy.parameters(), self.average, strict=True):
            parameter.copy_(average)

    @torch.no_grad()
    def _enter(self, policy: Policy) -> None:
        for parameter, average in zip(policy.parameters(), self.average, strict=True):
            average.lerp_(parameter, 1 - self.decay)
