"""The two arms of ConSFT, and whether their weights differ between samples: an arm counts only if they do."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from .claim import (
    Finding,
    Verdict,
    best_first,
    cannot_be_shown,
    decided,
    deciding,
    what_would_change,
)
from .evidence import Evidence, Figure
from .figures import share_afterwards, share_between

ARMS = ("consft", "consft_calibrated")
"""The published loss with a tuned first temperature; the same with a tuned factor of the loss."""

LEAST_BETWEEN = 0.1
"""Least share of the weights between 0.01 and 0.9, before the last tenth of the schedule, with which an arm
counts. Below it, most samples of most steps weigh alike: almost nothing, which Adam nearly cancels, or 1. The
paper asks for no such share."""

NEEDS_WEIGHTS = "Weights that differ between samples while the temperature is low."
"""What would change a verdict without an arm that counts."""


def _counts(share: Figure) -> bool:
    """Return whether an arm with this share has weights that differ between samples; an unknown one may."""
    return math.isnan(share.value) or share.value >= LEAST_BETWEEN


def arms_that_count(evidence: Evidence) -> tuple[str, ...]:
    """Return the arms that count: those whose weights differ between samples."""
    return tuple(arm for arm in ARMS if _counts(share_between(evidence, arm)))


def inactive_sentences(evidence: Evidence) -> tuple[str, ...]:
    """Return a sentence for each arm that does not count."""
    shares = ((arm, share_between(evidence, arm)) for arm in ARMS)
    return tuple(
        f"Before the last tenth of its schedule, {share.value:.1%} of the weights of {arm} lie between 0.01 "
        "and 0.9: most samples have nearly the same weight, so its figures do not "
        f"count.{_afterwards(evidence, arm)}"
        for arm, share in shares
        if not _counts(share)
    )


def inactive_reasons(evidence: Evidence, counting: Sequence[str]) -> list[tuple[str, str]]:
    """Return these sentences as reasons for `cannot_be_shown`; they are reasons only if no arm counts."""
    return [(why, "" if counting else NEEDS_WEIGHTS) for why in inactive_sentences(evidence)]


def _afterwards(evidence: Evidence, arm: str) -> str:
    """Return how much of the training the rule on weights leaves out: a stage may outlast the schedule."""
    later = share_afterwards(evidence, arm)
    if math.isnan(later.value):
        return ""
    between = share_between(evidence, arm, afterwards=True)
    return (
        f" This leaves out the last tenth and what follows, which have {later.value:.0%} of its weights; "
        f"{between.value:.0%} of these lie between 0.01 and 0.9."
    )


def rises_above(bar: float, counting: Iterable[Figure], every: Iterable[Figure]) -> Verdict:
    """Return the verdict of a bar: an arm that counts must certainly be above it, or all arms below it."""
    return decided(holds=any(one.low > bar for one in counting), fails=all(one.high < bar for one in every))


def change_of_arms(verdict: Verdict, counting: Sequence[Figure], every: Sequence[Figure], bar: float) -> str:
    """Return what would change the verdict of a bar on the arms: only a counting arm makes a claim hold."""
    if verdict != "undecided":
        judged = best_first(list(every if verdict == "does not hold" else counting))
        return what_would_change(deciding(verdict, judged, bar), bar)
    if may_rise := [figure for figure in best_first(counting) if not figure.high < bar]:
        # all must fall below the bar, if not one rises above it: the one that needs the most seeds decides
        falls = all(figure.value < bar for figure in may_rise)
        slowest = max(may_rise, key=lambda one: (one.high - one.value) / (bar - one.value)) if falls else None
        return what_would_change(slowest or may_rise[0], bar)
    above = next(figure for figure in every if not figure.high < bar)  # it keeps the claim from failing
    return (
        f'An interval of "{above.what}" that lies below {bar:{above.form}}: its arm does not count, but it '
        "keeps the claim from failing."
    )


def if_all_counted(arms: Sequence[str], verdict: Verdict, of_all: Verdict) -> tuple[str, ...]:
    """Return what the verdict would be if the arms that do not count did; empty if all count.

    Args:
        arms: Arms that count.
        verdict: Verdict of the rule.
        of_all: Verdict of the rule on all arms.
    """
    others = " and ".join(arm for arm in ARMS if arm not in arms)
    if not others:
        return ()
    if of_all == verdict:
        return (f"If {others} counted, the verdict would be the same.",)
    return (f'If {others} counted, the verdict would be "{of_all}".',)


def without_an_arm(
    evidence: Evidence,
    figures: Sequence[Figure],
    controls: Sequence[Figure],
    of_all: Verdict | None,
    *reasons: tuple[str, str],
) -> Finding:
    """Return the finding on a board on which no arm counts.

    Args:
        evidence: Records of the board.
        figures: Figures of all arms.
        controls: Other figures.
        of_all: Verdict if all arms counted; None if it is not told.
        reasons: Further reasons, as in `cannot_be_shown`.
    """
    shares = tuple(one(evidence, arm) for arm in ARMS for one in (share_between, share_afterwards))
    return cannot_be_shown(
        best_first(figures),
        (*controls, *shares),
        [*inactive_reasons(evidence, ()), *reasons],
        *(if_all_counted((), "cannot be shown here", of_all) if of_all is not None else ()),
        about=ARMS,
    )
