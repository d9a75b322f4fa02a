"""Ratios of paired measurements, with their interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def median_ratio(ratios: Sequence[float], generator: np.random.Generator) -> dict[str, float]:
    """Return the median of ratios, one per round, with its 95 % bootstrap interval."""
    drawn = np.median(generator.choice(ratios, size=(2000, len(ratios))), axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    values = {"median_ratio": float(np.median(ratios)), "low": float(low), "high": float(high)}
    return {name: round(value, 3) for name, value in values.items()}
