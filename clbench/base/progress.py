"""Callbacks that report progress."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

ProgressCallback: TypeAlias = Callable[[float], None]
"""Called with the amount of work done since its last call, in the unit that the caller states."""


def no_progress(amount: float) -> None:
    """Report nothing."""


_listener: Callable[[str, str], None] | None = None
_place = ""


def listen(listener: Callable[[str, str], None] | None) -> None:
    """Call `listener` with every place that this process reaches, and with remarks; None stops the calls."""
    global _listener, _place
    _listener, _place = listener, ""


def announce(place: str, remark: str = "") -> None:
    """Say which hook of a method runs next, so that a process that dies in it can be explained.

    Args:
        place: The hook or the stage.
        remark: Text to show beside the place while it runs, such as the last success.
    """
    global _place
    _place = place
    if _listener is not None:
        _listener(place, remark)


def remark(text: str) -> None:
    """Show a text beside the place that the work has reached; an empty one removes it."""
    announce(_place, text)
