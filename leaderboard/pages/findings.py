"""The page of the findings: what the board, the ladder and the claims say together.

Each section asks one question and answers it from the records. Every sentence has its figure and interval;
the last section says what the records cannot tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TypeVar

from clbench.base.text import counted, listed
from clbench.records.paths import table_parts
from clbench.scoring.groups import differences_needed
from clbench.scoring.intervals import Estimate
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.references import BASELINE, FROZEN

from ..board.frontier import TiedGain, is_certain_over
from ..board.predictors import predictions
from ..board.rows import Board, Row, apart_from_baseline
from ..board.summary import METHODS, RANKED_BY, WITHOUT_DEMONSTRATIONS, tables_of
from ..claims.claim import PREDICATES, Claim, Verdict, tally
from ..claims.evidence import Evidence
from ..claims.judges import Judged
from ..policies.compared import by_table
from ..views.format import MISSING, format_interval, over_tied, tau_text
from ..views.markdown import templates
from ..views.page.charts.picture import themed
from .agreements import after_correction, agreement_sentences
from .findings_chart import gains_chart
from .learning_rates import rate_lines, rate_sentences
from .lost_skills import relearning_sentences

Key = TypeVar("Key")
Value = TypeVar("Value")

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


def sections(board: Board, judged: Sequence[Judged], evidence: Callable[[str], Evidence]) -> list[Section]:
    """Return the sections that the records can fill, at least in part.

    Args:
        board: The board of the records.
        judged: Findings on the claims.
        evidence: Returns the runs of the scenario with a Gymnasium id, those of the ladder included.
    """
    boards = _boards(board)
    found = (
        _gains(boards, board.tied),
        _replay(boards),
        _learning_rates(board, evidence),
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
    certain = {
        method: gain
        for method, gain in better.items()
        if gain.is_above(0) and is_certain_over(tied.get(method, ()))
    }
    if certain:
        yield f"On {name}, yes: {_listed(certain)}."
    for method in better:
        yield from over_tied(name, f"`{method}`", gains[method], tied.get(method, ()))
    if not better:
        best = next(iter(gains))
        which = f"the gain of `{best}`"
        if len(gains) > 1:
            which = f"the largest gain of {len(gains)} methods, that of `{best}`,"
        yield (
            f"On {name}, none is told apart from plain fine-tuning as better: {which} is "
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
        yield f"Told apart from plain fine-tuning as worse: {_listed(worse)}."
    if len(worse) < len(lower):
        rest = {method: loss for method, loss in lower.items() if method not in worse}
        yield f"Lower {alone}: {_listed(rest)}."


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
    if answers:
        answers.append(OWN_RATES)
    return Section("What do prior demonstrations buy?", tuple(answers))


OWN_RATES = (
    "Each method has the learning rate that tuning chose for it, and a smaller one takes more steps: a "
    "difference in steps need not come from the demonstrations."
)


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


def _learning_rates(board: Board, evidence: Callable[[str], Evidence]) -> Section:
    """How much a smaller learning rate does alone."""
    head = ("scenario", "method", "factor", "learned", "kept")
    answers = tuple(rate_sentences(board.frontiers, _usual(board), evidence))
    lines = tuple(rate_lines(board.frontiers))
    return Section("How much does a smaller learning rate do alone?", answers, head, lines)


def _claims(judged: Sequence[Judged]) -> Section:
    """Which claims of the papers hold."""
    answers = []
    by_paper = groupby(judged, key=lambda one: one.claim.paper.name)
    for paper, members in by_paper:
        every = list(members)
        answers.append(f"{paper}: {tally(one.finding.verdict for one in every)}.{_those_that_hold(every)}")
    boards = tuple(dict.fromkeys(one.evidence.scenario for one in judged))
    found = _grouped((one.claim, one) for one in judged)
    lines = tuple(_claim_line(claim, members, boards) for claim, members in found.items())
    head = ("id", "claim", "first figure", *boards)
    answers += [*_explanations(judged), *_what_would_show_it(judged)]
    if lines:
        answers.append(
            "The table has the value of the first figure after each verdict. The page of the claims has the "
            "rules, the other figures and the controls."
        )
    return Section("Which claims of the papers hold here?", tuple(answers), head, lines)


def _claim_line(claim: Claim, judged: Sequence[Judged], boards: Sequence[str]) -> tuple[str, ...]:
    """Return the cells of a claim: what is measured first, and on each board the verdict with its value."""
    figures = [one.finding.figures[0] for one in judged if one.finding.figures]
    what = figures[0].what if figures else MISSING
    cells = {one.evidence.scenario: _verdict_cell(one, what) for one in judged}
    return (claim.id, claim.words, what, *(cells.get(board, "") for board in boards))


def _verdict_cell(one: Judged, what: str) -> str:
    """Return a verdict with the value of its first figure, if that is the figure `what`."""
    shown = [figure for figure in one.finding.figures[:1] if figure.what == what]
    return ": ".join(
        [one.finding.verdict, *(format_interval(figure.estimate, figure.form) for figure in shown)]
    )


def _explanations(judged: Sequence[Judged]) -> list[str]:
    """Return the last conclusion from the figures and controls of each verdict that is a yes or a no."""
    told = _grouped(
        ((one.claim.id, sentence), one.evidence.scenario)
        for one in judged
        if one.finding.verdict in ("holds", "holds in part", "does not hold")
        for sentence in one.finding.sentences[-1:]
    )
    return [f"{claim} on {listed(boards)}: {sentence}" for (claim, sentence), boards in told.items()]


def _what_would_show_it(judged: Sequence[Judged]) -> list[str]:
    """Return a sentence for each thing that boards lack to show some claims."""
    claims = _grouped(
        ((one.finding.change, one.evidence.scenario), one.claim.id)
        for one in judged
        if one.finding.verdict == "cannot be shown here"
    )
    boards = _grouped(((change, listed(names)), board) for (change, board), names in claims.items())
    places = _grouped((change, f"{names} on {listed(on)}") for (change, names), on in boards.items())
    return [
        f"What would show {'; '.join(where)}: {change[:1].lower()}{change[1:]}"
        for change, where in places.items()
    ]


def _grouped(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Return the values of each key, in their order."""
    found: dict[Key, list[Value]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found


def _those_that_hold(judged: Sequence[Judged]) -> str:
    """Return in a sentence which claims hold: some are about plain fine-tuning, costs, or algebra."""
    boards = _grouped((one.claim, one.finding.verdict in ("holds", "holds in part")) for one in judged)
    words = [
        f"{claim.id}, {claim.words.rstrip('.')} (on {sum(held)} of {counted(len(held), 'board')})"
        for claim, held in boards.items()
        if any(held)
    ]
    return f" What holds: {'; '.join(words)}." if words else ""


def _predictors(boards: dict[str, list[Row]]) -> Section:
    """What orders the methods as their forgetting does."""
    answers = []
    words = {
        1: "orders the methods as forgetting does, more than chance would explain",
        0: "shows no certain agreement with forgetting on the order of the methods",
        -1: "orders the methods against their forgetting",
    }
    found = [(name, one) for name, rows in boards.items() for one in predictions(rows)]
    for name, one in found:
        tau = f"Kendall's tau {tau_text(one)}, {counted(one.rows, 'method')}"
        answers.append(f"On {name}, {one.predictor} {words[one.direction]} ({tau}).")
    if answers:
        answers.insert(
            0,
            "Forgetting is here 1 minus the kept share. Methods differ in more than one way, such as their "
            "learning rate: an order that agrees does not say what causes forgetting.",
        )
        answers += after_correction([one.chance for _, one in found])
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
