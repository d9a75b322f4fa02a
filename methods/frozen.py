"""Frozen: the pretrained policy, without training. This reference row learns nothing and forgets nothing."""

from collections.abc import Iterable
from dataclasses import dataclass

from torch import nn

from clbench.learning.method import Method, Stage
from clbench.learning.prior import Uses
from clbench.policy.policy import Policy


@dataclass
class Frozen(Method):
    """Train no parameter."""

    uses = Uses(reference=True)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return no parameters."""
        return ()
