"""Sentences of the findings on smaller learning rates: what they keep, without any method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from clbench.base.text import counted
from clbench.spec.references import BASELINE, FROZEN

from ..board.frontier import Curve, Rung
from ..board.rows import Row
from ..board.summary import WITHOUT_DEMONSTRATIONS
from ..claims.evidence import Evidence, rung
from ..views.format import format_interval, rate_text

Curves = Mapping[str, Sequence[Curve]]


def rate_sentences(
    frontiers: Curves, boards: Mapping[str, Sequence[Row]], evidence: Callable[[str], Evidence]
) -> Iterator[str]:
    """Yield what plain fine-tuning and other methods keep at the rates of the ladder.

    Args:
        frontiers: Curves of each scenario with a ladder.
        boards: Rows of each scenario with the default policy.
        evidence: Returns the runs of the scenario with a Gymnasium id, those of the ladder included.
    """
    for name, curves in frontiers.items():
        found = evidence(name)
        for curve in curves:
            if curve.is_baseline:
                yield _of_the_baseline(name, curve, found)
                yield from _at_the_first_rung(name, curve, curves, found)
                yield from _of_frozen(name, curve, boards.get(name, []), found)


def rate_lines(frontiers: Curves) -> Iterator[tuple[str, ...]]:
    """Yield the cells of the table: scenario, method, factor, learned, kept and the number of seeds."""
    for name, curves in frontiers.items():
        for curve in curves:
            for one in curve.rungs:
                learned, kept = format_interval(one.learned), format_interval(one.kept)
                yield name, curve.method, f"{one.factor:g}", learned, kept, str(len(one.seeds))


def _of_the_baseline(name: str, curve: Curve, evidence: Evidence) -> str:
    """Return what plain fine-tuning keeps at the first rung, and at the one where it keeps most."""
    first, best = curve.rungs[0], _best(curve)
    more = ""
    if best is not first:
        more = (
            f", and {format_interval(best.kept)} at {rate_text(best.factor)}, where it learns "
            f"{format_interval(best.learned)}"
        )
        more += f". {_gain_of_a_rate(first, best, len(curve.rungs), evidence)}"
    kept = format_interval(first.kept)
    return f"On {name}, plain fine-tuning keeps {kept} at {rate_text(first.factor)}{more}."


def _gain_of_a_rate(first: Rung, best: Rung, rates: int, evidence: Evidence) -> str:
    """Return what the rate that keeps most gains over the first one, seed by seed."""
    gain = evidence.difference("kept", *(rung(BASELINE, one.factor) for one in (best, first))).estimate
    certain = "" if gain.is_above(0) else ", which is not certain"
    return (
        f"The difference, seed by seed, is {format_interval(gain)}{certain}; it is biased upwards, because "
        f"this rate was chosen as the best of {rates} on the same episodes"
    )


def _at_the_first_rung(
    name: str, baseline: Curve, curves: Sequence[Curve], evidence: Evidence
) -> Iterator[str]:
    """Yield what the methods without prior demonstrations keep at the learning rate of the first rung.

    The one that keeps most is compared with plain fine-tuning there, and at its best rate.
    """
    factor = baseline.rungs[0].factor
    kept = {
        curve.method: curve.rungs[0].kept
        for curve in curves
        if curve.division in WITHOUT_DEMONSTRATIONS
        and curve is not baseline
        and curve.rungs[0].factor == factor
    }
    if kept:
        falling = sorted(kept, key=lambda method: -(kept[method].value or 0.0))
        listed = ", ".join(f"`{method}` {format_interval(kept[method])}" for method in falling)
        best = _best(baseline)
        over = [
            f"{_kept_more(evidence, rung(falling[0], factor), rung(BASELINE, other))} more than plain "
            f"fine-tuning at {rate_text(other)}"
            for other in dict.fromkeys((factor, best.factor))
        ]
        yield (
            f"On {name}, this is what methods without prior demonstrations keep at {rate_text(factor)}: "
            f"{listed}. The first of them, `{falling[0]}`, keeps {' and '.join(over)}. This method, the best "
            f"of {len(falling)}, and the rate of plain fine-tuning were both chosen on the same episodes."
        )


def _best(curve: Curve) -> Rung:
    """Return the rung at which a method keeps most."""
    return max(curve.rungs, key=lambda one: one.kept.value or 0.0)


def _kept_more(evidence: Evidence, method: str, other: str) -> str:
    """Return how much more a method keeps than another, seed by seed."""
    return format_interval(evidence.difference("kept", method, other).estimate)


def _of_frozen(name: str, baseline: Curve, rows: Sequence[Row], evidence: Evidence) -> Iterator[str]:
    """Yield what a policy that learns nothing keeps by this measure, and whether fine-tuning keeps more."""
    for row in rows:
        if row.method == FROZEN:
            best = _best(baseline)
            more = evidence.difference("kept", rung(BASELINE, best.factor), FROZEN)
            yield (
                f"On {name}, `{FROZEN}`, which learns nothing, keeps "
                f"{format_interval(row.estimates['kept'])} by this measure: a target that was never learned "
                f"counts as not kept. Plain fine-tuning at {rate_text(best.factor)}, chosen as above, keeps "
                f"{format_interval(more.estimate)} more ({counted(len(more.seeds), 'seed')}, seed by seed)."
            )
