"""ConSFT's sample weights, which its variants and controls share."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from clbench.learning.method import Metadata, Method, Progress, Stage
from clbench.learning.optimise import WARM_UP
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._requirements import in_range

BINS = (0.0, 0.01, 0.1, 0.5, 0.9, 1.0)
"""Edges of the histogram of weights in the diagnostics."""
SLICES = 10
"""Number of equal parts of the schedule. Each part has its own histogram; the last one also counts the steps
after the schedule."""
LEARNED_AFTER = 4.0
"""Sum of step factors after which plain fine-tuning has learned a target of MetaWorld-v1. The median is 3.5
to 4.6, whether the step factor is 1 or 0.0165 (tuning records, seeds 100 and 101). On Fetch-v1, it is 7 to 9
below a factor of 1 and 16.5 at 1, and on PointMaze-v1 12.4 to 16: see detail 3 of `consft`."""


@dataclass
class WeightedSFT(Method, ABC):
    """Fine-tune on a weighted loss. A subclass decides how ConSFT's weights are assigned to samples."""

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
    """Smallest weight (Table 5)."""
    loss_scale: float = 1.0
    """Factor that converts the policy's loss to the unit for which the constants were published."""
    schedule: float = 1.0
    """Length T of the schedule, as a share of the stage. For a stage that ends at a criterion, it is a share
    of the steps that plain fine-tuning with the same step factor takes to learn a target."""

    metadata = Metadata(link="https://arxiv.org/abs/2605.08879")
    tunes = ("tau_start", (0.03, 0.3))

    def __post_init__(self) -> None:
        for name in ("tau_start", "tau_end", "kappa", "decay", "curvature", "loss_scale", "schedule"):
            in_range(name, getattr(self, name), 1e-9)
        in_range("omega_min", self.omega_min, 0.0, 1.0)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and clear the histograms."""
        self.counts = torch.zeros(SLICES, len(BINS) - 1, dtype=torch.int64)
        return policy.parameters()

    def length(self, progress: Progress) -> float:
        """Return the length T of the schedule in steps."""
        if not progress.to_criterion:
            return self.schedule * progress.steps
        # the step factor falls short of its full value by about half of the warm-up
        return self.schedule * (WARM_UP / 2 + LEARNED_AFTER / self.step_factor)

    def temperature(self, progress: Progress) -> float:
        """Return tau at this step (Eq. 11 and 12)."""
        done = min(progress.step / self.length(progress), 1.0)
        least = math.exp(-self.decay)
        rho = (math.exp(-self.decay * done**self.curvature) - least) / (1.0 - least)
        return min(self.tau_start / max(rho, 1e-8), self.tau_end)

    def confidence(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return ConSFT's weights (Eq. 4): the confidence in each sample (B,), from its loss (B,)."""
        scale = self.loss_scale * self.kappa / self.temperature(progress)
        confidence = torch.exp(-scale * losses.detach())
        return confidence.clamp(min=self.omega_min)

    @abstractmethod
    def weights(self, losses: Tensor, progress: Progress) -> Tensor:
        """Return the weight of each sample (B,), from its loss (B,)."""

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the mean of the weighted losses."""
        losses = policy.action_loss(batch)
        weights = self.weights(losses, progress)
        counts = torch.histogram(weights.float().cpu(), torch.tensor(BINS)).hist
        part = int(SLICES * progress.step / self.length(progress))
        self.counts[min(part, SLICES - 1)] += counts.long()
        return (weights * losses).mean()

    def diagnostics(self) -> dict[str, Any]:
        """Return the histogram of the weights for each tenth of the schedule, with its bins `omega_edges`."""
        if not hasattr(self, "counts"):
            return {}
        return {"omega_edges": list(BINS), "omega_counts": self.counts.tolist()}


@dataclass
class CalibratedSFT(WeightedSFT, ABC):
    """Fine-tune on a weighted loss, scaled inside the weights, because its unit differs between policies."""

    loss_scale: float = 0.003

    tunes = ("loss_scale", (0.001, 0.01))
