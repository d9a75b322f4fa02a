"""FINCH: the learning rate follows the loss (arXiv 2605.20005), an alternative to weighting samples.

A step can raise the loss on earlier tasks by a bounded amount, and this bound grows with the square root of
the current loss. The learning rate is therefore kappa / sqrt(EMA(L) + eps), capped: steps are small while the
loss is high, at the start of a target. The formula comes from another reader's note; we have not read the
paper.

Details:
1. The cap is the benchmark's own schedule instead of the paper's constant 5e-5, so that FINCH takes no larger
   steps than plain fine-tuning. kappa is therefore a factor of that schedule.
2. The default of kappa was chosen on validation episodes of the first Fetch board (docs/history.md). Where
   methods are tuned, `clbench tune` chose it again.
3. The average restarts with the first loss of each target, and eps is 1e-8.
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
    """Steps have the scheduled size while the square root of the average loss is at most this value."""
    momentum: float = 0.9
    """Momentum of the exponential moving average of the loss (the paper's value)."""

    metadata = Metadata(link="https://arxiv.org/abs/2605.20005")
    tunes = ("kappa", (0.1, 1.0))

    def __post_init__(self) -> None:
        in_range("kappa", self.kappa, 1e-9)
        in_range("momentum", self.momentum, 0.0, 1.0)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and clear the average of the losses."""
        self.average: float | None = None
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the action loss, and add it to the average."""
        loss = policy.action_loss(batch).mean()
        now = loss.item()
        before = now if self.average is None else self.average
        self.average = self.momentum * before + (1 - self.momentum) * now
        return loss

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return the scheduled learning rate times kappa / sqrt(average), or times 1 if that is larger."""
        assert self.average is not None
        return scheduled * min(1.0, self.kappa / math.sqrt(self.average + 1e-8))
