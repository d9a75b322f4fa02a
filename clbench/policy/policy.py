"""The policy: backbone, action head, and the normalisation from pretraining."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from clbench.policy.backbone import Backbone
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.discrete import DiscreteDiffusionHead
from clbench.policy.flow import FlowHead
from clbench.policy.head import ActionHead
from clbench.spec.budget import HEADS
from clbench.spec.language import TEXT_LENGTH, VOCABULARY_SIZE
from clbench.spec.policies import DEFAULT_POLICY


@dataclass(frozen=True)
class PolicyConfig:
    """Sizes of a policy, and its conventions with the world."""

    state_size: int
    """Length of the observation vector of the world."""
    action_size: int
    """Length of the action vector of the world."""
    width: int = 96
    """Channels of each token."""
    layers: int = 3
    """Layers of the backbone, and also of the action head."""
    heads: int = HEADS
    """Attention heads."""
    chunk: int = 8
    """Actions that a forward predicts."""
    executed: int = 4
    """Actions of a chunk to execute before the next forward."""
    euler_steps: int = 5
    """Euler steps that integrate the flow."""
    vocabulary_size: int = VOCABULARY_SIZE
    """Number of words that it can read and answer."""
    text_length: int = TEXT_LENGTH
    """Words, or pieces of words, that it can read at once."""
    image_size: int = 0
    """Width and height of the image that it sees, in pixels; 0 without images."""
    kind: str = DEFAULT_POLICY
    """Kind of its action head, one of `POLICIES`."""
    block: int = 0
    """Steps in a block of block-causal attention in a discrete-diffusion head; 0 without blocks."""


def new_head(config: PolicyConfig) -> ActionHead:
    """Return the action head of the policy's kind, with initial weights."""
    sizes = (config.action_size, config.chunk, config.width, config.layers, config.heads)
    if config.kind == "discrete_diffusion":
        return DiscreteDiffusionHead(*sizes, block=config.block)
    return FlowHead(*sizes, config.euler_steps)


class Policy(nn.Module):
    """A small vision-language-action model: state, image and words in, action chunks and answers out.

    Its parameters are in two modules: `backbone`, which also answers questions, and `head`, the action head.

    If a policy sees images, each function that takes states also takes images, uint8 (B, N, N, 3).

    Args:
        config: Sizes of the policy.
        seed: Seed of the initial weights; the state of the global generator does not change.
    """

    state_mean: Tensor
    state_std: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
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
        for name, size in (("state", config.state_size), ("action", config.action_size)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def normalise_like(self, state: Tensor, action: Tensor | None = None) -> None:
        """Set the normalisation to the mean and deviation of states (N, S) and, if given, actions (N, A)."""
        for name, values in (("state", state), ("action", action)):
            if values is None:
                continue
            getattr(self, f"{name}_mean").copy_(values.mean(dim=0))
            # at least 1e-2, a centimetre or a hundredth of the actions: nearly constant values stay small
            getattr(self, f"{name}_std").copy_(values.std(dim=0, correction=0).clamp(min=1e-2))
        if action is not None:
            self.head.fit(action, self.action_mean, self.action_std)

    def hidden_states(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> list[Tensor]:
        """Return the hidden state (B, P, W) of every backbone layer for states (B, S) and words (B, L)."""
        normalised = ((state - self.state_mean) / self.state_std).clamp(-10, 10)
        return cast(list[Tensor], self.backbone(normalised, words, image))

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        """Return the head's loss of each sample, (B,).

        A flow head has the mean squared error of its velocities, `(predict(batch) - (noise - action)) ** 2`
        with normalised actions, over the dimensions of the valid actions. A discrete-diffusion head has the
        mean cross-entropy of the masked tokens of the valid actions.

        Args:
            batch: Demonstrated action chunks.
            hidden: Hidden states to use instead of `hidden_states(batch.state, batch.words, batch.image)`:
                detached ones stop the gradient at the backbone.
        """
        hidden = self.hidden_states(batch.state, batch.words, batch.image) if hidden is None else hidden
        action = (batch.action - self.action_mean) / self.action_std
        mask = self.backbone.mask(batch.words)
        return self.head.loss(action, batch.valid, batch.draw, batch.noise, hidden, mask)

    def predict(self, batch: Batch) -> Tensor:
        """Return what the head predicts at the noisy chunks, (B, H, A), to compare policies of one kind.

        A flow head predicts the velocity from the normalised action to the noise, `noise - action`; a
        discrete-diffusion head predicts the normalised action. Actions that are not valid have predictions
        too: leave them out with `batch.valid`.
        """
        hidden = self.hidden_states(batch.state, batch.words, batch.image)
        action = (batch.action - self.action_mean) / self.action_std
        mask = self.backbone.mask(batch.words)
        return self.head.predict(action, batch.valid, batch.draw, batch.noise, hidden, mask)

    def answer_logits(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> Tensor:
        """Return the logits (B, V) of the word that answers the question `words` about `state`."""
        return self.backbone.answer_logits(self.hidden_states(state, words, image)[-1])

    def answer_loss(self, questions: QuestionBatch) -> Tensor:
        """Return the cross-entropy of each right answer, (B,)."""
        logits = self.answer_logits(questions.state, questions.words, questions.image)
        return F.cross_entropy(logits, questions.answer, reduction="none")

    @torch.inference_mode()
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        """Return the action chunk (B, H, A) for states (B, S) and words (B, L), from noise (B, H, A)."""
        hidden = self.hidden_states(state, words, image)
        chunk = self.head.sample(noise, hidden, self.backbone.mask(words))
        return chunk * self.action_std + self.action_mean
