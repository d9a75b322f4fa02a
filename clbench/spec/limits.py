"""Limits of the process of a submitted run: its time, its memory, and the bytes that it writes.

They stop a method that goes wrong, not one that means harm. A method runs as the user who starts it, and can
read, write and send whatever that user can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from clbench.spec.fields import check_positive, check_whole


@dataclass(frozen=True)
class Limits:
    """Limits of a process and all processes that it starts. Our own runs need far less than the defaults."""

    seconds: float = 3600.0
    """Time since its start, in seconds; `math.inf` for no limit."""
    memory: int = 8 * 1024**3
    """Resident memory at any one time, in bytes."""
    written: int = 4 * 1024**3
    """Bytes that the process asks the system to write, wherever to: files, pipes or a terminal. Not measured
    on macOS, which does not count them."""

    def __post_init__(self) -> None:
        if self.seconds != math.inf:
            check_positive(self, "seconds")
        check_whole(self, 1, "memory", "written")
