"""The expected width of intervals, before a run."""

from __future__ import annotations

import math

from clbench.scoring.intervals import MANY, student_quantile
from clbench.spec.scenario import Scenario

SEED_DEVIATION = 0.1
"""Standard deviation of a success rate between seeds, assumed where none is measured.
`docs/guide/statistics.md` has the values measured in the committed records."""


def half_width(seeds: int, episodes: int, tasks: int, *, seed_deviation: float = SEED_DEVIATION) -> float:
    """Return half of the expected width of the interval of a mean success rate.

    The rate is assumed to be one half, the worst case. With one seed the interval covers only its episodes.

    Args:
        seeds: Number of seeds.
        episodes: Scored episodes of a task.
        tasks: Number of tasks in the mean.
        seed_deviation: Standard deviation of the rate between seeds.
    """
    of_seeds = seed_deviation**2 if seeds > 1 else 0.0
    error = math.sqrt((of_seeds + 0.25 / (episodes * tasks)) / seeds)
    reach = _quantile(seeds) * error
    return reach / math.sqrt(1 + 4 * reach**2)  # `interval_of_seeds` at one half


def episodes_needed(
    wished: float, seeds: int, tasks: int, *, seed_deviation: float = SEED_DEVIATION
) -> int | None:
    """Return the number of episodes per task with which `half_width` is as `wished`.

    Args:
        wished: Half of the width of the interval, above 0.
        seeds: Number of seeds.
        tasks: Number of tasks in the mean.
        seed_deviation: Standard deviation of the rate between seeds.

    Returns:
        The number, or None if no number of episodes is enough: more seeds are needed.
    """
    if wished >= 0.5:
        return 1  # half of any interval
    of_seeds = seed_deviation**2 if seeds > 1 else 0.0
    error = wished / math.sqrt(1 - 4 * wished**2) / _quantile(seeds)
    of_episodes = seeds * error**2 - of_seeds
    # The margin keeps a number that gives the half-width exactly from being rounded up.
    return math.ceil(0.25 / (tasks * of_episodes) - 1e-6) if of_episodes > 0 else None


def _quantile(seeds: int) -> float:
    return student_quantile(seeds - 1 if seeds > 1 else MANY)


def expected_precision(scenario: Scenario, seeds: int) -> str:
    """Return a sentence about the expected width of the intervals of a run of `scenario`."""
    episodes = scenario.budget.test_episodes
    retained, target = len(scenario.retained), len(scenario.target)
    counts = {"retention": retained, "adaptation": target, "final average": retained + target}
    widths = {name: half_width(seeds, episodes, tasks) for name, tasks in counts.items() if tasks}
    parts = ", ".join(f"± {width:.2f} for {name}" for name, width in widths.items())
    what, end = (f"{seeds} seeds", "") if seeds > 1 else ("1 seed", ", for this seed alone")
    expected = f"expect 95 % intervals of about {parts}, at rates near one half{end}"
    return f"{what} x {episodes} episodes: {expected}."
