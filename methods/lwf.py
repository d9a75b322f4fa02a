"""LwF: on the target's data, the policy must keep its earlier predictions (arXiv 1606.09282).

Details:
1. For a flow-matching head, the distillation loss is the squared difference between the velocities that the
   policy and its frozen copy predict at the same flow time and noise. The ConSFT paper (arXiv 2605.08879,
   Table 3) defines its baseline this way. The loss is computed on the target's data: no prior data are used.
2. LwF gives each task a head of its own, and distils the heads of earlier tasks. Here one head follows all
   instructions, and what it predicted for the target's instruction contradicts the demonstrations: the
   distillation opposes learning by construction.
3. The copy is made at the start of each target, as in LwF's own sequences. In the ConSFT paper it is the
   pretrained model, which is the same thing for the first target.
4. A head that fills in masked tokens distils its expected actions, not their distribution.
5. The distillation takes two more forward passes, one of the policy and one of its frozen copy. Both count
   towards the time of a step.
6. `strength` was chosen on validation episodes of the first Fetch board (docs/history.md).
"""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from clbench.learning.method import Metadata, Method, Progress, Stage
from clbench.policy.batch import Batch, mean_over_valid
from clbench.policy.policy import Policy

from ._requirements import in_range


@dataclass
class LwF(Method):
    """Distil the policy's own earlier velocities, on the target's data."""

    strength: float = 0.1
    """Factor of the distillation loss."""

    metadata = Metadata(link="https://arxiv.org/abs/1606.09282")
    tunes = ("strength", (0.01, 1.0))

    def __post_init__(self) -> None:
        in_range("strength", self.strength, 0.0)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and keep a frozen copy of the policy."""
        self.teacher = deepcopy(policy).eval().requires_grad_(False)
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the sum of the action loss and the weighted distillation loss."""
        with torch.no_grad():
            taught = self.teacher.predict(batch)
        difference = mean_over_valid((policy.predict(batch) - taught).square(), batch.valid)
        return policy.action_loss(batch).mean() + self.strength * difference.mean()
