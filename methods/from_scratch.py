"""From scratch: for each target a new policy that was never pretrained.

A reference row: its learning curves are what forward transfer (Continual World, arXiv 2105.10919) compares
with. The policy keeps the pretrained one's normalisation, so that both read the same numbers.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import nn

from clbench.learning.method import Method, Stage
from clbench.learning.prior import Uses
from clbench.policy.policy import Policy


@dataclass
class FromScratch(Method):
    """Forget everything at the start of each target."""

    uses = Uses(reference=True)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Draw all weights anew and return them."""
        fresh = Policy(policy.config, seed=stage.seed)
        with torch.no_grad():
            for parameter, value in zip(policy.parameters(), fresh.parameters(), strict=True):
                parameter.copy_(value)
        return policy.parameters()
