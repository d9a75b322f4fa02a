"""Section of the findings on smaller learning rates: what they keep, without any method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from clbench.base.text import counted
from clbench.scoring.intervals import Estimate
from clbench.spec.references import BASELINE, FROZEN

from ..board.frontier import Curve, Rung
from ..board.rows import Row
from ..board.summary import WITHOUT_DEMONSTRATIONS
from ..claims.evidence import Evidence, rung
from ..views.format import MISSING, format_over_seeds, rate_text
from ..views.sections import Section, Table, short

Curves = Mapping[str, Sequence[Curve]]

NOTES = (
    "The best rate and the best method were chosen on the same episodes. What a smaller rate gains is "
    "therefore biased upwards; the other differences may be biased either way. All are paired by seed. A "
    "difference counts every seed that its two sides share, even if other runs of the ladder lack it.",
    f"`{FROZEN}` learns nothing. A target that was never learned counts as not kept.",
    "Factors multiply the scenario's learning rate. The leaderboard has all of them, with intervals.",
)


def rates_section(
    frontiers: Curves, boards: Mapping[str, Sequence[Row]], evidence: Callable[[str], Evidence]
) -> Section:
    """Return what plain fine-tuning and other methods keep at the rates of the ladder.

    Args:
        frontiers: Curves of each scenario with a ladder.
        boards: Rows of each scenario with the default policy.
        evidence: Returns the runs of the scenario with a Gymnasium id, those of the ladder included.
    """
    found = [
        _Ladder(name, curve, curves, boards.get(name, ()), evidence(name))
        for name, curves in frontiers.items()
        for curve in curves
        if curve.is_baseline
    ]
    question = "How much does a smaller learning rate achieve on its own?"
    if not found:
        return Section(question, ())
    columns = [one.cells() for one in found]
    lines = tuple((label, *(column[label] for column in columns)) for label in columns[0])
    table = Table(("kept", *(short(one.name) for one in found)), lines)
    return Section(question, tuple(one.answer() for one in found), (table,), NOTES, "rates")


@dataclass(frozen=True)
class _Ladder:
    """Plain fine-tuning at several learning rates on one scenario, beside the other methods."""

    name: str
    baseline: Curve
    curves: Sequence[Curve]
    rows: Sequence[Row]
    evidence: Evidence

    @property
    def usual(self) -> Rung | None:
        """The scenario's learning rate, None if it has no runs."""
        return _usual(self.baseline)

    @property
    def best(self) -> Rung:
        """The learning rate at which it keeps most."""
        return max(self.baseline.rungs, key=lambda one: one.kept.value or 0.0)

    def answer(self) -> str:
        """Return what its best learning rate gains over the scenario's."""
        best, usual = self.best, self.usual
        at = rate_text(best.factor)
        if usual is None or best is usual:
            return f"On {short(self.name)}, plain fine-tuning keeps most at {at}."
        labels = (rung(BASELINE, one.factor) for one in (best, usual))
        gain = self.evidence.difference("kept", *labels).estimate
        certain = "" if gain.is_above(0) else ", which is not certain"
        return (
            f"On {short(self.name)}, plain fine-tuning at {at} keeps {format_over_seeds(gain)} more "
            f"than at {rate_text(usual.factor)}{certain}, and learns {format_over_seeds(best.learned)}."
        )

    def cells(self) -> dict[str, str]:
        """Return what is kept, and the differences, by their labels."""
        best = rung(BASELINE, self.best.factor)
        usual = rung(BASELINE, 1) if self.usual else ""
        others = self._others()
        method, rival = next(iter(others.items()), ("", None))
        label = rung(method, 1) if rival else ""
        frozen = next((row for row in self.rows if row.method == FROZEN), None)
        return {
            "plain fine-tuning at the scenario's learning rate": _at(self.usual) if self.usual else MISSING,
            "plain fine-tuning at its best rate": f"{_at(self.best)}, best of {len(self.baseline.rungs)}",
            "best method without prior demonstrations at the scenario's learning rate": (
                f"`{method}` {_at(rival)}, best of {counted(len(others), 'method')}" if rival else MISSING
            ),
            "this method minus plain fine-tuning at the scenario's learning rate": self._more(label, usual),
            "this method minus plain fine-tuning at its best rate": self._more(label, best),
            f"`{FROZEN}`": _with_seeds(frozen.estimates["kept"], frozen.seeds) if frozen else MISSING,
            f"plain fine-tuning at its best rate minus `{FROZEN}`": self._more(
                best, FROZEN if frozen else ""
            ),
        }

    def _others(self) -> dict[str, Rung]:
        """Return methods without prior demonstrations at the scenario's learning rate, by what they keep."""
        found = {
            curve.method: one
            for curve in self.curves
            if curve.division in WITHOUT_DEMONSTRATIONS
            and not curve.is_baseline
            and (one := _usual(curve)) is not None
        }
        return dict(sorted(found.items(), key=lambda item: -(item[1].kept.value or 0.0)))

    def _more(self, method: str, other: str) -> str:
        """Return how much more a method keeps than another, seed by seed, with the number of seeds."""
        if not method or not other:
            return MISSING
        found = self.evidence.difference("kept", method, other)
        return _with_seeds(found.estimate, found.seeds)


def _usual(curve: Curve) -> Rung | None:
    """Return the runs of a curve at the scenario's learning rate, None without any."""
    return next((one for one in curve.rungs if one.factor == 1), None)


def _at(one: Rung) -> str:
    """Return what a rate keeps, and the rate if it is not the scenario's."""
    rate = "" if one.factor == 1 else f" at factor {one.factor:g}"
    return f"{_with_seeds(one.kept, one.seeds)}{rate}"


def _with_seeds(estimate: Estimate, seeds: Sequence[int]) -> str:
    return f"{format_over_seeds(estimate)}, {counted(len(seeds), 'seed')}"
