"""AEGIS: the backbone's gradient must not move its hidden states away from an anchor (arXiv 2604.16067).

Before training, the pretrained policy reads questions. The mean and variance of the hidden states of every
layer form a diagonal Gaussian: the anchor. Each step differentiates the action loss and also the squared
2-Wasserstein distance between the batch's hidden states and the anchor. If the two gradients of a layer have
a negative inner product d, a step that lowers the loss would raise the distance. The part of the loss's
gradient along the anchor's gradient is then removed: g - d / ||g_anchor||^2 g_anchor (Eq. 12 and 13).

The formulas and constants come from other readers' notes on the paper. We have read only its abstract: below,
"the paper" means the paper as these notes describe it. Where the notes are silent, a detail marks what we do
as "our choice".

Details:
1. The anchor is computed from the benchmark's training questions instead of 3,000 questions from VQAv2, over
   all tokens except padding (our choice). The mean and the deviation are kept per channel: the paper writes
   "means and variances" of a layer, and its distance is exact for diagonal Gaussians.
2. The hidden state is the output of each backbone layer. The statistics of a step come from its batch. Both
   are our choice.
3. The block of a layer holds all of the layer's trained weights. Weights outside the backbone's layers
   (embeddings, action head, answer head) keep the loss's gradient. Both are our choice.
4. The paper adds eps to the norm, which leaves a small negative product. Here the division is exact, and an
   anchor gradient of norm 0 does not change the block.
5. The distance is summed over channels and, by our choice, averaged over layers. Its scale cancels out of
   the projection.
6. Projection comes before Adam and, by our choice, before clipping, so the final step need not be orthogonal.
7. The paper fine-tunes on one data set. In a sequence, the pretrained policy remains the anchor.
8. The one pass over the questions is not an optimiser step, so no cost on the board counts it.
9. The share of energy that is shed refers to the gradient of the backbone's layers, by our choice. Relative
   to the gradient of all trained weights, the share would be smaller.
10. Batches of robot data are unlike questions: on FetchKnowledge-v1, the squared distance of a batch to the
   anchor is 73 to 119 before the first step, and 2 to 4 after the last step of the first stage. The
   projection removes only what leads away from the anchor, so it does not hold the robot's hidden states in
   place: they move onto the questions' hidden states. With a random direction the distance grows to 168 to
   268.
11. 1e-6 is added to each variance before its square root, whose slope is infinite at 0.

`direction="random"` is the control: the same projection against a random direction. (This direction has the
norm of the anchor's gradient, but the projection does not depend on the norm.)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from clbench.base.errors import InputError
from clbench.learning.method import Metadata, Method, MethodState, Progress, Stage
from clbench.learning.prior import Prior, Uses
from clbench.policy.activations import Gaussian
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._projection import inner, project_out, random_like
from ._requirements import in_range, one_of


@dataclass
class Aegis(Method):
    """Project out, layer by layer, the part of the gradient that moves activations away from the anchor."""

    samples: int = 3000
    """Number of questions for the anchor (the paper's number)."""
    direction: str = "anchor"
    """Direction to project against: "anchor", or "random" for the control."""

    uses = Uses(questions="prepare")
    needs = ("hidden_states",)
    metadata = Metadata(link="https://arxiv.org/abs/2604.16067")

    def __post_init__(self) -> None:
        in_range("samples", self.samples, 1)
        one_of("direction", self.direction, ("anchor", "random"))

    @torch.no_grad()
    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Compute the anchor."""
        if not any(one.requires_grad for layer in policy.backbone_layers for one in layer.parameters()):
            raise InputError(
                f"aegis projects gradients in the backbone, and {type(policy).__name__} freezes all of its "
                "layers. Nothing is left to project: leave aegis out."
            )
        questions = prior.questions.sample(self.samples)
        hidden = policy.hidden_states(questions.state, questions.words, questions.image)
        self.anchor = Gaussian.of(hidden, policy.token_mask(questions.words))

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters."""
        self.distances: list[Tensor] = []
        self.shed: list[float] = []
        self.projected: list[float] = []
        return policy.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the action loss, and keep the hidden states' distance to the anchor for `gradients`."""
        hidden = policy.hidden_states(batch.state, batch.words, batch.image)
        now = Gaussian.of(hidden, policy.token_mask(batch.words))
        self.distances.append(now.distance(self.anchor).mean())
        return policy.action_loss(batch, hidden).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the loss, projected in the backbone's layers."""
        layers = [
            [one for one in layer.parameters() if one.requires_grad] for layer in policy.backbone_layers
        ]
        blocks = [layer for layer in layers if layer]
        weights = [weight for block in blocks for weight in block]
        away = iter(
            torch.autograd.grad(self.distances[-1], weights, retain_graph=True, materialize_grads=True)
        )
        self.distances[-1] = self.distances[-1].detach()
        loss.backward()  # type: ignore[no-untyped-call]
        energy, removed, projected = 0.0, 0.0, 0
        for block in blocks:
            directions = [next(away) for _ in block]
            if self.direction == "random":
                directions = random_like(directions)
            used = [(weight.grad, one) for weight, one in zip(block, directions, strict=True)]
            gradient = [grad for grad, _ in used if grad is not None]
            against = [one for grad, one in used if grad is not None]
            energy += inner(gradient, gradient)
            part = project_out(gradient, against)
            removed, projected = removed + part, projected + (part > 0)
        self.shed.append(removed / energy if energy else 0.0)
        self.projected.append(projected / len(blocks))

    def state(self) -> MethodState:
        """Return the anchor."""
        return {"mean": self.anchor.mean, "deviation": self.anchor.deviation}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Restore the anchor."""
        mean, deviation = state["mean"], state["deviation"]
        assert isinstance(mean, Tensor)
        assert isinstance(deviation, Tensor)
        self.anchor = Gaussian(mean, deviation)

    def diagnostics(self) -> dict[str, Any]:
        """Return how much was projected out, and the distance to the anchor during the stage.

        `energy_shed_mean`, `energy_shed_highest`: removed share of the energy of the backbone layers'
        gradients, over the steps. `layers_projected_mean`: share of the layers with a negative product.
        `anchor_distance`: squared 2-Wasserstein distance between the batch and the anchor at eleven steps,
        the first and the last included.
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
