"""Action heads: the part in which kinds of policies differ."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn


class ActionHead(nn.Module, ABC):
    """Maps the backbone's hidden states to chunks of normalised actions.

    B samples have chunks of H steps with A dimensions. A sample's draws come with it, so that losses of equal
    heads are equal. The hidden states are one (B, P, W) per layer; the mask (B, 1, 1, P) is True for the
    tokens of the prefix that are read.
    """

    @abstractmethod
    def fit(self, action: Tensor, mean: Tensor, std: Tensor) -> None:
        """Set the values of the head that depend on the actions of pretraining.

        Args:
            action: Actions in the units of the world, (N, A).
            mean: Action that the policy's normalisation maps to 0, (A,).
            std: Difference of actions that it maps to 1, (A,).
        """

    @abstractmethod
    def predict(
        self, action: Tensor, valid: Tensor, draw: Tensor, noise: Tensor, hidden: list[Tensor], mask: Tensor
    ) -> Tensor:
        """Return what the head predicts at corrupted chunks, (B, H, A); `loss` documents the arguments."""

    @abstractmethod
    def loss(
        self, action: Tensor, valid: Tensor, draw: Tensor, noise: Tensor, hidden: list[Tensor], mask: Tensor
    ) -> Tensor:
        """Return the loss of each sample, (B,): the mean over its steps that count.

        Args:
            action: Normalised action chunks, (B, H, A).
            valid: Mask of the chunk's steps that count, (B, H).
            draw: Uniform draws in [0, 1), (B,), that choose how much is corrupted.
            noise: Standard normal draws, (B, H, A), that choose how.
            hidden: Hidden states of the backbone.
            mask: Mask of the prefix.
        """

    @abstractmethod
    def sample(self, noise: Tensor, hidden: list[Tensor], mask: Tensor) -> Tensor:
        """Return the normalised action chunk (B, H, A) for noise (B, H, A)."""
