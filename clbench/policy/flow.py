"""The flow-matching action head: it turns noise into a chunk of actions by a learned velocity.

Rectified flow as in pi0 (arXiv 2410.24164): x_t = t * noise + (1 - t) * action, velocity u = noise - action,
flow time t ~ Beta(1.5, 1), integrated from t = 1 to t = 0 by Euler steps.

Two things differ from pi0:

1. Flow times are not cut off near the action: t = 0 occurs.
2. Steps of a chunk that do not count, after the end of an episode and after action noise, have no loss. But
   in training the other steps attend to them. Like all steps they carry noise; they hold the last action
   repeated, or actions for states that the chunk does not lead to. When the policy acts, there are none.
"""

from __future__ import annotations

import math
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from clbench.policy.backbone import Layer
from clbench.policy.batch import mean_over_valid
from clbench.policy.head import ActionHead


class FlowHead(ActionHead):
    """Action tokens that attend, layer by layer, to the hidden states of the backbone and to each other."""

    time_features = 32

    def __init__(
        self, action_size: int, chunk: int, width: int, layers: int, heads: int, euler_steps: int
    ) -> None:
        super().__init__()
        self.euler_steps = euler_steps
        self.embed = nn.Linear(action_size, width)
        self.time = nn.Sequential(nn.Linear(self.time_features, width), nn.SiLU(), nn.Linear(width, width))
        self.position = nn.Parameter(0.02 * torch.randn(1, chunk, width))
        self.layers = nn.ModuleList(Layer(width, heads) for _ in range(layers))
        self.velocity_out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, action_size))

    def velocity(self, noisy: Tensor, time: Tensor, hidden: list[Tensor], mask: Tensor) -> Tensor:
        """Return the velocity (B, H, A) at the noisy chunk (B, H, A) and flow time (B,)."""
        frequency = torch.exp(
            torch.linspace(0.0, math.log(1000.0), self.time_features // 2, device=noisy.device)
        )
        angle = time[:, None] * frequency
        clock = self.time(torch.cat([angle.sin(), angle.cos()], dim=1))
        tokens = self.embed(noisy) + self.position + clock[:, None]
        mask = F.pad(mask, (0, tokens.shape[1]), value=True)
        for layer, prefix in zip(self.layers, hidden, strict=True):
            tokens = layer(tokens, mask, prefix)
        return cast(Tensor, self.velocity_out(tokens))

    def fit(self, action: Tensor, mean: Tensor, std: Tensor) -> None:
        """Do nothing: velocities have no range."""

    def predict(
        self, action: Tensor, valid: Tensor, draw: Tensor, noise: Tensor, hidden: list[Tensor], mask: Tensor
    ) -> Tensor:
        """Return the velocity (B, H, A) at chunks with added noise; `loss` documents the arguments."""
        time = draw ** (1 / 1.5)  # the inverse of Beta(1.5, 1)'s distribution function t ** 1.5
        noisy = torch.lerp(action, noise, time[:, None, None])
        return self.velocity(noisy, time, hidden, mask)

    def loss(
        self, action: Tensor, valid: Tensor, draw: Tensor, noise: Tensor, hidden: list[Tensor], mask: Tensor
    ) -> Tensor:
        """Return the flow-matching loss of each sample, (B,): the mean over its valid steps and dimensions.

        Args:
            action: Normalised action chunks, (B, H, A).
            valid: Mask of the chunk's steps that count, (B, H).
            draw: Uniform draws in [0, 1), (B,), that choose the flow time.
            noise: Standard normal draws, (B, H, A).
            hidden: Hidden states of the backbone, one (B, P, W) per layer.
            mask: Mask of the prefix tokens that are read, (B, 1, 1, P).
        """
        predicted = self.predict(action, valid, draw, noise, hidden, mask)
        return mean_over_valid((predicted - (noise - action)).square(), valid)

    def sample(self, noise: Tensor, hidden: list[Tensor], mask: Tensor) -> Tensor:
        """Return the normalised action chunk (B, H, A) that the noise (B, H, A) flows to."""
        chunk = noise
        for step in range(self.euler_steps, 0, -1):
            time = torch.full((len(noise),), step / self.euler_steps, device=noise.device)
            chunk = chunk - self.velocity(chunk, time, hidden, mask) / self.euler_steps
        return chunk
