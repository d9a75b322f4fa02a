"""Batches: the samples of a loss, with its random draws.

A loss is therefore a function of the parameters and the batch alone: equal policies have equal losses on the
same batch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

NO_IMAGE = torch.zeros(0, 0, 0, 3, dtype=torch.uint8)
"""Placeholder for images without pixels, (B, 0, 0, 3), where the policy reads states alone."""


class _Rows:
    """Dataclass of tensors that share their first dimension; `state` and `image` are among them."""

    state: Tensor
    image: Tensor

    def __post_init__(self) -> None:
        if self.image is NO_IMAGE:
            blank = NO_IMAGE.new_zeros((len(self.state), 0, 0, 3), device=self.state.device)
            object.__setattr__(self, "image", blank)

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Return the parts as one batch, in their order."""
        columns = {
            field.name: torch.cat([getattr(part, field.name) for part in parts])
            for field in dataclasses.fields(cls)  # type: ignore[arg-type]
        }
        return cls(**columns)

    def __getitem__(self, rows: slice | Sequence[int] | Tensor) -> Self:
        """Return some rows as a batch.

        Args:
            rows: A slice, the numbers of the rows, or a mask of them, bool (B,).
        """
        columns = {field.name: getattr(self, field.name)[rows] for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        return type(self)(**columns)

    def to(self, device: torch.device | str) -> Self:
        """Return the same rows on `device`."""
        columns = {field.name: getattr(self, field.name).to(device) for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        return type(self)(**columns)

    def __repr__(self) -> str:
        columns = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))  # type: ignore[arg-type]
        shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in columns if value.numel())
        return f"<{type(self).__name__} of {len(self)} samples: {shapes}>"

    def __len__(self) -> int:
        first = dataclasses.fields(self)[0].name  # type: ignore[arg-type]
        return len(getattr(self, first))


@dataclass(frozen=True, repr=False)
class Batch(_Rows):
    """Demonstrated action chunks, B samples of H actions."""

    state: Tensor
    """Numbers of the observations, as the world or its camera gives them, (B, S)."""
    words: Tensor
    """Word ids of the instructions, (B, L)."""
    action: Tensor
    """Next actions of the expert in the units of the world, (B, H, A)."""
    valid: Tensor
    """Mask of actions that count, (B, H): 0 after the end of the episode and after action noise, else 1."""
    draw: Tensor
    """Uniform draws in [0, 1) for the action head, (B,)."""
    noise: Tensor
    """Standard normal draws for the action head, (B, H, A)."""
    image: Tensor = NO_IMAGE
    """Pictures of the camera, uint8 (B, N, N, 3); N is 0 where the policy sees none."""


@dataclass(frozen=True, repr=False)
class QuestionBatch(_Rows):
    """Questions with their answers, B samples."""

    state: Tensor
    """Numbers of the observations, as the world or its camera gives them, (B, S)."""
    words: Tensor
    """Word ids of the questions, (B, L)."""
    answer: Tensor
    """Word id of the right answer, (B,)."""
    image: Tensor = NO_IMAGE
    """Pictures of the camera, uint8 (B, N, N, 3); N is 0 where the policy sees none."""


def mean_over_valid(errors: Tensor, valid: Tensor) -> Tensor:
    """Return the mean (B,) of errors (B, H, A) over action dimensions and the valid steps (B, H)."""
    return (errors.mean(dim=2) * valid).sum(dim=1) / valid.sum(dim=1)
