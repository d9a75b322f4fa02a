"""All claims, judged from the records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from . import aegis, consft, consft_targets, fast_dvla
from .claim import Claim, Finding
from .evidence import Evidence

CLAIMS: dict[str, Claim] = {
    one.id: one
    for module in (consft, consft_targets, aegis, fast_dvla)
    for one in vars(module).values()
    if isinstance(one, Claim)
}
"""All claims by id, in the order of the page."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A claim with the finding on one scenario."""

    claim: Claim
    """The claim."""
    evidence: Evidence
    """Records of the scenario."""
    finding: Finding
    """What they show."""


def judge_all(read: Callable[[str], Evidence], scenario: str | None = None) -> tuple[Judged, ...]:
    """Return the findings on all claims.

    Args:
        read: Returns the evidence of the scenario with a Gymnasium id.
        scenario: The only scenario on which claims are judged; each claim names its own if None.
    """
    evidence = cache(read)
    return tuple(
        Judged(one, evidence(name), one.judge(evidence(name)))
        for one in CLAIMS.values()
        for name in ((scenario,) if scenario else one.scenarios)
    )
