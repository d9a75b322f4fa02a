"""Certainty of gains: the test that tells methods apart from plain fine-tuning, at its tied settings too.

Tuning may rate several settings of plain fine-tuning as highly as the one that it chose. A gain over the
chosen one alone may then come from the order in which tuning tried them. The ladder has runs at the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clbench.runs.tuning import rated_best, tuned
from clbench.scoring.groups import groups
from clbench.scoring.intervals import Estimate, Runs, estimate, row_generator
from clbench.spec.references import BASELINE

from .frontier import FACTOR
from .runs import Run
from .summary import GAIN, RANKED_BY, WITH_DEMONSTRATIONS, WITHOUT_DEMONSTRATIONS

if TYPE_CHECKING:
    from .rows import Row


@dataclass(frozen=True)
class TiedGain:
    """Gain of a method over plain fine-tuning at a setting that tuning rated as highly as the chosen one."""

    factor: float
    """Step factor of plain fine-tuning."""
    gain: Estimate
    """Difference in final average, over the common seeds; missing if there are none."""
    seeds: int
    """Number of common seeds."""

    @property
    def is_certain(self) -> bool:
        """Whether the interval is above 0."""
        return self.gain.is_above(0)


def side_of_zero(gain: Estimate, tied: Iterable[TiedGain]) -> int:
    """Return where the intervals of a gain lie: 1 above 0, -1 below it, 0 if one of them contains it.

    Args:
        gain: Gain over plain fine-tuning at the setting that tuning chose.
        tied: The gains over the settings that tuning rated as highly.
    """
    gains = [gain, *(one.gain for one in tied)]
    if all(one.is_above(0) for one in gains):
        return 1
    return -1 if all(one.is_below(0) for one in gains) else 0


def sides_of_gains(rows: Iterable[Row], tied: Mapping[str, Iterable[TiedGain]]) -> dict[str, int]:
    """Return the methods of a scenario that are told apart from plain fine-tuning, and where their gains lie.

    Each method is tested together with plain fine-tuning and all methods with the same access: those that may
    read prior demonstrations, or those that may not. The interval of one gain alone does not account for the
    number of methods that were compared. A row without a final average is told apart from none.

    Args:
        rows: The rows of a scenario.
        tied: Gains over settings of plain fine-tuning that tuning rated as highly as the chosen one, by
            method.

    Returns:
        The side of 0 by method, see `side_of_zero`: a method certainly ends above plain fine-tuning if it is
        1, and certainly below it if it is -1.
    """
    members = list(rows)
    apart: set[str] = set()
    for divisions in (WITHOUT_DEMONSTRATIONS, WITH_DEMONSTRATIONS):
        family = [row for row in members if row.method == BASELINE or row.division in divisions]
        letters = groups(RANKED_BY, {row.method: row.scores for row in family})
        if BASELINE in letters:
            own = set(letters[BASELINE])
            apart |= {method for method, others in letters.items() if not own & set(others)}
    return {
        row.method: side_of_zero(row.estimates[GAIN], tied.get(row.method, ()))
        for row in members
        if row.method in apart
    }


def tied_gains(
    scenario: str, methods: Mapping[str, Runs], ladder: Iterable[Run]
) -> dict[str, tuple[TiedGain, ...]]:
    """Return the gains of methods over plain fine-tuning at each tied setting, from runs of the ladder.

    Args:
        scenario: Name of the table: the scenario, with the policy if it is not the default one.
        methods: Scores by method and seed.
        ladder: Runs of the ladder, of any scenario and method.
    """
    found = tuned(scenario).get(BASELINE)
    factors = [one.settings[FACTOR] for one in rated_best(found.tried)[1:]] if found else []
    runs = [run for run in ladder if run.table == scenario and run.record.run.method == BASELINE]
    tied = {
        factor: {run.seed: run.scores for run in runs if run.record.run.changes == {FACTOR: factor}}
        for factor in factors
    }
    return {
        method: tuple(_gain(scenario, method, scores, factor, tied[factor]) for factor in factors)
        for method, scores in methods.items()
    }


def _gain(scenario: str, method: str, scores: Runs, factor: float, tied: Runs) -> TiedGain:
    common = {seed: scores[seed] for seed in sorted(tied.keys() & scores.keys())}
    generator = row_generator(scenario, f"{GAIN} of {method} at {factor:g}")
    gain = estimate((GAIN,), common, generator, references={BASELINE: tied})[GAIN]
    return TiedGain(factor, gain, len(common))
