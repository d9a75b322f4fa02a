"""The page of the findings: what the board, the ladder and the claims say together.

Each section asks one question and answers it from the records. Every sentence has its figure and interval;
the last section says what the records cannot tell.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from clbench.base.text import counted
from clbench.records.paths import table_parts
from clbench.scoring.groups import differences_needed
from clbench.scoring.intervals import Estimate
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.references import BASELINE, FROZEN

from ..board.frontier import Curve, TiedGain, is_certain_over
from ..board.predictors import predictions
from ..board.rows import Board, Row, apart_from_baseline
from ..board.summary import METHODS, RANKED_BY, WITHOUT_DEMONSTRATIONS, tables_of
from ..claims.claim import PREDICATES, Verdict, tally
from ..claims.judges import Judged
from ..policies.compared import by_table
from ..views.format import MISSING, format_interval, tau_text
from ..views.markdown import templates
from ..views.page.charts.picture import themed
from .agreements import agreement_sentences
from .findings_chart import gains_chart
from .lost_skills import relearning_sentences

FORGOTTEN_BY = "kept_share"
"""Metric by which policies are compared: the final average also counts what they knew and learned."""


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


def pictures(board: Board) -> dict[str, str]:
    """Return the pictures as SVG, for a light and a dark page, by the names of their files."""
    rows = {name: competing(rows) for name, rows in _boards(board).items()}
    if not any(rows.values()):
        return {}
    chart = gains_chart(rows)
    return {f"gains{'-dark' if dark else ''}.svg": themed(chart, dark).svg() for dark in (False, True)}


def sections(board: Board, judged: Sequence[Judged]) -> list[Section]:
    """Return the sections that the records can fill, at least in part."""
    boards = _boards(board)
    found = (
        _gains(boards, board.tied),
        _replay(boards),
        _learning_rates(board),
        Section("Is a lost skill gone?", tuple(relearning_sentences(boards))),
        _claims(judged),
        Section(
            "Do seeds, scenarios and definitions order the methods alike?",
            tuple(agreement_sentences(board, boards)),
        ),
        _predictors(boards),
        _knowledge(_usual(board)),
        _policies(board),
        _undecided(judged),
    )
    return [section for section in found if section.answers]


def _boards(board: Board) -> dict[str, list[Row]]:
    """Return the rows of each scenario at equal learning, with the usual policy."""
    return {name: rows for name, rows in _usual(board).items() if rows[0].to_criterion}


def _usual(board: Board) -> dict[str, list[Row]]:
    """Return the rows of each scenario with the usual policy."""
    return {
        name: rows for name, rows in tables_of(board.rows).items() if table_parts(name)[1] == DEFAULT_POLICY
    }


def competing(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of methods other than plain fine-tuning, by falling gain."""
    found = [row for row in rows if row.division in METHODS and row.method != BASELINE]
    known = [row for row in found if row.estimates["gain"].value is not None]
    return sorted(known, key=lambda row: -(row.estimates["gain"].value or 0.0))


def _gains(boards: dict[str, list[Row]], tied: Mapping[str, Mapping[str, Sequence[TiedGain]]]) -> Section:
    """Does any method beat tuned fine-tuning without prior demonstrations?"""
    answers: list[str] = []
    lines = []
    for name, rows in boards.items():
        others = competing(rows)
        answers += _gain_sentences(name, rows, tied.get(name, {}))
        lines += [
            (
                name,
                row.method,
                format_interval(row.estimates["gain"], ".3f"),
                *(format_interval(row.estimates[one]) for one in ("adaptation", "kept")),
                str(len(row.seeds)),
            )
            for row in others
        ]
    return Section(
        "Does a method without prior demonstrations beat tuned fine-tuning?",
        tuple(answers),
        ("scenario", "method", "gain", "learned", "kept", "seeds"),
        tuple(lines),
        "gains" if lines else "",
    )


def _gain_sentences(name: str, rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]]) -> Iterator[str]:
    """Yield what Tukey's test of all rows without prior demonstrations says of each gain."""
    others = [row for row in competing(rows) if row.division in WITHOUT_DEMONSTRATIONS]
    if not others or BASELINE not in {row.method for row in rows}:
        return
    gains = {row.method: row.estimates["gain"] for row in others}
    apart = apart_from_baseline(rows)
    better = {method: gains[method] for method in gains if method in apart and (gains[method].value or 0) > 0}
    certain = {method: gain for method, gain in better.items() if is_certain_over(tied.get(method, ()))}
    if certain:
        yield f"On {name}, yes: {_listed(certain)}."
    for method in better:
        yield from _over_tied(name, method, gains[method], tied.get(method, ()))
    if not better:
        best = next(iter(gains))
        which = f"the gain of `{best}`"
        if len(gains) > 1:
            which = f"the largest gain of {len(gains)} methods, that of `{best}`,"
        yield (
            f"On {name}, none is told apart from it as better: {which} is "
            f"{format_interval(gains[best], '.3f')}. {_power(rows, gains)}"
        )
    alone = "by its own interval alone"
    if len(gains) > 1:
        alone += f", without correction for {len(gains)} comparisons"
    higher = {method: gain for method, gain in gains.items() if gain.is_above(0) and method not in better}
    over_both = {method: gain for method, gain in higher.items() if is_certain_over(tied.get(method, ()))}
    if over_both:
        yield f"Higher {alone}: {_listed(over_both)}."
    if len(over_both) < len(higher):
        rest = {method: gain for method, gain in higher.items() if method not in over_both}
        yield f"Higher {alone}, and over the chosen setting of plain fine-tuning alone: {_listed(rest)}."
    lower = {
        method: Estimate(-gain.value, -gain.high, -gain.low)
        for method, gain in gains.items()
        if gain.value is not None and gain.low is not None and gain.high is not None and gain.is_below(0)
    }
    worse = {method: loss for method, loss in lower.items() if method in apart}
    if worse:
        yield f"Told apart from it as worse: {_listed(worse)}."
    if len(worse) < len(lower):
        rest = {method: loss for method, loss in lower.items() if method not in worse}
        yield f"Lower {alone}: {_listed(rest)}."


def _over_tied(name: str, method: str, gain: Estimate, tied: Sequence[TiedGain]) -> Iterator[str]:
    """Yield how a certain gain fares against settings of plain fine-tuning that tuning rated as high."""
    for one in tied:
        sure = one.is_certain
        chosen, other = format_interval(gain, ".3f"), format_interval(one.gain, ".3f")
        yield (
            f"On {name}, {'for' if sure else 'not for'} certain: `{method}` gains {chosen} over plain "
            f"fine-tuning at the setting that tuning chose, {'and' if sure else 'but'} {other} at factor "
            f"{one.factor:g}, which tuning rated as high ({counted(one.seeds, 'seed')})."
        )


def _power(rows: Iterable[Row], methods: Collection[str]) -> str:
    """Return the sentence on the differences that the test of these methods cannot show."""
    family = {row.method: row.scores for row in rows if row.method in methods or row.method == BASELINE}
    needed = differences_needed(RANKED_BY, family, BASELINE)
    if not needed or not math.isfinite(max(needed.values())):
        return ""
    ends = [f"{end:.3f}" for end in (min(needed.values()), max(needed.values()))]
    between = ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}, depending on the method"
    return f"To be told apart, a gain must exceed {between}."


def _listed(estimates: dict[str, Estimate]) -> str:
    return ", ".join(f"`{name}` by {format_interval(one, '.3f')}" for name, one in estimates.items())


def _replay(boards: dict[str, list[Row]]) -> Section:
    """What prior demonstrations buy, and what they cost."""
    answers = []
    for name, rows in boards.items():
        usual = next((format_interval(_steps(row), ".0f") for row in rows if row.method == BASELINE), MISSING)
        for row in competing(rows):
            kept = row.costs.get("bytes_kept")
            if row.division in WITHOUT_DEMONSTRATIONS or not kept:
                continue
            answers.append(
                f"On {name}, `{row.method}` gains {format_interval(row.estimates['gain'])}, keeps "
                f"{kept / 1e6:.1f} MB between stages, and takes {format_interval(_steps(row), '.0f')} steps "
                f"to learn a target (plain fine-tuning: {usual}){_never_learned(row)}."
            )
    return Section("What do prior demonstrations buy?", tuple(answers))


def _never_learned(row: Row) -> str:
    """Return the end of a sentence on steps, if some stages ended without the criterion."""
    met = row.estimates["criterion_met"].value
    if met is None or met == 1:
        return ""
    return (
        f"; {1 - met:.0%} of its stages ended without the criterion, and count with all steps of the budget"
    )


def _steps(row: Row) -> Estimate:
    return row.estimates["steps_to_criterion"]


def _learning_rates(board: Board) -> Section:
    """How much a smaller learning rate does alone."""
    answers, lines = [], []
    for name, curves in board.frontiers.items():
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
                answers.append(_of_the_baseline(name, curve))
                answers += _at_the_first_rung(name, curve, curves)
        answers += _of_frozen(name, _usual(board).get(name, []))
    head = ("scenario", "method", "factor", "learned", "kept")
    return Section("How much does a smaller learning rate do alone?", tuple(answers), head, tuple(lines))


def _of_the_baseline(name: str, curve: Curve) -> str:
    """Return what plain fine-tuning keeps at the first rung, and at the one where it keeps most."""
    first, best = curve.rungs[0], max(curve.rungs, key=lambda rung: rung.kept.value or 0.0)
    more = ""
    if best is not first:
        more = (
            f", and {format_interval(best.kept)} at {_rate(best.factor)}, where it learns "
            f"{format_interval(best.learned)}: the most of {len(curve.rungs)} rates, in these same episodes"
        )
    return f"On {name}, plain fine-tuning keeps {format_interval(first.kept)} at {_rate(first.factor)}{more}."


def _rate(factor: float) -> str:
    return "the scenario's learning rate" if factor == 1 else f"{factor:g} times the scenario's learning rate"


def _at_the_first_rung(name: str, baseline: Curve, curves: Sequence[Curve]) -> Iterator[str]:
    """Yield what the methods without prior demonstrations keep at the learning rate of the first rung."""
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
        yield f"On {name}, methods without prior demonstrations keep at factor {factor:g}: {listed}."


def _of_frozen(name: str, rows: Sequence[Row]) -> Iterator[str]:
    """Yield what a policy that learns nothing keeps by this measure."""
    for row in rows:
        if row.method == FROZEN:
            yield (
                f"On {name}, `{FROZEN}`, which learns nothing, keeps "
                f"{format_interval(row.estimates['kept'])} by this measure: a target that was never learned "
                "counts as not kept."
            )


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


def _predictors(boards: dict[str, list[Row]]) -> Section:
    """What orders the methods as their forgetting does."""
    answers = []
    words = {
        1: "agrees with their forgetting on the order of the methods more than chance would explain",
        0: "shows no certain agreement with forgetting on the order of the methods",
        -1: "orders the methods against their forgetting",
    }
    for name, rows in boards.items():
        for one in predictions(rows):
            tau = f"Kendall's tau {tau_text(one)}, {counted(one.rows, 'method')}"
            answers.append(f"On {name}, {one.predictor} {words[one.direction]} ({tau}).")
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
        skills = ""
        if after["retention"].value is not None:
            skills = (
                f"keeps {format_interval(after['retention'])} of the skills "
                f"({format_interval(before['retention'])} before), and "
            )
        answers.append(
            f"On {name}, plain fine-tuning {skills}answers "
            f"{format_interval(after['question_retention'])} of the questions "
            f"({format_interval(before['question_retention'])} before)."
        )
    return Section("Are skills and knowledge lost together?", tuple(answers))


def _policies(board: Board) -> Section:
    """Whether forgetting depends on the policy: its action head, or its size."""
    answers, lines = [], []
    for name, every in by_table(board.rows).items():
        scenario, policy = table_parts(name)
        comparisons = [one for one in every if one.method != FROZEN]  # a policy that is not trained keeps all
        for one in comparisons:
            three = map(format_interval, one.estimates[FORGOTTEN_BY])
            lines.append((scenario, one.method, policy, *three, str(one.seeds)))
        apart = [one.estimates[FORGOTTEN_BY][2] for one in comparisons if one.seeds > 1]
        if apart:
            lower = sum(one.is_below(0) for one in apart)
            higher = sum(one.is_above(0) for one in apart)
            answers.append(
                f"On {scenario} with {policy}, the kept share of {lower} of "
                f"{counted(len(apart), 'method')} is lower than with the flow policy, and that of {higher} "
                "higher, by intervals of their own. Its methods have the settings that were tuned for the "
                "flow policy, and its stages take other numbers of steps: tuning may explain a difference."
            )
        elif comparisons:
            answers.append(f"On {scenario} with {policy} there is one seed, which tells nothing for certain.")
    head = ("scenario", "method", "other policy", "kept share, flow", "the other", "difference", "seeds")
    return Section("Does forgetting depend on the policy?", tuple(answers), head, tuple(lines))


def _undecided(judged: Sequence[Judged]) -> Section:
    """What the records cannot tell."""
    answers = []
    reasons: tuple[tuple[Verdict, str], ...] = (
        ("undecided", "runs are missing, or the intervals are too wide"),
        ("cannot be shown here", "the setting could not have shown the effect"),
    )
    for verdict, why in reasons:
        found = [one for one in judged if one.finding.verdict == verdict]
        for scenario, members in groupby(
            sorted(found, key=lambda one: one.evidence.scenario), key=lambda one: one.evidence.scenario
        ):
            names = [one.claim.id for one in members]
            answers.append(f"{scenario}: {', '.join(names)} {PREDICATES[verdict][len(names) > 1]}; {why}.")
    return Section("What can the records not tell?", tuple(answers))
