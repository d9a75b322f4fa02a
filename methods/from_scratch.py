"""From scratch: a new policy without pretraining for each target.

This is a reference row: forward transfer (Continual World, arXiv 2105.10919) compares the learning curves of
a method with those of this row. The policy keeps the normalisation of the pretrained policy, so that both
read the same numbers. It is not tuned: the committed rows use the scenario's learning rate. This rate is a
fifth of the rate of pretraining, except on MetaWorldCW-v0, where it is a third larger. Where it is a fifth,
larger steps would learn faster. The speed of other methods is relative to this row, so it looks better there
than it is.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import nn

from clbench.base.errors import InputError
from clbench.learning.method import Method, Stage
from clbench.learning.prior import Uses
from clbench.policy.kinds import new_policy
from clbench.policy.policy import Policy


@dataclass
class FromScratch(Method):
    """Start every target from random weights."""

    uses = Uses(reference=True)
    tunes = ("step_factor", (2.2, 5.0))  # new weights need larger steps; pretraining's are 5 times as large

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, set to new random weights.

        Raises:
            InputError: A new policy of this class has pretrained weights of its own.
        """
        if policy.pretrained:
            name = type(policy).__name__
            raise InputError(f"from_scratch needs untrained weights, and a new {name} has pretrained ones.")
        fresh = new_policy(policy.config, seed=stage.seed)
        with torch.no_grad():
            for parameter, value in zip(policy.parameters(), fresh.parameters(), strict=True):
                parameter.copy_(value)
        return policy.parameters()
