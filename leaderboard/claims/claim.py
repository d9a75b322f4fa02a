"""A claim: the words of a paper, and a rule that judges them from records.

A new claim is one function with the decorator `claim` in the module of its paper; its docstring is the claim
in our words. A comparison with a missing figure is never true, so a missing figure leaves a claim
undecided. A rule asks first whether the setting could have shown the claim; where it could not, no figure
counts for or against the paper.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from clbench.base.text import counted, listed
from clbench.scoring.intervals import student_quantile

from .evidence import Evidence, Figure

Verdict = Literal["holds", "holds in part", "does not hold", "undecided", "cannot be shown here"]

DECIDED: tuple[Verdict, ...] = ("holds", "holds in part", "does not hold")
"""Verdicts that are a yes or a no."""

PREDICATES: Mapping[Verdict, tuple[str, str]] = {
    "holds": ("holds", "hold"),
    "holds in part": ("holds in part", "hold in part"),
    "does not hold": ("does not hold", "do not hold"),
    "undecided": ("is undecided", "are undecided"),
    "cannot be shown here": ("cannot be shown here", "cannot be shown here"),
}
"""Verdicts as predicates: for one claim, and for several."""

BOARDS = ("clbench/Fetch-v1", "clbench/MetaWorld-v1", "clbench/PointMaze-v1")
"""Scenarios at equal learning, with runs at the scenario's learning rate and controls: most claims are judged
on them."""

WITH_LIBERO = (*BOARDS, "clbench/LiberoSpatial-v1")
"""The same, and the scenario nearest to ConSFT's own setting, without the controls of Fast-dVLA's claims."""

ANYWHERE = BOARDS[:1]
"""Scenario of the claims that do not depend on one, such as the time of a step."""

KNOWLEDGE = ("clbench/FetchKnowledge-v1",)
"""Scenario with one long stage, in which plain fine-tuning forgets answers to questions."""

MOST_SEEDS = 100
"""More seeds than this count as out of reach."""


@dataclass(frozen=True)
class Paper:
    """Source of claims."""

    name: str
    """Name of its method."""
    arxiv: tuple[str, ...]
    """Identifiers on arXiv."""


@dataclass(frozen=True)
class Finding:
    """What the records show about a claim."""

    verdict: Verdict
    """Verdict by the claim's rule."""
    figures: tuple[Figure, ...] = ()
    """Measured figures; short tables show the first one."""
    controls: tuple[Figure, ...] = ()
    """The same figures of methods that could explain the result."""
    sentences: tuple[str, ...] = ()
    """Conclusions from the figures."""
    change: str = ""
    """What would change the verdict."""
    about: tuple[str, ...] = ()
    """Methods of the claim, besides the first method of each figure."""


@dataclass(frozen=True)
class Claim:
    """A claim of a paper, with the rule that judges it."""

    id: str
    """Identifier on the page, for example "C1"."""
    paper: Paper
    """Paper that makes the claim."""
    words: str
    """The claim in our words."""
    reported: str
    """The paper's figure."""
    rule: str
    """When the claim holds, when it does not, and when the setting cannot show it; else it is undecided."""
    settled: datetime
    """When the rule last changed in what it says: older records were known by then."""
    margin: str
    """Smallest difference that counts."""
    scenarios: tuple[str, ...]
    """Gymnasium ids of the scenarios on which it is judged."""
    judge: Callable[[Evidence], Finding]
    """Function that applies the rule."""
    uncounted: str = ""
    """Why its verdicts are not counted with the paper's; empty if they are."""


def claim(
    identifier: str,
    paper: Paper,
    *,
    reported: str,
    rule: str,
    settled: str,
    margin: str,
    scenarios: tuple[str, ...] = BOARDS,
    uncounted: str = "",
) -> Callable[[Callable[[Evidence], Finding]], Claim]:
    """Return a decorator for the function that judges a claim; the docstring of the function is the claim."""

    def enter(judge: Callable[[Evidence], Finding]) -> Claim:
        words = " ".join((judge.__doc__ or "").split())
        since = datetime.fromisoformat(settled)
        return Claim(identifier, paper, words, reported, rule, since, margin, scenarios, judge, uncounted)

    return enter


# ---- parts of rules ----------------------------------------------------------------------------------------


def tally(verdicts: Iterable[Verdict]) -> str:
    """Return how often each verdict was given: '3 verdicts: 1 "holds" and 2 "undecided"'."""
    counts = Counter(verdicts)
    parts = [f'{counts[verdict]} "{verdict}"' for verdict in PREDICATES if counts[verdict]]
    return f"{counted(counts.total(), 'verdict')}: {listed(parts)}"


def decided(*, holds: bool, fails: bool, in_part: bool = False) -> Verdict:
    """Return the verdict of a rule on a setting that could show the claim."""
    return "holds" if holds else "holds in part" if in_part else "does not hold" if fails else "undecided"


def cannot_be_shown(
    figures: Sequence[Figure],
    controls: Sequence[Figure],
    reasons: Sequence[tuple[str, str]],
    *more: str,
    about: tuple[str, ...] = (),
) -> Finding:
    """Return the finding on a board that cannot show a claim.

    Args:
        figures: Figures of the rule.
        controls: Other figures.
        reasons: Why it cannot be shown, each with what would remove the reason; all reasons must be removed.
            The second text is empty for a sentence that gives no reason.
        more: Further sentences.
        about: See `Finding.about`.
    """
    why, changes = zip(*reasons, strict=True)
    change = " ".join(dict.fromkeys(filter(None, changes)))
    return Finding("cannot be shown here", tuple(figures), tuple(controls), (*why, *more), change, about)


def what_would_change(figure: Figure, bar: float) -> str:
    """Return the sentence that says how far the interval of the deciding figure is from the rule's bar."""
    interval = f'interval of "{figure.what}"'
    if figure.is_unknown:
        return f"Records that give an interval for this figure: {figure.what}."
    apart = max(figure.low - bar, bar - figure.high)
    form = figure.form
    if apart >= 0:
        return f"The {interval} would have to move by {apart:{form}} to reach {bar:{form}}."
    if len(figure.seeds) < 2:
        return f"A narrower {interval}: it contains {bar:{form}}."
    needed = _seeds_for(figure, bar)
    how_many = f"about {needed}" if needed else f"more than {MOST_SEEDS}"
    return f"At this spread, {how_many} seeds would be needed: the {interval} contains {bar:{form}}."


def deciding(verdict: Verdict, figures: Sequence[Figure], bar: float) -> Figure:
    """Return the figure that would first change the verdict of a rule on several figures.

    The rule holds if one figure is above the bar, and does not hold if all are below it.

    Args:
        verdict: Verdict of the rule.
        figures: Figures of the rule, the largest first: an undecided rule depends on it.
        bar: Bar of the rule.
    """
    known = [figure for figure in figures if not figure.is_unknown]
    if verdict == "does not hold":
        return max(known, key=lambda figure: figure.high)
    if verdict in ("holds", "holds in part"):
        return max(known, key=lambda figure: figure.low)
    return next((figure for figure in figures if is_open(figure, bar)), figures[0])


def is_open(figure: Figure, bar: float) -> bool:
    """Return whether an interval contains the bar, or is not known."""
    return not (figure.low >= bar or figure.high < bar)


def _seeds_for(figure: Figure, bar: float) -> int | None:
    """Return the number of seeds whose interval ends at the bar, None if too many.

    Args:
        figure: A figure of at least 2 seeds, whose interval contains the bar.
        bar: Bar of the rule.
    """
    seeds, nearer = len(figure.seeds), figure.low if bar < figure.value else figure.high
    wanted = _reach(figure, bar) / _reach(figure, nearer) * student_quantile(seeds - 1) / math.sqrt(seeds)
    enough = (
        count
        for count in range(seeds, MOST_SEEDS + 1)
        if student_quantile(count - 1) / math.sqrt(count) <= wanted * (1 + 1e-9)
    )
    return next(enough, None)


def _reach(figure: Figure, end: float) -> float:
    """Return what the quantile times the error is proportional to if the interval has this end.

    It is the distance from the value to the end, for a ratio on the logarithm. Between two bounds, as in
    `interval_of_seeds`, the error is smaller near a bound.
    """
    if figure.ratio and figure.low > 0:
        return abs(math.log(figure.value / end))
    low, high = figure.span
    room = (end - low) * (high - end)
    return abs(figure.value - end) / (math.sqrt(room) if 0 < room < math.inf else 1.0)


def not_told_apart(control: Figure, name: str = "", *, explains: str, does_not: str) -> str:
    """Return what a control says: the figure is the method's gain over the control, higher is better."""
    method, name = control.methods[0], name or control.methods[1]
    if control.is_unknown:
        return f"The records cannot show what {name} says about {method}."
    if control.low > 0:
        return f"{name} does not reach {method}: {does_not}."
    if control.high < 0:
        return f"{name} is even better than {method}: {explains}."
    return f"{name} is not told apart from {method}: {explains}."


def best_first(figures: Sequence[Figure]) -> tuple[Figure, ...]:
    """Return the figures with the largest value in front; missing values are never the largest."""
    best = max(figures, key=lambda one: -math.inf if math.isnan(one.value) else one.value)
    return (best, *(one for one in figures if one is not best))
