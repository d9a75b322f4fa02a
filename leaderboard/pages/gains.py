"""Sentences and the table of the findings on gains over tuned fine-tuning."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from clbench.base.text import counted
from clbench.scoring.groups import differences_needed
from clbench.scoring.intervals import Estimate
from clbench.spec.references import BASELINE

from ..board.frontier import TiedGain, side_of_zero
from ..board.rows import Row, apart_from_baseline, certain_sides, told_above
from ..board.summary import RANKED_BY, WITHOUT_DEMONSTRATIONS, competing
from ..views.format import MISSING, format_interval, over_tied, rate_text

Tied = Mapping[str, Mapping[str, Sequence[TiedGain]]]
"""Gains over plain fine-tuning at tied settings by scenario and method: `Board.tied`."""


def by_gain(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of methods other than plain fine-tuning, by falling gain."""
    found = [row for row in competing(rows) if row.method != BASELINE]
    known = [row for row in found if row.estimates["gain"].value is not None]
    return sorted(known, key=lambda row: -(row.estimates["gain"].value or 0.0))


def gain_table(
    boards: Mapping[str, Sequence[Row]], tied: Tied
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Return the heads and the lines of the table: with a column for tied settings if there are any."""
    has_tied = any(gains for name in boards for gains in tied.get(name, {}).values())
    lines = []
    for name, rows in boards.items():
        for row in by_gain(rows):
            over = [format_interval(one.gain, ".3f") for one in tied.get(name, {}).get(row.method, ())]
            lines.append(
                (
                    name,
                    row.method,
                    format_interval(row.estimates["gain"], ".3f"),
                    *(["; ".join(over) or MISSING] if has_tied else []),
                    *(format_interval(row.estimates[one]) for one in ("adaptation", "kept")),
                    str(len(row.seeds)),
                )
            )
    over_a_tied = ("gain over the tied setting",) if has_tied else ()
    return ("scenario", "method", "gain", *over_a_tied, "learned", "kept", "seeds"), tuple(lines)


def gain_sentences(name: str, rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]]) -> Iterator[str]:
    """Yield what Tukey's test of all rows without prior demonstrations says about each gain.

    Args:
        name: Name of the scenario.
        rows: Its rows.
        tied: Gains over plain fine-tuning at tied settings, by method.
    """
    others = [row for row in by_gain(rows) if row.division in WITHOUT_DEMONSTRATIONS]
    if not others or BASELINE not in {row.method for row in rows}:
        return
    gains = {row.method: row.estimates["gain"] for row in others}
    apart = apart_from_baseline(rows)
    better = {row.method: row.estimates["gain"] for row in told_above(rows) if row.method in gains}
    sides = certain_sides(rows, tied)
    certain = {method: gain for method, gain in better.items() if sides.get(method) == 1}
    if certain:
        yield f"On {name}, yes: {_listed(certain)}."
    for method in better:
        yield from over_tied(name, f"`{method}`", gains[method], tied.get(method, ()))
    if not better:
        best = next(iter(gains))
        which = f"the gain of `{best}` is"
        if len(gains) > 1:
            which = f"the largest gain of {len(gains)} methods is that of `{best}`,"
        yield (
            f"On {name}, no method is above plain fine-tuning and told apart from it: {which} "
            f"{format_interval(gains[best], '.3f')}. {_power(rows, gains)}"
        )
    alone = "only by the interval of the gain itself"
    if len(gains) > 1:
        alone += f" (not corrected for {len(gains)} comparisons)"
    higher = {method: gain for method, gain in gains.items() if gain.is_above(0) and method not in better}
    over_both = {
        method: gain for method, gain in higher.items() if side_of_zero(gain, tied.get(method, ())) == 1
    }
    if over_both:
        yield f"On {name}, above plain fine-tuning {alone}: {_listed(over_both)}."
    if len(over_both) < len(higher):
        rest = {method: gain for method, gain in higher.items() if method not in over_both}
        yield f"On {name}, above only the setting that tuning chose for sft, and {alone}: {_listed(rest)}."
    losses = _losses(gains)
    worse = {method: loss for method, loss in losses.items() if method in apart}
    if worse:
        listed = f"{_listed(worse)}{_unlearned(rows, worse)}"
        yield f"On {name}, below plain fine-tuning and told apart from it: {listed}."
    if len(worse) < len(losses):
        rest = {method: loss for method, loss in losses.items() if method not in worse}
        yield f"On {name}, below plain fine-tuning {alone}: {_listed(rest)}."
    yield from _over_tied_settings(name, tied)


def _losses(gains: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the gains that are below 0 by their own intervals, with the other sign."""
    return {
        method: Estimate(-gain.value, -gain.high, -gain.low)
        for method, gain in gains.items()
        if gain.value is not None and gain.low is not None and gain.high is not None and gain.is_below(0)
    }


def _over_tied_settings(name: str, tied: Mapping[str, Sequence[TiedGain]]) -> Iterator[str]:
    """Yield how plain fine-tuning at a tied setting compares with the chosen one.

    Methods below it are not named: they, too, have tied settings, of which the board has only one.
    """
    for one in tied.get(BASELINE, ()):
        more = _losses({BASELINE: one.gain}).get(BASELINE)
        if more is not None:
            yield (
                f"On {name}, tuning rated plain fine-tuning at {rate_text(one.factor)} as highly as at the "
                f"chosen one. In the test episodes of {counted(one.seeds, 'seed')} it ends "
                f"{format_interval(more, '.3f')} higher than at the chosen one, so every gain on this board "
                "is smaller when it is measured over the tied setting."
            )


def _unlearned(rows: Iterable[Row], methods: Collection[str]) -> str:
    """Return the end of a sentence on methods some of whose stages ended without the criterion."""
    shares = {row.method: row.estimates["criterion_met"].value for row in rows if row.method in methods}
    told = [
        f"{1 - met:.0%} of the stages of `{method}` never met the criterion"
        for method, met in shares.items()
        if met is not None and met < 1
    ]
    return f"; {', '.join(told)}" if told else ""


def _power(rows: Iterable[Row], methods: Collection[str]) -> str:
    """Return the sentence on the differences that the test of these methods cannot show."""
    family = {row.method: row.scores for row in rows if row.method in methods or row.method == BASELINE}
    needed = differences_needed(RANKED_BY, family, BASELINE)
    if not needed or not math.isfinite(max(needed.values())):
        return ""
    ends = [f"{end:.3f}" for end in (min(needed.values()), max(needed.values()))]
    between = ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}, depending on the method"
    return f"To be told apart, a gain must exceed {between}."


def _listed(estimates: Mapping[str, Estimate]) -> str:
    return ", ".join(f"`{name}` by {format_interval(one, '.3f')}" for name, one in estimates.items())
