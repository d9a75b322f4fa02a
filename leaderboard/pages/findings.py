"""The page of the findings: what the board, the ladder and the claims say together.

Each section asks one question and answers it from the records. Every sentence has its figure and interval;
the last section says what the records cannot tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby
from pathlib import Path

import numpy as np

from clbench.base.text import counted
from clbench.records.paths import parts_of
from clbench.scoring.intervals import Estimate
from clbench.scoring.layout import Array
from clbench.scoring.metrics import measure
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.references import BASELINE, FROZEN

from ..board.agreement import Agreement, agreement_between
from ..board.predictors import predictions
from ..board.rows import Row, Table
from ..board.summary import METHODS, RANKED_BY, tables_of
from ..claims.claim import tally
from ..claims.judges import Judged
from ..policies.compared import by_table
from ..views.format import format_interval, tau_text, title_of
from ..views.markdown import templates
from ..views.page.charts.plot import themed
from .findings_chart import gains_chart

WITHOUT_DEMONSTRATIONS = METHODS[:2]
"""Divisions of methods that may not look at earlier demonstrations."""


@dataclass(frozen=True)
class Section:
    """One question with its answers."""

    question: str
    """The heading."""
    answers: tuple[str, ...]
    """Sentences with figures."""
    head: tuple[str, ...] = ()
    """Heads of the columns of a table, empty without one; all but the first two are numbers."""
    lines: tuple[tuple[str, ...], ...] = ()
    """Cells of the table."""
    picture: str = ""
    """Stem of the name of the picture, empty without one."""


def page(found: Sequence[Section]) -> str:
    """Return the page as Markdown."""
    template = templates(Path(__file__).with_name("templates")).get_template("findings.md.jinja")
    return template.render(sections=found)


def pictures(table: Table) -> dict[str, str]:
    """Return the pictures as SVG, for a light and a dark page, by the names of their files."""
    rows = {name: competing(rows) for name, rows in _boards(table).items()}
    if not any(rows.values()):
        return {}
    chart = gains_chart(rows)
    return {f"gains{'-dark' if dark else ''}.svg": themed(chart, dark).svg() for dark in (False, True)}


def sections(table: Table, judged: Sequence[Judged]) -> list[Section]:
    """Return the sections that the records can fill, at least in part."""
    boards = _boards(table)
    found = (
        _gains(boards),
        _replay(boards),
        _step_sizes(table),
        _claims(judged),
        _orders(table, boards),
        _predictors(boards),
        _knowledge(_usual(table)),
        _policies(table),
        _undecided(judged),
    )
    return [section for section in found if section.answers]


def _boards(table: Table) -> dict[str, list[Row]]:
    """Return the rows of each scenario at equal learning, with the usual policy."""
    return {name: rows for name, rows in _usual(table).items() if rows[0].to_criterion}


def _usual(table: Table) -> dict[str, list[Row]]:
    """Return the rows of each scenario with the usual policy."""
    return {name: rows for name, rows in tables_of(table.rows).items() if parts_of(name)[1] == DEFAULT_POLICY}


def competing(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of methods other than plain fine-tuning, by falling gain."""
    found = [row for row in rows if row.division in METHODS and row.method != BASELINE]
    known = [row for row in found if row.estimates["gain"].value is not None]
    return sorted(known, key=lambda row: -(row.estimates["gain"].value or 0.0))


def _gains(boards: dict[str, list[Row]]) -> Section:
    """Does any method beat tuned fine-tuning without earlier demonstrations?"""
    answers: list[str] = []
    lines = []
    for name, rows in boards.items():
        others = competing(rows)
        answers += _gain_sentences(name, [row for row in others if row.division in WITHOUT_DEMONSTRATIONS])
        lines += [
            (
                name,
                row.method,
                *(format_interval(row.estimates[one]) for one in ("gain", "adaptation", "kept")),
                str(len(row.seeds)),
            )
            for row in others
        ]
    return Section(
        "Does a method without earlier demonstrations beat tuned fine-tuning?",
        tuple(answers),
        ("scenario", "method", "gain", "learned", "kept", "seeds"),
        tuple(lines),
        "gains" if lines else "",
    )


def _gain_sentences(name: str, rows: Sequence[Row]) -> Iterator[str]:
    if not rows:
        return
    gains = {row.method: row.estimates["gain"] for row in rows}
    better = {method: gain for method, gain in gains.items() if gain.low is not None and gain.low > 0}
    worse = {
        method: Estimate(-gain.value, -gain.high, -gain.low)
        for method, gain in gains.items()
        if gain.value is not None and gain.low is not None and gain.high is not None and gain.high < 0
    }
    if better:
        yield f"On {name}, yes: {_listed(better)}."
    else:
        best = next(iter(gains))
        yield (
            f"On {name}, not for certain: the largest gain of {counted(len(gains), 'method')} is "
            f"{format_interval(gains[best], '.3f')}, by `{best}`."
        )
    if worse:
        yield f"Certainly worse: {_listed(worse)}."


def _listed(estimates: dict[str, Estimate]) -> str:
    return ", ".join(f"`{name}` by {format_interval(one, '.3f')}" for name, one in estimates.items())


def _replay(boards: dict[str, list[Row]]) -> Section:
    """What earlier demonstrations buy, and what they cost."""
    answers = []
    for name, rows in boards.items():
        for row in competing(rows):
            kept = row.costs.get("bytes_kept")
            if row.division in WITHOUT_DEMONSTRATIONS or not kept:
                continue
            steps = format_interval(row.estimates["steps_to_criterion"], ".0f")
            answers.append(
                f"On {name}, `{row.method}` gains {format_interval(row.estimates['gain'])} with "
                f"{kept / 1e6:.1f} MB of earlier data, and takes {steps} steps to learn a target."
            )
    return Section("What do earlier demonstrations buy?", tuple(answers))


def _step_sizes(table: Table) -> Section:
    """How much a smaller learning rate does alone."""
    answers, lines = [], []
    for name, curves in table.frontiers.items():
        for curve in curves:
            lines += [
                (
                    name,
                    curve.method,
                    f"{rung.factor:g}",
                    format_interval(rung.learned),
                    format_interval(rung.kept),
                )
                for rung in curve.rungs
            ]
            if curve.is_baseline:
                first, best = curve.rungs[0], max(curve.rungs, key=lambda rung: rung.kept.value or 0.0)
                answers.append(
                    f"On {name}, plain fine-tuning keeps {format_interval(first.kept)} at "
                    f"{first.factor:g} times the scenario's learning rate, and {format_interval(best.kept)} "
                    f"at {best.factor:g} times, where it learns {format_interval(best.learned)}."
                )
    head = ("scenario", "method", "factor", "learned", "kept")
    return Section("How much does a smaller learning rate do alone?", tuple(answers), head, tuple(lines))


def _claims(judged: Sequence[Judged]) -> Section:
    """Which claims of the papers hold."""
    answers = []
    by_paper = groupby(judged, key=lambda one: one.claim.paper.name)
    for paper, members in by_paper:
        answers.append(f"{paper}: {tally(one.finding.verdict for one in members)}.")
    decided = [one for one in judged if one.finding.verdict != "undecided"]
    lines = tuple(
        (
            one.claim.id,
            f"{one.claim.words} {' '.join(one.finding.sentences[-1:])}".strip(),
            one.evidence.scenario,
            one.finding.verdict,
        )
        for one in decided
    )
    return Section(
        "Which claims of the papers hold here?", tuple(answers), ("id", "claim", "scenario", "verdict"), lines
    )


def _orders(table: Table, boards: dict[str, list[Row]]) -> Section:
    """Whether seeds, scenarios and definitions order the methods alike."""
    answers = []
    for name, found in table.agreements.items():
        if found is not None and name in boards:
            answers.append(f"On {name}, two halves of the {found.seeds} seeds {_order(found)}.")
    for (one, rows), (other, others) in combinations(boards.items(), 2):
        across = _between(rows, others, RANKED_BY, RANKED_BY)
        if across is not None:
            answers.append(f"{one} and {other} {_order(across, counted(across.rows, 'method'))}.")
    for name, rows in boards.items():
        for metric in ("kept_share", "forgetting", "backward_transfer"):
            same = _between(rows, rows, RANKED_BY, metric)
            if same is not None:
                answers.append(f"On {name}, final average and {title_of(metric)} {_order(same)}.")
    return Section("Do seeds, scenarios and definitions order the methods alike?", tuple(answers))


def _between(rows: Sequence[Row], others: Sequence[Row], metric: str, other_metric: str) -> Agreement | None:
    """Return the agreement of two metrics on the order of the methods that both lists have."""
    theirs = {row.method: row for row in others if row.division in METHODS}
    pairs = [(row, theirs[row.method]) for row in rows if row.division in METHODS and row.method in theirs]
    if not pairs:
        return None
    one, other = (
        _values([pair[side] for pair in pairs], name) for side, name in enumerate((metric, other_metric))
    )
    return None if one is None or other is None else agreement_between(one, other)


def _values(rows: Sequence[Row], metric: str) -> Array | None:
    """Return a metric of each row and of the seeds that all have, (rows, seeds); None if one is missing."""
    seeds = sorted(set.intersection(*(set(row.seeds) for row in rows)))
    sign = -1.0 if metric == "forgetting" else 1.0
    values = [[measure(metric, row.scores[seed]) for seed in seeds] for row in rows]
    if not seeds or any(value is None for line in values for value in line):
        return None
    return sign * np.array(values, dtype=float)


def _order(found: Agreement, methods: str = "the methods") -> str:
    """Return the predicate of a sentence on two boards."""
    words = f"order {methods} alike"
    if found.high < 0:
        words = f"put {methods} in opposite orders"
    elif found.low <= 0:
        words = f"may agree on the order of {methods} by chance"
    return f"{words} (Kendall's tau {tau_text(found)})"


def _predictors(boards: dict[str, list[Row]]) -> Section:
    """What orders the methods as their forgetting does."""
    answers = []
    for name, rows in boards.items():
        for one in predictions(rows):
            words = "orders the methods as their forgetting does"
            if one.high < 0:
                words = "orders the methods against their forgetting"
            elif one.low <= 0:
                words = "may agree with their forgetting on the order of the methods by chance"
            answers.append(f"On {name}, {one.predictor} {words} (Kendall's tau {tau_text(one)}).")
    if answers:
        answers.insert(0, "Forgetting is here 1 minus the kept share.")
    return Section("What predicts how much a method forgets?", tuple(answers))


def _knowledge(boards: dict[str, list[Row]]) -> Section:
    """Whether skills and answers to questions are lost together."""
    answers = []
    for name, rows in boards.items():
        by_method = {row.method: row for row in rows}
        if BASELINE not in by_method or FROZEN not in by_method:
            continue
        after, before = (by_method[method].estimates for method in (BASELINE, FROZEN))
        if after["question_retention"].value is None:
            continue
        answers.append(
            f"On {name}, plain fine-tuning keeps {format_interval(after['retention'])} of the skills "
            f"({format_interval(before['retention'])} before), and answers "
            f"{format_interval(after['question_retention'])} of the questions "
            f"({format_interval(before['question_retention'])} before)."
        )
    return Section("Are skills and knowledge lost together?", tuple(answers))


def _policies(table: Table) -> Section:
    """Whether forgetting depends on the policy: its action head, or its size."""
    answers, lines = [], []
    for name, comparisons in by_table(table.rows).items():
        scenario, policy = parts_of(name)
        for one in comparisons:
            three = map(format_interval, one.estimates[RANKED_BY])
            lines.append((scenario, one.method, policy, *three, str(one.seeds)))
        apart = [one.estimates[RANKED_BY][2] for one in comparisons if one.seeds > 1]
        if apart:
            lower = sum(one.high is not None and one.high < 0 for one in apart)
            answers.append(
                f"On {scenario} with {policy}, {lower} of {counted(len(apart), 'method')} end lower for "
                f"certain than with the flow policy."
            )
        elif comparisons:
            answers.append(f"On {scenario} with {policy} there is one seed, which tells nothing for certain.")
    head = ("scenario", "method", "other policy", "flow", "the other", "difference", "seeds")
    return Section("Does forgetting depend on the policy?", tuple(answers), head, tuple(lines))


def _undecided(judged: Sequence[Judged]) -> Section:
    """What the records cannot tell."""
    answers = []
    for verdict, why in (
        ("undecided", "runs are missing, or the intervals are too wide"),
        ("cannot be shown here", "the setting could not have shown the effect"),
    ):
        found = [one for one in judged if one.finding.verdict == verdict]
        for scenario, members in groupby(
            sorted(found, key=lambda one: one.evidence.scenario), key=lambda one: one.evidence.scenario
        ):
            names = ", ".join(one.claim.id for one in members)
            answers.append(f"{scenario}: {names} are {verdict}; {why}.")
    return Section("What can the records not tell?", tuple(answers))
