"""Checks of a method's hyper-parameters."""

import math
from collections.abc import Collection

from clbench.base.text import did_you_mean


def in_range(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Refuse a hyper-parameter outside its range, ends included.

    Raises:
        ValueError: `value` is outside the range, or not a finite number.
    """
    if not (low <= value <= high and math.isfinite(value)):
        allowed = f"from {low:g}" + (f" to {high:g}" if high < float("inf") else "")
        raise ValueError(f"{name} must be {allowed}, not {value}.")


def one_of(name: str, value: str, allowed: Collection[str]) -> None:
    """Refuse a hyper-parameter that is not one of the allowed words.

    Raises:
        ValueError: `value` is not one of them; the message names the nearest one.
    """
    if value not in allowed:
        hint = did_you_mean(value, allowed)
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, not {value!r}.{hint}")
