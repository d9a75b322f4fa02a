"""A-GEM: a step may not raise the loss on prior demonstrations, to first order (arXiv 1812.00420).

If the gradient g on the target and the gradient r on a batch of prior demonstrations have a negative inner
product, g - (g.r / ||r||^2) r is taken (Eq. 11). AEGIS does the same layer by layer, against activations.

Details:
1. The memory is all prior demonstrations, as for experience replay; the batch drawn from it has the budget's
   size.
2. One projection for all weights together.
3. Where nothing was learned before, the gradient is the target's as it is.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Metadata, Method, Progress
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._projection import project_out


@dataclass
class AGEM(Method):
    """Project the gradient off what raises the loss on prior demonstrations."""

    uses = Uses(demonstrations="throughout")
    metadata = Metadata(link="https://arxiv.org/abs/1812.00420")

    def batch(self, target: Source[Batch], prior: Prior) -> tuple[Batch, Batch | None]:
        """Return a batch of the target and one of prior demonstrations, None if there are none."""
        batch = target.sample(target.batch_size)
        return batch, prior.demonstrations.sample(len(batch)) if len(prior.demonstrations) else None

    def loss(self, policy: Policy, batch: tuple[Batch, Batch | None], progress: Progress) -> Tensor:
        """Return the action loss on the target; the prior batch is for `gradients`."""
        demonstrations, self.remembered = batch
        return policy.action_loss(demonstrations).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the target's gradients, projected."""
        loss.backward()  # type: ignore[no-untyped-call]
        if self.remembered is None:
            return
        trained = [weight for weight in policy.parameters() if weight.grad is not None]
        reference = torch.autograd.grad(policy.action_loss(self.remembered).mean(), trained)
        project_out([weight.grad for weight in trained if weight.grad is not None], reference)
