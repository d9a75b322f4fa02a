"""Measurements that take turns, and ratios of them with their interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from rich.progress import track


def take_turns(
    measurements: Mapping[str, Callable[[int], float]],
    rounds: int,
    generator: np.random.Generator,
    description: str = "rounds",
) -> list[dict[str, float]]:
    """Return what was measured in each round, by name.

    The order is new in each round, so that other work on the machine affects all alike. An extra round comes
    first as a warm-up and does not count.

    Args:
        measurements: Functions that measure something, given the number of the round.
        rounds: Number of rounds that count.
        generator: Source of the orders.
        description: Text of the progress bar.
    """
    taken = []
    for number in track(range(rounds + 1), description):
        order = generator.permutation(list(measurements)).tolist()
        taken.append({name: measurements[name](number) for name in order})
    return taken[1:]


def median_ratio(ratios: Sequence[float], generator: np.random.Generator) -> dict[str, float]:
    """Return the median of ratios, one per round, with its 95 % bootstrap interval.

    With fewer than six rounds the interval contains less than 95 %: even the range from the lowest to the
    highest of n ratios misses the true median with the probability 2^(1 - n).
    """
    drawn = np.median(generator.choice(ratios, size=(2000, len(ratios))), axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    values = {"median_ratio": float(np.median(ratios)), "low": float(low), "high": float(high)}
    return {name: round(value, 3) for name, value in values.items()}
