"""The camera of the toy: it needs no graphics, so that tests of vision run on any machine."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from clbench.worlds.camera import Images, Views
from clbench.worlds.world import States

REACH = 2.5
"""Distance from the middle to the edge of the picture, in the units of the toy."""


class ToyCamera:
    """Draws the point as a red blob and the marker as a green one."""

    image_size: ClassVar[int] = 16
    state_size: ClassVar[int] = 1

    @staticmethod
    def proprioception(states: States) -> States:
        """Return the horizontal position of the point, (N, 1)."""
        return states[:, :1]

    @staticmethod
    def pictured(states: States) -> States:
        """Return the positions of point and marker, (N, 4)."""
        return states[:, :4]

    def draw(self, states: States, views: Views) -> Images:
        """Return pictures (N, 16, 16, 3) with the same upward direction as the plane; views darken them."""
        centres = np.linspace(-REACH, REACH, self.image_size)
        images = np.zeros((len(states), self.image_size, self.image_size, 3), np.uint8)
        for channel, thing in enumerate((states[:, :2], states[:, 2:4])):
            right = np.exp(-(((centres - thing[:, :1]) / 0.4) ** 2))
            up = np.exp(-(((centres[::-1] - thing[:, 1:]) / 0.4) ** 2))
            light = 255 - 50 * abs(views[:, 3, None, None])
            images[..., channel] = np.round(light * up[:, :, None] * right[:, None, :])
        return images
