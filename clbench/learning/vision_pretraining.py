"""Pretraining of the vision: before a policy learns to act, its vision learns to describe pictures.

It takes the place of the vision encoder of a vision-language model, which knows pictures before it sees a
robot. A linear probe on the tokens, discarded afterwards, predicts the numbers of the camera's `pictured` and
the answer to every kind of question. One question per picture teaches vision too slowly: after 2,400 steps
colours stayed at chance; with all answers at once, 0.95 of them were right after 800 steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from clbench.data.questions import QuestionKind
from clbench.learning.optimise import optimise
from clbench.policy.vision import Vision
from clbench.worlds.camera import Camera

STEPS_SHARE = 0.25
"""Steps of the vision's pretraining for each step of the policy's pretraining."""
LEARNING_RATE = 3e-3
"""Peak learning rate."""
NUMBERS_WEIGHT = 3.0
"""Weight of the loss of the numbers relative to the answers: the position of an object matters more than its
kind."""
PICTURES = 64
"""Number of pictures from each set in a step."""


@dataclass(frozen=True)
class Pictures:
    """Pictures with the targets that the vision learns to predict."""

    image: Tensor
    """Pictures, uint8 (N, size, size, 3)."""
    numbers: Tensor
    """Numbers that describe the pictures, scaled to about 1, (N, K)."""
    answers: Tensor
    """Index of the right answer to each kind of question, -1 where it is too close to call, (N, kinds)."""

    def sample(self, count: int, generator: torch.Generator) -> Pictures:
        """Return `count` random pictures."""
        rows = torch.randint(len(self.image), (count,), generator=generator)
        return Pictures(self.image[rows], self.numbers[rows], self.answers[rows])


def pictures_of(
    sets: Sequence[tuple[Tensor, Tensor]], camera: type[Camera], kinds: Sequence[QuestionKind]
) -> list[Pictures]:
    """Return sets of pictures with their targets.

    Args:
        sets: States of the world (N, W) with their pictures, (N, size, size, 3).
        camera: Camera that drew the pictures.
        kinds: Kinds of questions about a state.
    """
    shown = [camera.pictured(scene.numpy()) for scene, _ in sets]
    # quartiles, because the few pictures of a block off the table would inflate a standard deviation
    low, middle, high = np.quantile(np.concatenate(shown), (0.25, 0.5, 0.75), axis=0)
    scale = ((high - low) / 1.35).clip(1e-2)  # the standard deviation of a normal distribution
    return [
        Pictures(
            image,
            torch.from_numpy((numbers - middle) / scale).clamp(-5.0, 5.0).float(),
            torch.stack([torch.from_numpy(kind.answer(scene.numpy())) for kind in kinds], dim=1),
        )
        for (scene, image), numbers in zip(sets, shown, strict=True)
    ]


def pretrain_vision(
    vision: Vision,
    sets: Sequence[Pictures],
    kinds: Sequence[QuestionKind],
    steps: int,
    generator: torch.Generator,
    after: Callable[[int], None] = lambda _: None,
) -> None:
    """Train the vision of a policy, in place, to describe pictures.

    Args:
        vision: Vision of the policy.
        sets: Sets of pictures; each step draws `PICTURES` from each set.
        kinds: Kinds of questions about the pictures.
        steps: Number of steps.
        generator: Random generator of the probe and of the pictures.
        after: Called after each step with the number of steps done.
    """
    numbers = sets[0].numbers.shape[1]
    choices = [len(kind.answers) for kind in kinds]
    probe = nn.Linear(vision.tokens * vision.width, numbers + sum(choices))
    with torch.no_grad():
        probe.weight.normal_(std=0.02, generator=generator)
        probe.bias.zero_()

    def loss_at(_: int) -> Tensor:
        parts = [one.sample(PICTURES, generator) for one in sets]
        predicted = probe(vision(torch.cat([part.image for part in parts])).flatten(1))
        shown = torch.cat([part.numbers for part in parts])
        loss = NUMBERS_WEIGHT * F.smooth_l1_loss(predicted[:, :numbers], shown, beta=0.1)
        answers = torch.cat([part.answers for part in parts])
        answer_losses = [
            F.cross_entropy(logits, answer, ignore_index=-1, reduction="sum")
            / max(1, int((answer >= 0).sum()))
            for logits, answer in zip(predicted[:, numbers:].split(choices, dim=1), answers.T, strict=True)
        ]
        return loss + torch.stack(answer_losses).mean()

    optimise([*vision.parameters(), *probe.parameters()], LEARNING_RATE, steps, loss_at, after=after)
