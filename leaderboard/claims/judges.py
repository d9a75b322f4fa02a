"""All claims, judged by the records."""

from __future__ import annotations

from . import aegis, consft, fast_dvla
from .claim import Claim, Finding
from .evidence import Evidence

CLAIMS: dict[str, Claim] = {
    one.id: one
    for paper in (consft, aegis, fast_dvla)
    for one in vars(paper).values()
    if isinstance(one, Claim)
}
"""All claims by id, in the order of the page."""


def judge_all(evidence: Evidence) -> dict[str, Finding]:
    """Return the finding of every claim by id."""
    return {identifier: one.judge(evidence) for identifier, one in CLAIMS.items()}
