"""The camera of the toy: it needs no graphics, so that what policies see can be tried where nothing draws."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from clbench.worlds.camera import Images, States, Views

REACH = 2.5
"""How far from the middle the picture reaches, in the units of the toy."""


class ToyCamera:
    """Draws the point as a red blob and the marker as a green one."""

    image_size: ClassVar[int] = 16
    state_size: ClassVar[int] = 1

    @staticmethod
    def proprioception(states: States) -> States:
        """Return how far right the point is, (N, 1)."""
        return states[:, :1]

    @staticmethod
    def pictured(states: States) -> States:
        """Return where point and marker are, (N, 4)."""
        return states[:, :4]

    def draw(self, states: States, views: Views) -> Images:
        """Return pictures (N, 16, 16, 3); up is where it is in the plane. A view makes one darker."""
        centres = np.linspace(-REACH, REACH, self.image_size)
        images = np.zeros((len(states), self.image_size, self.image_size, 3), np.uint8)
        for channel, thing in enumerate((states[:, :2], states[:, 2:4])):
            right = np.exp(-(((centres - thing[:, :1]) / 0.4) ** 2))
            up = np.exp(-(((centres[::-1] - thing[:, 1:]) / 0.4) ** 2))
            light = 255 - 50 * abs(views[:, 3, None, None])
            images[..., channel] = np.round(light * up[:, :, None] * right[:, None, :])
        return images
