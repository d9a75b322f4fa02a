"""policy_template: a diffusion policy (Chi et al., arXiv 2303.04137) on an MLP.

A policy is a `clbench.Policy`: an `nn.Module` that is made from its sizes and a seed.
B samples have states (B, S), word ids (B, L) and chunks of H actions (B, H, A). They
bring their own draws: use `batch.draw` (B,), `batch.noise` (B, H, A) and the argument
`noise` wherever you would draw, and equal weights give equal results.
"""

import math

import torch
from clbench import Batch, Policy, PolicyConfig
from torch import Tensor, nn

WIDTH = 256
"""Channels of the hidden layers."""

DENOISING_STEPS = 10
"""Forwards that turn noise into actions."""


class PolicyTemplate(Policy):
    """An MLP that restores actions from noise, given the state and the words."""

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        actions = config.chunk * config.action_size
        with torch.random.fork_rng(devices=[]):  # the global generator stays as it is
            torch.default_generator.manual_seed(seed)  # of the CPU alone
            self.words = nn.EmbeddingBag(config.vocabulary_size, WIDTH, padding_idx=0)
            self.read = nn.Linear(config.state_size + actions + 2, WIDTH)
            # LoRA adapts the linear maps inside modules that are called `layers`
            self.layers = nn.ModuleList(_layer() for _ in range(4))
            self.write = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, actions))

    def restore(
        self,
        noisy: Tensor,
        time: Tensor,
        state: Tensor,
        words: Tensor,
    ) -> Tensor:
        """Return the normalised chunks behind noisy ones, at times (B,) from 0 to 1."""
        # `normalise_like` of the base class sets these means and deviations
        seen = ((state - self.state_mean) / self.state_std).clamp(-10, 10)
        angle = (math.pi / 2 * time)[:, None]
        parts = [seen, noisy.flatten(1), angle.sin(), angle.cos()]
        hidden = self.read(torch.cat(parts, dim=1)) + self.words(words)
        for layer in self.layers:
            hidden = hidden + layer(hidden)
        chunk: Tensor = self.write(hidden)
        return chunk.view_as(noisy)

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        """Return the loss of each sample, (B,): the mean over actions that count."""
        action = (batch.action - self.action_mean) / self.action_std
        error = (self.predict(batch) - action).square().mean(dim=2)
        return (error * batch.valid).sum(dim=1) / batch.valid.sum(dim=1)

    def predict(self, batch: Batch) -> Tensor:
        """Return the chunks (B, H, A) that are restored from noisy ones."""
        action = (batch.action - self.action_mean) / self.action_std
        angle = (math.pi / 2 * batch.draw)[:, None, None]
        noisy = angle.cos() * action + angle.sin() * batch.noise
        return self.restore(noisy, batch.draw, batch.state, batch.words)

    @torch.inference_mode()
    def act(
        self,
        state: Tensor,
        words: Tensor,
        noise: Tensor,
        image: Tensor | None = None,
    ) -> Tensor:
        """Return actions (B, H, A) in the units of the world, from noise."""
        chunk = noise
        for step in range(DENOISING_STEPS, 0, -1):
            time = noise.new_full((len(noise),), step / DENOISING_STEPS)
            action = self.restore(chunk, time, state, words)
            now = math.pi / 2 * step / DENOISING_STEPS
            later = math.pi / 2 * (step - 1) / DENOISING_STEPS
            left = (chunk - math.cos(now) * action) / math.sin(now)
            chunk = math.cos(later) * action + math.sin(later) * left
        return chunk * self.action_std + self.action_mean


def _layer() -> nn.Module:
    return nn.Sequential(
        nn.LayerNorm(WIDTH),
        nn.Linear(WIDTH, WIDTH),
        nn.GELU(),
        nn.Linear(WIDTH, WIDTH),
    )
