"""ConSFT: samples that the policy is not yet confident of weigh less (arXiv 2605.08879).

Every sample's loss L is weighed by omega = max(omega_min, exp(-kappa L / tau)) without a gradient through
omega (Eq. 5, 11 and 12). The temperature tau rises from `tau_start` to `tau_end` over the schedule, so that
training begins conservative and ends as plain fine-tuning. No data, no network and no memory are added.

Details:
1. The batch loss is the mean of omega_i L_i. It is never divided by the sum of the weights: that would cancel
   most of the method.
2. L_i is the mean over the valid steps and the dimensions of the chunk, at the one draw of flow time and
   noise that the step trains on. The paper does not say how it reduces the loss; this is openpi's way.
3. The schedule's clock starts anew with each target and its length T is the stage's optimiser steps. The
   paper tunes T for each task (2,000 steps there).
4. Step size, optimiser and clipping are the benchmark's, the same for every method. Adam divides a constant
   factor of the loss out again, so that weights which all lie on the floor change nothing.

`ConSFTCalibrated` changes the two constants that the authors tune for each task, `tau_start` and T. They were
chosen on validation episodes of seed 100, which is not reported: docs/reference/methods/consft.md has the sweep.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from clbench.learning.method import Metadata, Method, Progress, Stage
from clbench.learning.prior import Prior
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._requirements import in_range, require_loss_per_sample

BINS = (0.0, 0.01, 0.1, 0.5, 0.9, 1.0)
"""Edges of the histogram of the weights that the diagnostics show."""
SLICES = 10
"""Equal parts of a stage that have a histogram each."""


@dataclass
class ConSFT(Method):
    """Weigh each sample's loss by the policy's confidence in it."""

    tau_start: float = 0.003
    """Temperature at the start (Table 5)."""
    tau_end: float = 5.0
    """Highest temperature (Table 5)."""
    kappa: float = 25.0
    """Factor of the loss inside the weight (Table 5)."""
    decay: float = 0.8
    """Rate lambda of the schedule (Table 5)."""
    curvature: float = 3.5
    """Exponent c of the schedule (Table 5)."""
    omega_min: float = 0.001
    """Least weight (Table 5)."""
    schedule: float = 1.0
    """Length T of the schedule, as a share of the stage's steps."""

    metadata = Metadata(link="https://arxiv.org/abs/2605.08879")

    def __post_init__(self) -> None:
        for name in ("tau_start", "tau_end", "kappa", "decay", "curvature", "schedule"):
            in_range(name, getattr(self, name), 1e-9)
        in_range("omega_min", self.omega_min, 0.0, 1.0)

    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Refuse a policy without a loss for each sample."""
        require_loss_per_sample(policy, type(self).__name__)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and begin the histogram of the weights."""
        self.counts = torch.zeros(SLICES, len(BINS) - 1, dtype=torch.int64)
        return policy.parameters()

    def temperature(self, progress: Progress) -> float:
        """Return tau at this step (Eq. 11 and 12)."""
        done = min(progress.step / (self.schedule * progress.steps), 1.0)
        least = math.exp(-self.decay)
        rho = (math.exp(-self.decay * done**self.curvature) - least) / (1.0 - least)
        return min(self.tau_start / max(rho, 1e-8), self.tau_end)

    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the weight of each sample (B,), from its loss (B,)."""
        confidence = torch.exp(-self.kappa / self.temperature(progress) * losses.detach())
        return confidence.clamp(min=self.omega_min)

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the mean of the weighted losses."""
        losses = policy.action_loss(batch)
        weights = self.weights(losses, progress)
        counts = torch.histogram(weights.cpu(), torch.tensor(BINS)).hist
        self.counts[SLICES * progress.step // progress.steps] += counts.long()
        return (weights * losses).mean()

    def diagnostics(self) -> dict[str, Any]:
        """Return how many weights fell between the `edges` in each tenth of the stage."""
        if not hasattr(self, "counts"):
            return {}
        return {"omega_edges": list(BINS), "omega_counts": self.counts.tolist()}


@dataclass
class ConSFTCalibrated(ConSFT):
    """Weigh each sample's loss by confidence, on the scale of this policy's losses."""

    tau_start: float = 1.0
    """Chosen on validation episodes of seed 100."""
    schedule: float = 1.0
    """Chosen likewise."""
