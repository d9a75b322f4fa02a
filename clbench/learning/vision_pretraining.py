"""Pretraining of the eyes: before a policy learns to act, its vision learns to tell what a picture shows.

It stands for the vision encoder of a vision-language model, which knows pictures before it sees a robot. A
linear probe on the tokens, thrown away after, is to say what the camera's `pictured` says of the state,
and the answer to everything that can be asked about it. Questions alone teach seeing too slowly: in 2,400
steps of one answer to a picture, colours stayed at chance; 800 steps of all answers made 0.95 of them right.
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
"""Steps of it for each step of pretraining."""
LEARNING_RATE = 3e-3
"""Peak step size."""
NUMBERS_WEIGHT = 3.0
"""Weight of the numbers' loss beside that of the answers: where a thing is matters more than what it is."""
PICTURES = 64
"""Pictures of each set that a step looks at."""


@dataclass(frozen=True)
class Pictures:
    """Pictures with all that is to be told of them."""

    image: Tensor
    """Pictures, uint8 (N, size, size, 3)."""
    numbers: Tensor
    """What they show in numbers of about 1, (N, K)."""
    answers: Tensor
    """Index of the right answer to each kind of question, -1 where it is too close to tell, (N, kinds)."""

    def sample(self, count: int, generator: torch.Generator) -> Pictures:
        """Return `count` of them at random."""
        rows = torch.randint(len(self.image), (count,), generator=generator)
        return Pictures(self.image[rows], self.numbers[rows], self.answers[rows])


def pictures_of(
    sets: Sequence[tuple[Tensor, Tensor]], camera: type[Camera], kinds: Sequence[QuestionKind]
) -> list[Pictures]:
    """Return sets of pictures with what is to be told of them.

    Args:
        sets: States of the world (N, W) with their pictures, (N, size, size, 3).
        camera: What drew them.
        kinds: What can be asked about a state.
    """
    shown = [camera.pictured(scene.numpy()) for scene, _ in sets]
    # quartiles, as the few pictures of a block that fell off the table would stretch a standard deviation
    low, middle, high = np.quantile(np.concatenate(shown), (0.25, 0.5, 0.75), axis=0)
    scale = ((high - low) / 1.35).clip(1e-2)  # that of a normal distribution is its standard deviation
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
    """Teach the eyes of a policy, in place, to tell what pictures show.

    Args:
        vision: The eyes.
        sets: Pictures; each step looks at `PICTURES` of each.
        kinds: What can be asked about them.
        steps: How many.
        generator: Draws the probe and the pictures.
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
        told = probe(vision(torch.cat([part.image for part in parts])).flatten(1))
        shown = torch.cat([part.numbers for part in parts])
        loss = NUMBERS_WEIGHT * F.smooth_l1_loss(told[:, :numbers], shown, beta=0.1)
        answers = torch.cat([part.answers for part in parts])
        answer_losses = [
            F.cross_entropy(logits, answer, ignore_index=-1, reduction="sum")
            / max(1, int((answer >= 0).sum()))
            for logits, answer in zip(told[:, numbers:].split(choices, dim=1), answers.T, strict=True)
        ]
        return loss + torch.stack(answer_losses).mean()

    optimise([*vision.parameters(), *probe.parameters()], LEARNING_RATE, steps, loss_at, after=after)
