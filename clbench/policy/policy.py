"""The policy protocol: what methods, evaluation and pretraining need from a policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from clbench.base.errors import ClbenchError
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.vision import Vision
from clbench.spec.budget import HEADS
from clbench.spec.language import TEXT_LENGTH, VOCABULARY_SIZE
from clbench.spec.policies import DEFAULT_POLICY

ABILITIES = ("hidden_states", "answers")
"""Abilities that a policy may have besides the protocol."""


class MissingAbilityError(ClbenchError, TypeError):
    """A policy lacks an ability that its caller needs."""


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
    """Number of tokens that it can read and answer."""
    text_length: int = TEXT_LENGTH
    """Words, or pieces of words, that it can read at once."""
    image_size: int = 0
    """Width and height of the image that it sees, in pixels; 0 without images."""
    kind: str = DEFAULT_POLICY
    """Kind of the policy: a key of `clbench.spec.policies.POLICIES`, or "module:Class"."""
    block: int = 0
    """Steps in a block of block-causal attention in a discrete-diffusion head; 0 without blocks."""


class Policy(nn.Module, ABC):
    """A policy: state, image and words in, action chunks out, and answers if it has that ability.

    A subclass takes `config` and `seed`, draws its initial weights from the seed alone, and implements the
    abstract methods. B samples have states (B, S), words (B, L) and chunks of H actions (B, H, A) in the
    units of the world. All draws come with the samples: equal policies have equal losses on the same batch.
    If a policy sees images, each function that takes states also takes images, uint8 (B, N, N, 3).

    Abilities are optional. A method names those that it needs in `needs`, and runs with no other policy.

    - "hidden_states": `hidden_states`, `token_mask` and `backbone_layers` show a backbone. The action head
      `head` reads its hidden states, and `action_loss` accepts them as `hidden`.
    - "answers": `answer_logits` answers questions about the scene.

    The built-in policies have both. Their parameters are in two modules: `backbone`, which also answers
    questions, and `head`, the action head.

    Args:
        config: Sizes of the policy.
        seed: Seed of the initial weights; the state of the global generator must not change.
    """

    abilities: ClassVar[frozenset[str]] = frozenset()
    """Abilities that the policy has, from `ABILITIES`."""
    pretrained: ClassVar[bool] = False
    """Whether a new policy has pretrained weights of its own, which clbench then uses as they are."""
    head: nn.Module
    """The action head, whose parameters belong to the policy; needed for the ability "hidden_states"."""

    state_mean: Tensor
    """Mean of the states given to `normalise_like`, (S,), in the units of the world; 0 before the call."""
    state_std: Tensor
    """Standard deviation of these states, (S,), at least 0.01; 1 before the call."""
    action_mean: Tensor
    """Mean of the actions given to `normalise_like`, (A,), in the units of the world; 0 before the call."""
    action_std: Tensor
    """Standard deviation of these actions, (A,), at least 0.01; 1 before the call."""

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        for name, size in (("state", config.state_size), ("action", config.action_size)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    @property
    def device(self) -> torch.device:
        """Device on which the policy computes."""
        return self.state_mean.device

    def normalise_like(self, state: Tensor, action: Tensor | None = None) -> None:
        """Set the normalisation to the mean and deviation of states (N, S) and, if given, actions (N, A)."""
        for name, values in (("state", state), ("action", action)):
            if values is None:
                continue
            getattr(self, f"{name}_mean").copy_(values.mean(dim=0))
            # at least 1e-2, a centimetre or a hundredth of the actions: nearly constant values stay small
            getattr(self, f"{name}_std").copy_(values.std(dim=0, correction=0).clamp(min=1e-2))

    @abstractmethod
    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        """Return the loss of each sample, (B,), on demonstrated action chunks.

        A flow head's loss is the mean squared error of velocities over the dimensions of the valid actions:
        `(predict(batch) - (noise - action)) ** 2`, with normalised actions. The loss of a discrete-diffusion
        head is the mean cross-entropy of the masked tokens of the valid actions.

        Args:
            batch: Demonstrated action chunks.
            hidden: Hidden states to use instead of `hidden_states(batch.state, batch.words, batch.image)`:
                detached ones stop the gradient at the backbone. They need the ability "hidden_states".
        """

    @abstractmethod
    def predict(self, batch: Batch) -> Tensor:
        """Return what the policy predicts in its loss, (B, H, A), to compare policies of one kind.

        A flow head predicts the velocity from the normalised action to the noise, `noise - action`; a
        discrete-diffusion head predicts the normalised action. Actions that are not valid have predictions
        too: leave them out with `batch.valid`.
        """

    @abstractmethod
    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        """Return the action chunk (B, H, A) for states (B, S) and words (B, L).

        Args:
            state: Observations.
            words: Word ids of the instructions.
            noise: Standard normal draws, (B, H, A): the only source of chance.
            image: Images, if the policy sees them.
        """

    def hidden_states(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> list[Tensor]:
        """Return the hidden state (B, P, W) of every backbone layer for states (B, S) and words (B, L)."""
        raise self._lacks("hidden_states")

    def token_mask(self, words: Tensor) -> Tensor:
        """Return which tokens of the hidden states are read, (B, 1, 1, P): all but the words' padding."""
        raise self._lacks("hidden_states")

    @property
    def backbone_layers(self) -> Sequence[nn.Module]:
        """Layers of the backbone, as many as there are hidden states."""
        raise self._lacks("hidden_states")

    def answer_logits(self, state: Tensor, words: Tensor, image: Tensor | None = None) -> Tensor:
        """Return the logits (B, V) of the word that answers the question `words` about `state`."""
        raise self._lacks("answers")

    def answer_loss(self, questions: QuestionBatch) -> Tensor:
        """Return the cross-entropy of each right answer, (B,)."""
        logits = self.answer_logits(questions.state, questions.words, questions.image)
        return F.cross_entropy(logits, questions.answer, reduction="none")

    def vision_to_pretrain(self) -> Vision | None:
        """Return the module that is pretrained on pictures before the policy, None if there is none."""
        return None

    def _lacks(self, ability: str) -> MissingAbilityError:
        return MissingAbilityError(f"{type(self).__name__} does not have the ability {ability!r}.")


@contextmanager
def evaluating(policy: Policy) -> Iterator[None]:
    """Put a policy into evaluation mode inside the block, then each of its modules into the mode it had."""
    before = [(module, module.training) for module in policy.modules()]
    policy.eval()
    try:
        yield
    finally:
        for module, training in before:  # first the whole, then its parts
            module.train(training)
