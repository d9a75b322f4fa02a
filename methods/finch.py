"""FINCH: the step size follows the loss (arXiv 2605.20005), the rival of weighing samples.

From a bound on how much a step can raise the loss of what was learned before, which grows with the root of
the present loss: the step size is kappa / sqrt(EMA(L) + eps), capped. Where the loss is high, at the start of
a new target, steps are small.

Details:
1. The cap is the benchmark's own schedule, in the place of the paper's constant 5e-5, so that no method takes
   larger steps than plain fine-tuning; kappa is therefore a factor of that schedule.
2. kappa was chosen on validation episodes of seed 100. The average begins with each target's first loss.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from torch import Tensor, nn

from clbench.learning.method import Metadata, Method, Progress, Stage
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._requirements import in_range


@dataclass
class Finch(Method):
    """Take smaller steps while the loss is high."""

    kappa: float = 0.3
    """Root of the average loss from which on the steps are as large as scheduled."""
    momentum: float = 0.9
    """Of the exponential moving average of the loss (the paper's value)."""

    metadata = Metadata(link="https://arxiv.org/abs/2605.20005")

    def __post_init__(self) -> None:
        in_range("kappa", self.kappa, 1e-9)
        in_range("momentum", self.momentum, 0.0, 1.0)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and forget the last target's losses."""
        self.average: float | None = None
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the action loss, and average it."""
        loss = policy.action_loss(batch).mean()
        now = loss.item()
        before = now if self.average is None else self.average
        self.average = self.momentum * before + (1 - self.momentum) * now
        return loss

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return kappa / sqrt(average) of the scheduled step size, at most all of it."""
        assert self.average is not None
        return scheduled * min(1.0, self.kappa / math.sqrt(self.average + 1e-8))
