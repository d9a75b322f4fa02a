"""L2-SP: a penalty pulls the weights back to their starting point (arXiv 1802.01483).

Details:
1. The penalty (strength / 2) ||theta - theta*||^2 applies to all weights, because no layer is new here. Its
   gradient is added in closed form.
2. theta* is the pretrained policy during the whole sequence.
3. The gradients of the penalty and of the loss are clipped together, to a norm of 1, and go through Adam. A
   strong penalty therefore slows down learning of the target, and `strength` does not mean what it does with
   plain gradient steps.
4. The default of `strength` was chosen on validation episodes of the first Fetch board (docs/history.md).
   Where methods are tuned, `clbench tune` chose it again.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Metadata, Method, MethodState
from clbench.learning.prior import Prior
from clbench.policy.policy import Policy

from ._requirements import in_range
from ._weights import copy_of, packed, pull_back, unpacked


@dataclass
class L2SP(Method):
    """Penalise the distance to the pretrained weights."""

    strength: float = 0.3
    """Factor of the penalty."""

    metadata = Metadata(link="https://arxiv.org/abs/1802.01483")
    tunes = ("strength", (0.1, 1.0))

    def __post_init__(self) -> None:
        in_range("strength", self.strength, 0.0)

    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Keep the pretrained weights."""
        self.anchor = copy_of(policy)

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the loss and the penalty."""
        loss.backward()  # type: ignore[no-untyped-call]
        pull_back(policy, self.anchor, self.strength)

    def state(self) -> MethodState:
        """Return the pretrained weights."""
        return {**packed("anchor", self.anchor)}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Restore the pretrained weights."""
        self.anchor = unpacked("anchor", state)
