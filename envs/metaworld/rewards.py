"""The building blocks of Meta-World's rewards for many episodes at once, with the bits of a single one.

The sources are `metaworld/utils/reward_utils.py` and `metaworld/sawyer_xyz_env.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[np.float64]
"""One number per episode (N,), or one vector per episode (N, K)."""
Floats: TypeAlias = NDArray[Any]
"""Numbers (N,) in single or in double precision."""

_LONG_TAIL_SCALE = np.sqrt(1 / 0.1 - 1)
_GAUSSIAN_SCALE = np.sqrt(-2 * np.log(0.1))


def norm(vectors: Vector) -> Vector:
    """Return the lengths (N,) of vectors (N, K).

    `np.linalg.norm` of one vector computes a dot product, as `vecdot` does. A sum of squares along an axis
    may differ in its bits.
    """
    length: Vector = np.sqrt(np.vecdot(vectors, vectors))
    return length


def magnitude(numbers: Vector) -> Vector:
    """Return the magnitudes (N,) of numbers (N,), where Meta-World takes the norm of a number."""
    length: Vector = np.sqrt(numbers * numbers)
    return length


def _square(numbers: Vector) -> Vector:
    """Return the squares with the bits of Meta-World's `**` of one number.

    For one number, `**` calls the C library's pow, whose last bit differs from a product once in a thousand
    times. `float_power` also calls pow, while `**` of an array multiplies.
    """
    squares: Vector = np.float_power(numbers, 2.0)
    return squares


def long_tail(distances: Vector) -> Vector:
    """Map distances in margins to rewards: 0 to 1, 1 to 0.1, and a slow decrease beyond."""
    return 1 / (_square(distances * _LONG_TAIL_SCALE) + 1)


def gaussian(distances: Vector) -> Vector:
    """Map distances in margins to rewards: 0 to 1, 1 to 0.1, and a fast decrease beyond."""
    value: Vector = np.exp(-0.5 * _square(distances * _GAUSSIAN_SCALE))
    return value


def near(
    distances: Vector, radius: float, margin: Vector | float, sigmoid: Callable[[Vector], Vector] = long_tail
) -> Vector:
    """Return 1 where a distance is within a radius, and less beyond it, depending on the margin.

    It equals Meta-World's `tolerance` with 0 as the lower bound, as no distance is negative.
    """
    value: Vector = np.where(distances <= radius, 1.0, sigmoid((distances - radius) / margin))
    return value


def between(numbers: Vector, low: float, high: float, margin: Vector) -> Vector:
    """Return 1 where a number is from `low` to `high`, and less outside, depending on the margin."""
    outside = np.where(numbers < low, low - numbers, numbers - high) / margin
    value: Vector = np.where((low <= numbers) & (numbers <= high), 1.0, long_tail(outside))
    return value


def hamacher(first: Floats, second: Floats) -> Floats:
    """Return the Hamacher product of numbers from 0 to 1, which is high only if both are."""
    product = first * second
    denominator = first + second - product
    value: Floats = np.divide(product, denominator, out=np.zeros_like(product), where=denominator > 0)
    return value


@dataclass(frozen=True)
class Mixed:
    """Numbers with mixed precision, as Meta-World derives them from the action of the fingers.

    An action has single precision, and keeps it when Python numbers are added or multiplied. If it is clipped
    to 0 or to the largest effort, it becomes a Python number itself, and everything derived from it has
    double precision.
    """

    numbers: Vector
    """The numbers (N,)."""
    single: NDArray[np.bool_]
    """Mask of the numbers with single precision (N,)."""

    def into(self, formula: Callable[..., Floats], *others: Vector) -> Mixed:
        """Apply a formula to these numbers and others (N,), which are Python numbers in Meta-World."""
        numbers = formula(self.numbers, *others)
        if self.single.any():
            rounded = (part.astype(np.float32) for part in (self.numbers, *others))
            numbers = np.where(self.single, formula(*rounded), numbers)
        return Mixed(numbers, self.single)


def closed(fingers: NDArray[np.float32], effort: float, counts: NDArray[np.bool_] | bool) -> Mixed:
    """Return the share of an effort by which actions (N,) close the fingers; 0 where it does not count."""
    wished = (fingers > 0) & counts
    share = np.where(wished, np.minimum(fingers, effort) / effort, 0.0)
    return Mixed(share.astype(np.float64), wished & (fingers <= np.float32(effort)))
