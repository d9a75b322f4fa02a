"""The built-in policy: a transformer that reads state, image and words, and an action head."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, cast

import torch
from torch import Tensor, nn

from clbench.policy.backbone import Backbone
from clbench.policy.batch import Batch
from clbench.policy.discrete import DiscreteDiffusionHead
from clbench.policy.flow import FlowHead
from clbench.policy.head import ActionHead
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.vision import Vision

LARGEST_STATE = 10.0
"""Normalised states are clipped at this many standard deviations of the demonstrations, on both sides."""


def new_head(config: PolicyConfig) -> ActionHead:
    """Return the action head of the policy's kind, with initial weights."""
    sizes = (config.action_size, config.chunk, config.width, config.layers, config.heads)
    if config.kind == "discrete_diffusion":
        return DiscreteDiffusionHead(*sizes, block=config.block)
    return FlowHead(*sizes, config.euler_steps)


class TransformerPolicy(Policy):
    """A small vision-language-action model: a backbone, and a head that reads all its layers.

    Args:
        config: Sizes of the policy; `kind` chooses the head.
        seed: Seed of the initial weights; the state of the global generator does not change.
    """

    abilities: ClassVar[frozenset[str]] = frozenset({"hidden_states", "answers"})
    head: ActionHead

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)  # `torch.manual_seed` would also seed every GPU
            self.backbone = Backbone(
                config.state_size,
                config.vocabulary_size,
                config.text_length,
                config.width,
                config.layers,
                config.heads,
                config.image_size,
            )
            self.head = new_head(config)

    def vision_to_pretrain(self) -> Vision | None:
        """Return the module that turns images into tokens."""
        return self.backbone.vision

    @property
    def backbone_layers(self) -> Sequence[nn.Module]:
        """Layers of the backbone."""
        return list(self.backbone.layers)

    def normalise_like(self, state: Tensor, action: Tensor | None = None) -> None:
        """Set the normalisation, and fit the head to the actions."""
        super().normalise_like(state, action)
        if action is not None:
            self.head.fit(action, self.action_mean, self.action_std)

    def hidden_states(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> list[Tensor]:
        """Return the hidden state (B, P, W) of every backbone layer for states (B, S) and words (B, L)."""
        normalised = ((state - self.state_mean) / self.state_std).clamp(-LARGEST_STATE, LARGEST_STATE)
        return cast(list[Tensor], self.backbone(normalised, words, image))

    def token_mask(self, words: Tensor) -> Tensor:
        """Return which tokens of the hidden states are read, (B, 1, 1, P): all but the words' padding."""
        return self.backbone.mask(words)

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        """Return the head's loss of each sample, (B,); `Policy.action_loss` documents the arguments."""
        hidden = self.hidden_states(batch.state, batch.words, batch.image) if hidden is None else hidden
        action = (batch.action - self.action_mean) / self.action_std
        mask = self.backbone.mask(batch.words)
        return self.head.loss(action, batch.valid, batch.draw, batch.noise, hidden, mask)

    def predict(self, batch: Batch) -> Tensor:
        """Return what the head predicts at the noisy chunks, (B, H, A)."""
        hidden = self.hidden_states(batch.state, batch.words, batch.image)
        action = (batch.action - self.action_mean) / self.action_std
        mask = self.backbone.mask(batch.words)
        return self.head.predict(action, batch.valid, batch.draw, batch.noise, hidden, mask)

    def answer_logits(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> Tensor:
        """Return the logits (B, V) of the word that answers the question `words` about `state`."""
        return self.backbone.answer_logits(self.hidden_states(state, words, image)[-1])

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        """Return the action chunk (B, H, A) for states (B, S) and words (B, L), from noise (B, H, A)."""
        hidden = self.hidden_states(state, words, image)
        chunk = self.head.sample(noise, hidden, self.backbone.mask(words))
        return chunk * self.action_std + self.action_mean
