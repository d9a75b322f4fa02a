"""Weight interpolation: after each target, the weights move part of the way back.

WiSE-FT (arXiv 2109.01903) does this for fine-tuned models, and RETAIN (arXiv 2512.08333) for
vision-language-action models:
theta = (1 - coefficient) theta_before + coefficient theta_after.

Details:
1. theta_before is the policy at the start of the target, so that the merge protects earlier targets as well
   as skills.
2. All weights share one coefficient. It was chosen on validation episodes of the first Fetch board
   (docs/history.md).
3. The method's policy exists only after the merge, so it is evaluated only there, and has no learning curve.
   Where a criterion ends the stage, each check plays the merged policy, and training continues with the
   weights before the merge.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import nn

from clbench.learning.method import Metadata, Method, Stage
from clbench.policy.policy import Policy

from ._requirements import in_range
from ._weights import copy_of


@dataclass
class WeightInterpolation(Method):
    """Fine-tune, then average with the weights from the start of the target."""

    coefficient: float = 0.5
    """Share of the fine-tuned weights."""

    whole_stages = True
    metadata = Metadata(link="https://arxiv.org/abs/2109.01903")
    tunes = ("coefficient", (0.7, 0.9))

    def __post_init__(self) -> None:
        in_range("coefficient", self.coefficient, 0.0, 1.0)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and keep a copy of them."""
        self.before = copy_of(policy)
        return policy.parameters()

    @torch.no_grad()
    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Average the weights."""
        for name, parameter in policy.named_parameters():
            parameter.lerp_(self.before[name], 1.0 - self.coefficient)
