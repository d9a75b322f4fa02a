"""Callbacks that report progress."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

ProgressCallback: TypeAlias = Callable[[float], None]
"""Called with the amount of work done since its last call, in the unit that the caller states."""


def no_progress(amount: float) -> None:
    """Report nothing."""
