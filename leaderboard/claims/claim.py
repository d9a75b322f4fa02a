"""A claim: the words of a paper, and a rule that judges them from records.

A new claim is one function with the decorator `claim` in the module of its paper; its docstring is the claim
in our words. A comparison with a missing figure is never true, so a missing figure leaves a claim
undecided.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from .evidence import Evidence, Figure

Verdict = Literal["holds", "does not hold", "undecided"]


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
    about: tuple[str, ...] = ()
    """Methods of the claim, besides the first method of each figure."""
    missing: tuple[str, ...] = ()
    """What no record can show yet, in words."""


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
    """When the claim holds and when it does not; in all other cases it is undecided."""
    judge: Callable[[Evidence], Finding]
    """Function that applies the rule."""


def claim(
    identifier: str, paper: Paper, *, reported: str, rule: str
) -> Callable[[Callable[[Evidence], Finding]], Claim]:
    """Return a decorator that makes a claim of the function that judges it; its docstring is the claim."""

    def enter(judge: Callable[[Evidence], Finding]) -> Claim:
        words = " ".join((judge.__doc__ or "").split())
        return Claim(identifier, paper, words, reported, rule, judge)

    return enter


# ---- parts of rules ----------------------------------------------------------------------------------------


def decided(*, holds: bool, fails: bool) -> Verdict:
    """Return the verdict of a rule."""
    return "holds" if holds else "does not hold" if fails else "undecided"


def either(
    figures: Sequence[Figure], *, holds: Callable[[Figure], bool], fails: Callable[[Figure], bool]
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict of a claim that holds for any of the figures, and the sentence that names which."""
    holding = [figure.methods[0] for figure in figures if holds(figure)]
    verdict = decided(holds=bool(holding), fails=all(map(fails, figures)))
    return verdict, (f"It holds for {' and '.join(holding)}.",) if holding else ()


def compared(control: Figure, method: Figure, *, does_as_well: str) -> str:
    """Return the sentence that compares a control with a method's figure; higher is better."""
    name, subject = control.methods[0], method.methods[0]
    if math.isnan(control.high) or math.isnan(method.low):
        return f"The records cannot show whether {name} does as well as {subject}."
    if control.high >= method.low:
        return f"{name} does as well as {subject}: {does_as_well}."
    return f"{name} does not reach {subject}, so it does not explain the result."


def compared_gains(control: Figure, method: Figure, *, does_as_well: str) -> str:
    """Return the same sentence for gains over sft, where there may be no gain to explain."""
    if method.low <= 0:
        return f"{method.methods[0]} has no certain gain over sft that {control.methods[0]} could explain."
    return compared(control, method, does_as_well=does_as_well)
