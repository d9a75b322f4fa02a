"""A-GEM: no gradient raises, to first order, the loss on prior demonstrations (arXiv 1812.00420).

Let g be the gradient on the target and r the gradient on a batch of prior demonstrations. If their inner
product is negative, the step uses g - (g.r / ||r||^2) r instead of g (Eq. 11). AEGIS, in contrast, projects
layer by layer, against the gradient of a distance between hidden states.

Details:
1. The memory holds all prior demonstrations, as in experience replay. A batch from the memory has the
   budget's size and is drawn in addition to the target's batch, so a step reads twice as many samples as a
   step of experience replay.
2. There is one projection for all weights together.
3. If there is no earlier task, the gradient on the target is not changed.
4. The projected gradient is clipped and goes through Adam, whose step may still raise the prior loss; the
   paper takes plain gradient steps.
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
    """Project out the part of the gradient that raises the loss on prior demonstrations."""

    uses = Uses(demonstrations="throughout")
    metadata = Metadata(link="https://arxiv.org/abs/1812.00420")

    def batch(self, target: Source[Batch], prior: Prior) -> tuple[Batch, Batch | None]:
        """Return a batch of the target and a batch of prior demonstrations, None if there are none."""
        batch = target.sample(target.batch_size)
        return batch, prior.demonstrations.sample(len(batch)) if len(prior.demonstrations) else None

    def loss(self, policy: Policy, batch: tuple[Batch, Batch | None], progress: Progress) -> Tensor:
        """Return the action loss on the target, and keep the prior batch for `gradients`."""
        demonstrations, self.remembered = batch
        return policy.action_loss(demonstrations).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the loss on the target, projected against the prior demonstrations."""
        loss.backward()  # type: ignore[no-untyped-call]
        if self.remembered is None:
            return
        trained = [weight for weight in policy.parameters() if weight.grad is not None]
        reference = torch.autograd.grad(policy.action_loss(self.remembered).mean(), trained)
        project_out([weight.grad for weight in trained if weight.grad is not None], reference)
