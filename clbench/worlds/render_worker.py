"""A process that draws: it reads views and states and writes pictures, for an observer (`clbench.worlds.observation`).

It is started as `python -m clbench.worlds.render_worker CAMERA`.
"""

from __future__ import annotations

import os
import struct
import sys

import numpy as np

from clbench.base.entry_points import resolve
from clbench.base.errors import WrongTypeError
from clbench.worlds.camera import VIEW_SIZE, Camera

HEADER = struct.Struct("<II")
"""How many rows come, and how many numbers each has: those of a view, then those of the state."""


def main(entry_point: str) -> None:
    """Draw what comes on standard input, as bare numbers after a header, until it ends.

    Args:
        entry_point: Of the camera.
    """
    # what a library prints must not come between the pictures
    pictures = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    camera: Camera = resolve(entry_point)()
    while header := sys.stdin.buffer.read(HEADER.size):
        count, size = HEADER.unpack(header)
        numbers = np.frombuffer(sys.stdin.buffer.read(4 * count * size), np.float32)
        views, states = np.split(numbers.reshape(count, size), [VIEW_SIZE], axis=1)
        drawn = camera.draw(states, views)
        wanted = (count, camera.image_size, camera.image_size, 3)
        if drawn.shape != wanted or drawn.dtype != np.uint8:
            raise WrongTypeError(f"draw() must return {wanted} of uint8, not {drawn.shape} of {drawn.dtype}.")
        pictures.write(drawn.tobytes())
        pictures.flush()


if __name__ == "__main__":
    main(sys.argv[1])
