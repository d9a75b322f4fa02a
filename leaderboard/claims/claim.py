"""What a claim is: words of a paper, and a rule that judges them from records.

A new claim is one function with the decorator `claim`; the page, the table and the tests find it by itself.
Its docstring is the claim in our words. A comparison with a missing figure is never true, so that what is
missing makes a claim "cannot be told".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from .evidence import Evidence, Figure

Verdict = Literal["holds", "does not hold", "cannot be told"]


@dataclass(frozen=True)
class Paper:
    """Where claims come from."""

    name: str
    """Of its method."""
    arxiv: tuple[str, ...]
    """Identifiers."""


@dataclass(frozen=True)
class Finding:
    """What the records say to a claim."""

    verdict: Verdict
    """By the claim's rule."""
    figures: tuple[Figure, ...] = ()
    """What was measured; the first one stands for all in short tables."""
    controls: tuple[Figure, ...] = ()
    """The same of what could explain it."""
    sentences: tuple[str, ...] = ()
    """What follows from the figures."""
    about: tuple[str, ...] = ()
    """Methods that it is about, besides the first of each figure."""
    missing: tuple[str, ...] = ()
    """What no record can tell yet, in words."""


@dataclass(frozen=True)
class Claim:
    """A claim of a paper, with the rule that judges it."""

    id: str
    """As C1."""
    paper: Paper
    """Where it comes from."""
    words: str
    """The claim in our words."""
    reported: str
    """The paper's figure."""
    rule: str
    """When it holds and when it does not; otherwise it cannot be told."""
    judge: Callable[[Evidence], Finding]
    """The rule."""


CLAIMS: dict[str, Claim] = {}
"""All claims by id, in the order of the page."""


def claim(
    identifier: str, paper: Paper, *, reported: str, rule: str
) -> Callable[[Callable[[Evidence], Finding]], Callable[[Evidence], Finding]]:
    """Return a decorator that enters a function as the judge of a claim; its docstring is the claim."""

    def enter(judge: Callable[[Evidence], Finding]) -> Callable[[Evidence], Finding]:
        words = " ".join((judge.__doc__ or "").split())
        CLAIMS[identifier] = Claim(identifier, paper, words, reported, rule, judge)
        return judge

    return enter


# ---- what rules are made of --------------------------------------------------------------------------------


def decided(*, holds: bool, fails: bool) -> Verdict:
    """Return the verdict of a rule."""
    return "holds" if holds else "does not hold" if fails else "cannot be told"


def either(
    figures: Sequence[Figure], *, holds: Callable[[Figure], bool], fails: Callable[[Figure], bool]
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict of a claim that holds for any of the figures, and the sentence that says which."""
    holding = [figure.methods[0] for figure in figures if holds(figure)]
    verdict = decided(holds=bool(holding), fails=all(map(fails, figures)))
    return verdict, (f"It holds for {' and '.join(holding)}.",) if holding else ()


def compared(control: Figure, method: Figure, *, does_as_well: str) -> str:
    """Return the sentence that a control gives to the figure that it is to explain; higher is better."""
    name, subject = control.methods[0], method.methods[0]
    if math.isnan(control.high) or math.isnan(method.low):
        return f"Whether {name} does the same as {subject} cannot be told."
    if control.high >= method.low:
        return f"{name} does the same as {subject}: {does_as_well}."
    return f"{name} does not reach {subject}: that does not explain it."


def compared_gains(control: Figure, method: Figure, *, does_as_well: str) -> str:
    """Return the same where the figures are gains over sft, and there may be none to explain."""
    if method.low <= 0:
        return f"{method.methods[0]} has no certain gain over sft that {control.methods[0]} could explain."
    return compared(control, method, does_as_well=does_as_well)
