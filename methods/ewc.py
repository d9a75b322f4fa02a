"""EWC: the weights that earlier tasks depend on are pulled back more strongly (arXiv 1612.00796).

Details:
1. The importance of a weight is its diagonal Fisher information: the mean over samples of the squared
   gradient of the sample's loss. The flow-matching loss replaces the negative log-likelihood, to which it is
   related, at the demonstrated actions ("empirical Fisher"). Each gradient is taken at one draw of flow time
   and noise, so the importance also contains the variance between draws.
2. The importance is computed for the retained skills before the first target, from prior demonstrations, and
   for each target after training on it. The sum of these importances pulls the weights towards their values
   after the most recent target ("online" EWC, arXiv 1805.06370, with one anchor). All skills together have
   one importance, the mean over a mixture of their samples, and each target has one of its own: with three
   skills, a skill counts a third as much as a target. The paper adds one importance for each task. An
   importance is a mean over 256 samples and noisy: six estimates for the same policy have a mean correlation
   of 0.70, and the five largest samples carry 38 to 55 % of the sum. Online EWC also multiplies the earlier
   sum by gamma, and normalises the importance of each task; here gamma is 1, and nothing is normalised.
3. The penalty is (strength / 2) sum_i F_i (theta_i - theta*_i)^2. Its gradient is added in closed form.
4. If nothing is retained, no weight is important during the first target.
5. The gradients of the penalty and of the loss are clipped together, to a norm of 1, and go through Adam. A
   strong penalty therefore slows down learning of the target, and `strength` does not mean what it does with
   plain gradient steps.
6. The default of `strength` was chosen on validation episodes of the first Fetch board (docs/history.md).
   Where methods are tuned, `clbench tune` chose it again. Published values are not comparable: the loss is a
   mean over the numbers of a chunk, 32 on Fetch-v1, so the importance is about 1,000 times smaller than with
   a sum.
7. The passes that compute the importance, 256 before the first target and 256 after each target, are not
   optimiser steps, so no cost on the board counts them.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Metadata, Method, MethodState, Stage
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._requirements import in_range
from ._weights import Weights, copy_of, packed, pull_back, unpacked


@dataclass
class EWC(Method):
    """Penalise moving the weights that earlier skills depend on."""

    strength: float = 10000.0
    """Factor of the penalty."""
    samples: int = 256
    """Number of samples for the Fisher information."""

    uses = Uses(demonstrations="prepare")
    metadata = Metadata(link="https://arxiv.org/abs/1612.00796")
    tunes = ("strength", (1e3, 1e5))

    def __post_init__(self) -> None:
        in_range("strength", self.strength, 0.0)
        in_range("samples", self.samples, 1)

    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Compute the importance of the weights for the retained skills."""
        self.anchor = copy_of(policy)
        known = self.samples if len(prior.demonstrations) else 0
        self.importance = fisher_information(policy, prior.demonstrations, known)

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the loss and the penalty."""
        loss.backward()  # type: ignore[no-untyped-call]
        pull_back(policy, self.anchor, self.strength, self.importance)

    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Add the importance for the target, and move the anchor to the present weights."""
        self.anchor = copy_of(policy)
        for name, value in fisher_information(policy, stage.target, self.samples).items():
            self.importance[name] += value

    def state(self) -> MethodState:
        """Return the anchor and the importance of the weights."""
        return {**packed("anchor", self.anchor), **packed("importance", self.importance)}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Restore the anchor and the importance."""
        self.anchor, self.importance = unpacked("anchor", state), unpacked("importance", state)


def fisher_information(policy: Policy, source: Source[Batch], samples: int) -> Weights:
    """Return the mean squared gradient over `samples` losses, for each weight by name; 0 without samples."""
    squares = {name: torch.zeros_like(weight) for name, weight in policy.named_parameters()}
    trained = {name: weight for name, weight in policy.named_parameters() if weight.requires_grad}
    for _ in range(samples):
        loss = policy.action_loss(source.sample(1)).mean()
        found = torch.autograd.grad(loss, list(trained.values()), allow_unused=True)
        for name, gradient in zip(trained, found, strict=True):
            if gradient is not None:
                squares[name].addcmul_(gradient, gradient, value=1 / samples)
    return squares
