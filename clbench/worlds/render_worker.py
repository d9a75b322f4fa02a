"""Drawing process of an observer (`clbench.worlds.observation`): reads views and states, writes pictures.

It starts as `python -m clbench.worlds.render_worker CAMERA`.
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
"""Number of rows, and numbers per row: first the view, then the state."""

END = HEADER.pack(0, 0)
"""Header that ends the process. Its input ends only when no process holds the other end of the pipe, and
forked ones inherit it."""


def main(entry_point: str) -> None:
    """Draw the rows of numbers that follow each header on standard input, until `END` or the input's end.

    Args:
        entry_point: Entry point of the camera.
    """
    # the output of a library must not come between the pictures
    pictures = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    camera: Camera = resolve(entry_point)()
    while (header := sys.stdin.buffer.read(HEADER.size)) not in (END, b""):
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
