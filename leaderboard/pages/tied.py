"""Plain fine-tuning at settings that tuning rated as high as the chosen one, and gains over it there."""

from __future__ import annotations

from collections.abc import Iterable

from clbench.records.paths import label_of
from clbench.runs.tuning import LEARNED, tuned
from clbench.spec.references import BASELINE

from ..board.frontier import FACTOR
from ..claims.evidence import Evidence, Figure


def tied_factors(scenario: str) -> tuple[float, ...]:
    """Return the step factors of plain fine-tuning that are not the chosen one and have its final average."""
    found = tuned(scenario).get(BASELINE)
    if found is None:
        return ()
    learners = [one for one in found.tried if one.learned >= LEARNED]
    best = max((one.final_average for one in learners), default=None)
    chosen = found.settings["step_factor"]
    factors = [one.settings["step_factor"] for one in learners if one.final_average == best]
    return tuple(factor for factor in factors if factor != chosen)


def gains_over_tied(evidence: Evidence, methods: Iterable[str]) -> dict[str, list[Figure]]:
    """Return the gain of each method over plain fine-tuning at each tied factor, from the controls."""
    tied = [label_of(BASELINE, {FACTOR: factor}) for factor in tied_factors(evidence.scenario)]
    return {
        method: [evidence.difference("final_average", method, label, form=".3f") for label in tied]
        for method in methods
    }
