"""The verdict on a scenario: what its rows say, in a few sentences and numbers."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

from clbench.base.text import counted, listed, printable
from clbench.scoring.groups import groups
from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import TIE
from clbench.spec.references import BASELINE

from ...board.certainty import TiedGain, sides_of_gains
from ...board.costs import mean_step_ratio
from ...board.rows import Row, mean_difference, standing_of
from ...board.summary import (
    DIVISIONS,
    METHODS,
    RANKED_BY,
    WITH_DEMONSTRATIONS,
    WITHOUT_DEMONSTRATIONS,
    competing,
    divisions_of,
)
from ..descriptions import RULES
from ..format import NAMED, format_interval, no_tied_runs, number_text, rate_text
from .numbers import MISSING, cost, size


@dataclass(frozen=True)
class Fact:
    """A number of the leading method."""

    name: str
    text: str
    more: str = ""
    """Its interval, or what it is a multiple of."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What a scenario says about one division."""

    division_number: int
    """Place of the division in `DIVISIONS`."""
    name: str
    rule: str
    leader: Row
    """The first row of the division."""
    standing: str
    """How surely it leads."""
    doubt: str
    """Why its gain is not certain although the interval of the gain is above 0; empty otherwise."""
    keeping: str
    """Sentence on the method that keeps most among those that learn like plain fine-tuning, empty if there is
    nothing to compare."""
    facts: tuple[Fact, ...]


def headline(rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]] | None = None) -> str:
    """Return what the rows of a scenario say about plain fine-tuning and the methods against forgetting.

    Args:
        rows: The rows.
        tied: Gains over plain fine-tuning at settings that tuning rated as highly as the chosen one, by
            method: a gain is certain if they are, too.
    """
    members = competing(rows)
    baseline = next((row for row in members if row.method == BASELINE), None)
    others = [row for row in members if row.method != BASELINE]
    if not members:
        return "No method that competes has run here."
    if baseline is None:
        return f"{counted(len(members), 'method')}, not yet compared with plain fine-tuning."
    if not others:
        value = number_text(baseline.estimates[RANKED_BY].value, ".2f", MISSING)
        return f"Plain fine-tuning ends with a final average of {value}. No other method has run here."
    sides = sides_of_gains(rows, tied or {})
    ahead = [row for row in others if sides.get(row.method) == 1]
    gains = {row.method: mean_difference(RANKED_BY, row.scores, baseline.scores) or 0.0 for row in ahead}
    if not sides and all(len(row.seeds) == 1 for row in members):
        methods = "the only other method cannot" if len(others) == 1 else "no method can"
        return (
            f"With one seed, {methods} be told apart from plain fine-tuning: the intervals cover only the "
            "noise of episodes."
        )
    if not ahead:
        methods = "The only other method is not" if len(others) == 1 else "No method is"
        return f"{methods} shown to end above plain fine-tuning."
    first = _above(ahead, gains)
    left = len(others) - len(ahead)
    if not left:
        return first
    return f"{first} " + (
        "The one other method shows no certain gain."
        if left == 1
        else f"The other {left} methods show no certain gain."
    )


def _above(ahead: Sequence[Row], gains: Mapping[str, float]) -> str:
    """Return the sentence on the methods that end above plain fine-tuning, without demonstrations first."""
    parts = []
    for kind, divisions in (("out", WITHOUT_DEMONSTRATIONS), ("", WITH_DEMONSTRATIONS)):
        members = sorted(
            (row for row in ahead if row.division in divisions), key=lambda row: -gains[row.method]
        )
        if members:
            texts = [number_text(gains[row.method], ".2f") for row in (members[-1], members[0])]
            by = texts[0] if texts[0] == texts[1] else f"{texts[0]} to {texts[1]}"
            verb = "ends" if len(members) == 1 else "end"
            names = _names([row.method for row in members])
            parts.append((f"with{kind} prior demonstrations", names, verb, by))
    (where, names, verb, by), *more = parts
    first = f"{where.capitalize()}, {names} {verb} {by} above plain fine-tuning"
    rest = (f"{where}, {names} {verb} {by} above it" for where, names, verb, by in more)
    return "; ".join([first, *rest]) + "."


def verdicts(rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]] | None = None) -> list[Verdict]:
    """Return the verdict on each division of methods with a final average.

    Args:
        rows: The rows.
        tied: As for `headline`.
    """
    apart = sides_of_gains(rows, tied or {})
    found = []
    baseline = next((row for row in rows if row.method == BASELINE), None)
    for division, members in divisions_of(rows).items():
        known = [row for row in members if row.letters is not None]
        if division not in METHODS or not known:
            continue
        leader = known[0]
        found.append(
            Verdict(
                division_number=DIVISIONS.index(division),
                name=division,
                rule=RULES[division],
                leader=leader,
                standing=_standing(leader, rows),
                doubt=_doubt(leader, rows, apart, (tied or {}).get(leader.method, ())),
                keeping=_keeping(known, baseline),
                facts=tuple(_facts(leader, baseline)),
            )
        )
    return found


def _standing(leader: Row, rows: Sequence[Row]) -> str:
    standing = standing_of(leader, rows)
    value = number_text(leader.estimates[RANKED_BY].value, ".2f")
    if standing is None or standing.count == 1:
        return f"It is alone in its division, with a final average of {value}."
    first = f"It ranks first of {standing.count} {_ranked_in(leader, rows)} ({value})"
    if len(standing.alike) == 1:
        return f"{first}; {_names(standing.alike)} is not told apart from it."
    if standing.alike:
        return f"{first}; {_alike_text(len(standing.alike))}: {_names(standing.alike)}."
    others = [row for row in rows if row.division == leader.division and row is not leader]
    if len(others) == 1:
        return f"{first}, told apart from {printable(others[0].method)}."
    return f"{first}, told apart from all others of its division."


def _ranked_in(leader: Row, rows: Iterable[Row]) -> str:
    """Return in words what a leader is first in: another row may have luckier seeds, see `Row.height`."""
    finals = [row.estimates[RANKED_BY].value or 0.0 for row in rows if row.division == leader.division]
    if (leader.estimates[RANKED_BY].value or 0.0) > max(finals) - TIE:
        return "in final average"
    return f"over the seeds that each shares with {BASELINE}, but not in final average"


def _doubt(leader: Row, rows: Sequence[Row], apart: Container[str], tied: Sequence[TiedGain]) -> str:
    """Return why a gain whose interval is above 0 is not certain, empty if it is or the interval is not."""
    if leader.method == BASELINE or not leader.estimates["gain"].is_above(0):
        return ""
    if leader.method not in apart:
        family = next(
            kind for kind in (WITHOUT_DEMONSTRATIONS, WITH_DEMONSTRATIONS) if leader.division in kind
        )
        count = sum(row.division in family and row.method != BASELINE for row in rows)
        kind = "without" if family is WITHOUT_DEMONSTRATIONS else "with"
        return (
            "Its own interval puts its gain above 0, but the gain is not told apart from 0 when all "
            f"{count} methods {kind} prior demonstrations are compared with sft."
        )
    unsure = [one for one in tied if not one.is_certain]
    if not unsure:
        return ""
    if not unsure[0].seeds:
        return f"Its gain is not certain: for plain fine-tuning, {no_tied_runs(unsure[0])}."
    return (
        f"Tuning rated sft equally highly at {rate_text(unsure[0].factor)}. Over that setting, the gain is "
        f"{format_interval(unsure[0].gain, '+.2f')}, which is not certain."
    )


def _alike_text(count: int) -> str:
    return f"{'one is' if count == 1 else f'{count} are'} not told apart from it"


def _keeping(members: Sequence[Row], baseline: Row | None) -> str:
    if baseline is None or all(row.method == BASELINE for row in members):
        return ""
    pool = {row.method: row for row in (baseline, *members)}
    equal = [row for row in members if row.method in _alike("adaptation", baseline.method, pool)]
    if not equal:
        return f"{_other_learning(members[0], baseline)} {_training(members[0], baseline)}"
    leader = members[0]
    slower = "" if leader in equal else f"{_other_learning(leader, baseline)} "
    keeper = max(equal, key=lambda row: mean_difference("kept", row.scores, baseline.scores) or 0.0)
    name = "it" if keeper is leader else printable(keeper.method)
    whose = "Its" if keeper is leader else f"{name}'s"
    if len(equal) == 1 and keeper.method != BASELINE:
        other = f"The other, {name}," if len(members) == 2 else f"Of the others, {name}"
        which = "It" if keeper is leader else other
        return f"{slower}{which} {_beside(keeper, baseline)} {_training(keeper, baseline, whose)}"
    kept, like = _value("kept", keeper), "Among the methods whose learning is not told apart from sft's"
    if keeper.method == BASELINE:
        return f"{slower}{like}, none keeps more than sft itself ({kept})."
    peers = _alike("kept", keeper.method, {row.method: row for row in equal})
    sure = f"; {_alike_text(len(peers) - 1)} in this respect" if len(peers) > 1 else ""
    if BASELINE in peers:
        sure = f", but what it keeps is not told apart from sft's ({_value('kept', baseline)})"
    return f"{slower}{like}, {name} keeps the most ({kept}){sure}. {_training(keeper, baseline, whose)}"


def _beside(row: Row, baseline: Row) -> str:
    """Return what a row, whose learning is not told apart from plain fine-tuning's, learns and keeps."""
    learned, kept = (
        f"{_value(name, row)} ({BASELINE} {_value(name, baseline)})" for name in ("adaptation", "kept")
    )
    if len({*row.seeds} & {*baseline.seeds}) < 2:
        return f"learns {learned} and keeps {kept}, with only one seed."
    is_alike = baseline.method in _alike("kept", row.method, {one.method: one for one in (row, baseline)})
    sure = (
        "it is told apart from sft in neither"
        if is_alike
        else "it is told apart from sft only in what it keeps"
    )
    return f"learns {learned} and keeps {kept}; {sure}."


def _training(row: Row, baseline: Row, whose: str = "Its") -> str:
    """Return the sentence on the training time of a row."""
    relative = row.costs["relative_cost"]
    if relative is None:
        return f"{whose} training time was not measured."
    if relative == 0:
        return f"{whose} training takes no time."
    step = mean_step_ratio([run for run in row.runs if run.seed in baseline.seeds])
    parts = ""
    if step:
        steps, step_text = (number_text(one, ".2f") for one in (relative / step, step))
        parts = f": {steps} times the steps, each {step_text} times as long"
    return f"{whose} training takes {number_text(relative, '.2f')} times as long as sft's{parts}."


def _value(metric: str, row: Row) -> str:
    return number_text(row.estimates[metric].value, ".2f", MISSING)


def _other_learning(leader: Row, baseline: Row) -> str:
    """Return the sentence on a leader that does not learn as much as fine-tuning."""
    usual, own = (row.estimates["adaptation"].value or 0.0 for row in (baseline, leader))
    less = "less" if own < usual else "more"
    return f"It learns {less} than sft: {number_text(own, '.2f')} against {number_text(usual, '.2f')}."


def _alike(metric: str, method: str, rows: dict[str, Row]) -> set[str]:
    """Return the methods that are not told apart from a method in a metric, itself included."""
    letters = groups(metric, {name: row.scores for name, row in rows.items()})
    own = set(letters.get(method, ""))
    return {name for name, groups in letters.items() if own & set(groups)}


def _facts(row: Row, baseline: Row | None) -> list[Fact]:
    usual = "tuned sft" if baseline is not None and baseline.tried is not None else "sft"
    names = (("learned", "adaptation"), ("kept", "kept"), (f"gain over {usual}", "gain"))
    found = [_fact(title, row.estimates[name], "+.2f" if name == "gain" else ".2f") for title, name in names]
    if row.method == BASELINE:
        found.pop()
    price = cost(row)
    found.append(Fact("relative cost", price.text, "the training time of sft" if price.order else ""))
    return [*found, Fact("bytes kept", size(row).text)]


def _fact(title: str, one: Estimate, form: str) -> Fact:
    interval = "" if one.low is None else f"{number_text(one.low, form)} to {number_text(one.high, form)}"
    return Fact(title, number_text(one.value, form, MISSING), interval)


def _names(names: Sequence[str]) -> str:
    """Return names in a sentence: all if they are few, otherwise the first ones and a count."""
    many = len(names) > NAMED + 1  # "and 1 more" would be as long as its name
    shown = [printable(name) for name in (names[:NAMED] if many else names)]
    if many:
        return f"{', '.join(shown)} and {len(names) - NAMED} more"
    return listed(shown)
