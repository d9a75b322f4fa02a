"""What Meta-World's rewards are made of, over many episodes at once, bit for bit what it computes for one.

The sources are `metaworld/utils/reward_utils.py` and `metaworld/sawyer_xyz_env.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[np.float64]
"""A number of each episode (N,), or a vector of each (N, K)."""
Floats: TypeAlias = NDArray[Any]
"""Numbers (N,) in single or in double precision."""

_LONG_TAIL_SCALE = np.sqrt(1 / 0.1 - 1)
_GAUSSIAN_SCALE = np.sqrt(-2 * np.log(0.1))


def norm(vectors: Vector) -> Vector:
    """Return the lengths (N,) of vectors (N, K).

    `np.linalg.norm` of one vector takes its dot product, and so does `vecdot`. A sum of squares along an axis
    need not have the same bits.
    """
    length: Vector = np.sqrt(np.vecdot(vectors, vectors))
    return length


def magnitude(numbers: Vector) -> Vector:
    """Return the lengths (N,) of numbers (N,), where Meta-World takes the norm of a number."""
    length: Vector = np.sqrt(numbers * numbers)
    return length


def _square(numbers: Vector) -> Vector:
    """Return the squares as Meta-World has them, from `**` of one number.

    That calls the C library's pow, which differs in the last bit from a product once in a thousand times.
    `float_power` calls it too, while `**` of an array multiplies.
    """
    squares: Vector = np.float_power(numbers, 2.0)
    return squares


def long_tail(distances: Vector) -> Vector:
    """Return 1 where a distance, in margins, is 0; 0.1 where it is 1; and less farther out, slowly."""
    return 1 / (_square(distances * _LONG_TAIL_SCALE) + 1)


def gaussian(distances: Vector) -> Vector:
    """Return 1 where a distance, in margins, is 0; 0.1 where it is 1; and less farther out, fast."""
    value: Vector = np.exp(-0.5 * _square(distances * _GAUSSIAN_SCALE))
    return value


def near(
    distances: Vector, radius: float, margin: Vector | float, sigmoid: Callable[[Vector], Vector] = long_tail
) -> Vector:
    """Return 1 where a distance is within a radius, and less the more margins it is beyond.

    It is Meta-World's `tolerance` with bounds from 0, below which no distance is.
    """
    value: Vector = np.where(distances <= radius, 1.0, sigmoid((distances - radius) / margin))
    return value


def between(numbers: Vector, low: float, high: float, margin: Vector) -> Vector:
    """Return 1 where a number is from `low` to `high`, and less the more margins it is outside."""
    outside = np.where(numbers < low, low - numbers, numbers - high) / margin
    value: Vector = np.where((low <= numbers) & (numbers <= high), 1.0, long_tail(outside))
    return value


def hamacher(first: Floats, second: Floats) -> Floats:
    """Return the Hamacher product of numbers from 0 to 1: both must be high for it to be high."""
    product = first * second
    denominator = first + second - product
    value: Floats = np.divide(product, denominator, out=np.zeros_like(product), where=denominator > 0)
    return value


@dataclass(frozen=True)
class Mixed:
    """Numbers of which some are in single precision, as in Meta-World what follows from the fingers' action.

    An action has single precision, and keeps it where numbers of Python are added or multiplied. Where it is
    cut to 0 or to the greatest effort it has become such a number, and what follows has double precision.
    """

    numbers: Vector
    """The numbers (N,)."""
    single: NDArray[np.bool_]
    """Which of them are in single precision (N,)."""

    def into(self, formula: Callable[..., Floats], *others: Vector) -> Mixed:
        """Return a formula of these numbers and others (N,), which in Meta-World are Python's."""
        numbers = formula(self.numbers, *others)
        if self.single.any():
            rounded = (part.astype(np.float32) for part in (self.numbers, *others))
            numbers = np.where(self.single, formula(*rounded), numbers)
        return Mixed(numbers, self.single)


def closed(fingers: NDArray[np.float32], effort: float, counts: NDArray[np.bool_] | bool) -> Mixed:
    """Return how far the actions of the fingers (N,) close them, as a share; 0 where that does not count."""
    wished = (fingers > 0) & counts
    share = np.where(wished, np.minimum(fingers, effort) / effort, 0.0)
    return Mixed(share.astype(np.float64), wished & (fingers <= np.float32(effort)))
