"""AEGIS: the backbone's gradient may not lead away from where its hidden states lay (arXiv 2604.16067).

Before training, questions are read by the pretrained policy, and mean and variance of the hidden states of
every layer are kept as a diagonal Gaussian: the anchor. At each step the squared 2-Wasserstein distance of
the batch's hidden states to the anchor is differentiated besides the action loss. Where the two gradients of
a layer have a negative inner product d, so that descending the loss would raise the distance, the part of the
loss's gradient along the anchor's is removed: g - d / ||g_anchor||^2 g_anchor (Eq. 12 and 13).

Details:
1. The anchor is read on the benchmark's training questions, in the place of 3,000 questions of VQAv2, from
   all tokens that are not padding. Mean and deviation are kept for each channel: the paper says "means and
   variances" of a layer, and its distance is exact for diagonal Gaussians.
2. The hidden state is the output of each backbone layer, the statistics of a step are those of its batch.
3. A layer's block is all its weights. What lies outside the backbone's layers (embeddings, action head,
   answer head) keeps the loss's gradient.
4. The paper adds eps to the norm, which leaves a small negative product. Here the division is exact, and an
   anchor gradient of norm 0 leaves the block as it is.
5. The distance is summed over channels and averaged over layers; its scale cancels out of the projection.
6. Projection is before clipping and before Adam, whose step need not be orthogonal any more.
7. The paper fine-tunes on one data set. In a sequence the anchor stays that of the pretrained policy.

`direction="random"` is the control: the same projection against a random direction. (It has the norm of the
anchor's gradient, which the projection does not depend on.)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from clbench.learning.method import Metadata, Method, Progress, Stage, State
from clbench.learning.prior import Prior, Uses
from clbench.policy.activations import Gaussian
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._projection import inner, project_out, random_like
from ._requirements import in_range, require_hidden_states


@dataclass
class Aegis(Method):
    """Project the backbone's gradient, layer by layer, off what leads away from pretrained activations."""

    samples: int = 3000
    """Questions that the anchor is computed from (the paper's number)."""
    direction: str = "anchor"
    """What is projected against: "anchor", or "random" for the control."""

    uses = Uses(questions="prepare")
    metadata = Metadata(link="https://arxiv.org/abs/2604.16067")

    def __post_init__(self) -> None:
        in_range("samples", self.samples, 1)
        if self.direction not in ("anchor", "random"):
            raise ValueError(f"direction must be anchor or random, not {self.direction!r}.")

    @torch.no_grad()
    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Compute the anchor."""
        require_hidden_states(policy, "AEGIS")
        questions = prior.questions.sample(self.samples)
        hidden = policy.hidden_states(questions.state, questions.words, questions.image)
        self.anchor = Gaussian.of(hidden, policy.backbone.mask(questions.words))

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters."""
        self.distances: list[Tensor] = []
        self.shed: list[float] = []
        self.projected: list[float] = []
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the action loss; the distance of its hidden states to the anchor is kept for `gradients`."""
        hidden = policy.hidden_states(batch.state, batch.words, batch.image)
        now = Gaussian.of(hidden, policy.backbone.mask(batch.words))
        self.distances.append(now.distance(self.anchor).mean())
        return policy.action_loss(batch, hidden).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the loss, those of the backbone's layers projected."""
        blocks = [list(layer.parameters()) for layer in policy.backbone.layers]
        weights = [weight for block in blocks for weight in block]
        away = iter(
            torch.autograd.grad(self.distances[-1], weights, retain_graph=True, materialize_grads=True)
        )
        self.distances[-1] = self.distances[-1].detach()
        loss.backward()  # type: ignore[no-untyped-call]
        energy, removed, projected = 0.0, 0.0, 0
        for block in blocks:
            against = [next(away) for _ in block]
            if self.direction == "random":
                against = random_like(against)
            gradient = [weight.grad for weight in block if weight.grad is not None]
            energy += inner(gradient, gradient)
            part = project_out(gradient, against)
            removed, projected = removed + part, projected + (part > 0)
        self.shed.append(removed / energy if energy else 0.0)
        self.projected.append(projected / len(blocks))

    def state(self) -> State:
        """Return the anchor."""
        return {"mean": self.anchor.mean, "deviation": self.anchor.deviation}

    def load_state(self, policy: Policy, state: State) -> None:
        """Take the anchor back."""
        mean, deviation = state["mean"], state["deviation"]
        assert isinstance(mean, Tensor)
        assert isinstance(deviation, Tensor)
        self.anchor = Gaussian(mean, deviation)

    def diagnostics(self) -> dict[str, Any]:
        """Return what was projected, and the distance to the anchor along the stage.

        `energy_shed`: share of the energy of the backbone layers' gradients that was removed;
        `layers_projected`: share of the layers with a negative product; `anchor_distance`: squared
        2-Wasserstein distance of the batch to the anchor at eleven steps, the first and the last included.
        """
        if not getattr(self, "shed", None):
            return {}
        last = len(self.shed) - 1
        steps = [last * tenth // 10 for tenth in range(11)]
        return {
            "energy_shed_mean": sum(self.shed) / len(self.shed),
            "energy_shed_highest": max(self.shed),
            "layers_projected_mean": sum(self.projected) / len(self.projected),
            "anchor_distance": [float(self.distances[step]) for step in steps],
        }
