"""The page of the findings: what the board, the ladder and the claims say together.

Each section asks one question and answers it from the records. Every sentence has its figure and interval;
the last section says what the records cannot tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from clbench.base.text import counted, listed, megabytes
from clbench.records.paths import table_parts
from clbench.scoring.intervals import Estimate
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.references import BASELINE, FROZEN

from ..board.predictors import predictions
from ..board.rows import Board, Row, certain_sides
from ..board.summary import WITH_DEMONSTRATIONS, WITHOUT_DEMONSTRATIONS, grouped, tables_of
from ..claims.claim import DECIDED, KNOWLEDGE, PREDICATES, Claim, Verdict, tally
from ..claims.evidence import Evidence
from ..claims.judges import Judged
from ..policies.compared import by_table
from ..views.format import MISSING, format_interval, tau_text
from ..views.page.charts.picture import in_both_themes
from ..views.templating import template
from .agreements import after_correction, agreement_sentences, without_demonstrations
from .findings_chart import gains_chart
from .gains import Tied, by_gain, gain_sentences, gain_table
from .learning_rates import rate_lines, rate_sentences
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


def page(short: Sequence[str], found: Sequence[Section]) -> str:
    """Return the page as Markdown: what `in_short` says, and the sections."""
    return template(__file__, "findings.md.jinja").render(short=short, sections=found)


def pictures(board: Board) -> dict[str, str]:
    """Return the pictures as SVG, for a light and a dark page, by the names of their files."""
    rows = {name: by_gain(rows) for name, rows in _boards(board).items()}
    if not any(rows.values()):
        return {}
    return in_both_themes("gains", gains_chart(rows))


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
        _replay(boards, board.tied),
        _learning_rates(board, evidence),
        Section("Is a lost skill gone for good?", tuple(relearning_sentences(boards))),
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


def in_short(board: Board, judged: Sequence[Judged]) -> list[str]:
    """Return the answers that most readers look for; `sections` have their figures and limits."""
    above: dict[str, list[Row]] = {}
    for name, rows in _boards(board).items():
        sides = certain_sides(rows, board.tied.get(name, {}))
        if others := by_gain(rows):
            above[name] = [row for row in others if sides.get(row.method) == 1]
    divisions = {"Without": WITHOUT_DEMONSTRATIONS, "With": WITH_DEMONSTRATIONS}
    answers = []
    for data, names in divisions.items() if above else ():
        best = {name: [row for row in rows if row.division in names][:1] for name, rows in above.items()}
        gains = grouped(
            (row.method, f"{format_interval(row.estimates['gain'])} on {name}")
            for name, rows in best.items()
            for row in rows
        )
        parts = [f"`{method}` gains {listed(texts)}" for method, texts in gains.items()]
        if none := [name for name, rows in best.items() if not rows]:
            parts.append(f"no method is certainly better than tuned plain fine-tuning on {listed(none)}")
        answers.append(f"{data} prior demonstrations: {'; '.join(parts)}.")
    return answers + _claims_in_short(judged)


def _claims_in_short(judged: Sequence[Judged]) -> list[str]:
    """Return how many claims have which verdict on at least one board."""
    verdicts = grouped((one.claim, one.finding.verdict) for one in judged if not one.claim.uncounted)
    if not verdicts:
        return []
    numbers = {one: sum(one in found for found in verdicts.values()) for one in DECIDED}
    counts = listed([f"{number} {PREDICATES[one][number != 1]}" for one, number in numbers.items()])
    others = sum(not set(DECIDED) & set(found) for found in verdicts.values())
    return [
        f"Of the papers' {counted(len(verdicts), 'claim')}, {counts} on at least one board; {others} "
        f"{'is' if others == 1 else 'are'} undecided, or cannot be shown, on every board."
    ]


def _boards(board: Board) -> dict[str, list[Row]]:
    """Return the rows of each scenario at equal learning, with the default policy."""
    return {name: rows for name, rows in _usual(board).items() if rows[0].to_criterion}


def _usual(board: Board) -> dict[str, list[Row]]:
    """Return the rows of each scenario with the default policy."""
    return {
        name: rows for name, rows in tables_of(board.rows).items() if table_parts(name)[1] == DEFAULT_POLICY
    }


def _gains(boards: dict[str, list[Row]], tied: Tied) -> Section:
    """Does any method beat tuned fine-tuning without prior demonstrations?"""
    answers = tuple(
        one for name, rows in boards.items() for one in gain_sentences(name, rows, tied.get(name, {}))
    )
    head, lines = gain_table(boards, tied)
    question = "Does a method without prior demonstrations beat tuned fine-tuning?"
    return Section(question, answers, head, lines, "gains" if lines else "")


def _replay(boards: dict[str, list[Row]], tied: Tied) -> Section:
    """What prior demonstrations buy, and what they cost."""
    answers = []
    for name, rows in boards.items():
        baseline = next((row for row in rows if row.method == BASELINE), None)
        usual = f"; plain fine-tuning takes {_steps(baseline)}{_missed(baseline)}" if baseline else ""
        sides = certain_sides(rows, tied.get(name, {}))
        for row in by_gain(rows):
            kept = row.costs.get("bytes_kept")
            if row.division in WITHOUT_DEMONSTRATIONS or not kept:
                continue
            gain = row.estimates["gain"]
            moves = "gains" if sides.get(row.method) == 1 else "changes the final average by"
            doubt = "" if row.method in sides else " (not certain)"
            answers.append(
                f"On {name}, `{row.method}` {moves} {format_interval(gain)}{doubt}, keeps "
                f"{megabytes(int(kept))} between stages, and takes {_steps(row)} steps to learn a "
                f"target{_missed(row)}{usual}."
            )
    if answers:
        answers += [WHAT_IS_KEPT, OWN_RATES]
    return Section("What do prior demonstrations buy?", tuple(answers))


WHAT_IS_KEPT = (
    "Replay and `a_gem` keep demonstrations between stages; `ewc` and `fast_dvla` keep vectors as large as "
    "the policy, which they make from demonstrations before the first stage."
)

OWN_RATES = (
    "Each method has the learning rate that tuning chose for it. A smaller rate takes more steps, so a "
    "difference in steps need not come from the demonstrations. A stage that misses the criterion counts as "
    "the full budget of steps."
)


def _missed(row: Row) -> str:
    """Return what follows a number of steps, if some stages ended without the criterion."""
    met = row.estimates["criterion_met"].value
    return "" if met is None or met == 1 else f" ({1 - met:.0%} of its stages missed the criterion)"


def _steps(row: Row) -> str:
    return format_interval(row.estimates["steps_to_criterion"], ".0f")


def _learning_rates(board: Board, evidence: Callable[[str], Evidence]) -> Section:
    """How much a smaller learning rate achieves on its own."""
    head = ("scenario", "method", "factor", "learned", "kept", "seeds")
    answers = tuple(rate_sentences(board.frontiers, _usual(board), evidence))
    lines = tuple(rate_lines(board.frontiers))
    return Section("How much does a smaller learning rate achieve on its own?", answers, head, lines)


def _claims(judged: Sequence[Judged]) -> Section:
    """Which claims of the papers hold."""
    answers = []
    for paper, every in grouped((one.claim.paper.name, one) for one in judged).items():
        counted_ones = [one for one in every if not one.claim.uncounted]
        answers.append(
            f"{paper} has {tally(one.finding.verdict for one in counted_ones)}."
            f"{_those_that_hold(counted_ones)}{_uncounted(every)}"
        )
    if any(one.claim.scenarios == KNOWLEDGE for one in judged):
        answers.insert(0, HOW_IT_WAS_MADE)
    boards = tuple(dict.fromkeys(one.evidence.scenario for one in judged))
    found = grouped((one.claim, one) for one in judged)
    lines = tuple(_claim_line(claim, members, boards) for claim, members in found.items())
    head = ("id", "claim", "measured quantity", *boards)
    answers += [*_explanations(judged), *_what_would_show_it(judged)]
    if lines:
        answers.append(
            "After each verdict, the table gives the value of this quantity. The page of the claims has the "
            "rules, all other figures and the controls."
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
    """Return the last conclusion from the figures and controls of each verdict that is a yes or a no.

    If a claim fails on the scenario that was made to show it, the sentence says so, as it does if it holds.
    """
    told = grouped(
        ((one.claim, sentence), one.evidence.scenario)
        for one in judged
        if one.finding.verdict in DECIDED
        for sentence in one.finding.sentences[-1:]
    )
    return [
        f"{claim.id} on {listed(boards)}"
        + (f", {MADE_FOR_IT}" if claim.scenarios == KNOWLEDGE else "")
        + f": {sentence}"
        for (claim, sentence), boards in told.items()
    ]


def _what_would_show_it(judged: Sequence[Judged]) -> list[str]:
    """Return a sentence for each thing that boards lack to show some claims."""
    claims = grouped(
        ((one.finding.change, one.evidence.scenario), one.claim.id)
        for one in judged
        if one.finding.verdict == "cannot be shown here"
    )
    boards = grouped(((change, listed(names)), board) for (change, board), names in claims.items())
    places = grouped((change, f"{names} on {listed(on)}") for (change, names), on in boards.items())
    return [
        f"What would show {'; '.join(where)}: {change[:1].lower()}{change[1:]}"
        for change, where in places.items()
    ]


MADE_FOR_IT = "the one scenario that was made to show it"

HOW_IT_WAS_MADE = (
    "clbench/FetchKnowledge-v1 was made to show claims on knowledge: its steps are large, and training goes "
    "on long after the target is learned."
)


def _those_that_hold(judged: Sequence[Judged]) -> str:
    """Return in sentences which claims hold, some in part: they may be about sft or costs."""
    sentences = []
    for verdict, opening in (("holds", "What holds"), ("holds in part", "What holds in part")):
        boards = grouped((one.claim, one.finding.verdict == verdict) for one in judged)
        words = [
            f"{claim.id}, {claim.words.rstrip('.')} (on "
            + (MADE_FOR_IT if claim.scenarios == KNOWLEDGE else f"{sum(so)} of {counted(len(so), 'board')}")
            + ")"
            for claim, so in boards.items()
            if any(so)
        ]
        sentences += [f" {opening}: {'; '.join(words)}."] if words else []
    return "".join(sentences)


def _uncounted(judged: Sequence[Judged]) -> str:
    """Return in a sentence which claims are not counted, and why."""
    found = grouped((one.claim, one.finding.verdict) for one in judged if one.claim.uncounted)
    return "".join(
        f" {claim.id} is {claim.uncounted} and is not counted; it has {tally(verdicts)}."
        for claim, verdicts in found.items()
    )


def _predictors(boards: dict[str, list[Row]]) -> Section:
    """What orders the methods as their forgetting does."""
    answers = []
    words = {
        1: "orders the methods as forgetting does, more than chance would explain",
        0: "shows no certain agreement with forgetting on the order of the methods",
        -1: "orders the methods opposite to their forgetting",
    }
    found = [
        (name, which, one)
        for name, rows in boards.items()
        for which, members in (("", rows), (" without prior demonstrations", without_demonstrations(rows)))
        for one in predictions(members)
    ]
    for name, which, one in found:
        tau = f"Kendall's tau {tau_text(one)}, {counted(one.rows, 'method')}{which}"
        answers.append(f"On {name}, {one.predictor} {words[one.direction]} ({tau}).")
    if answers:
        answers.insert(
            0,
            "Here, forgetting is 1 minus the kept share. Both quantities come from the same runs, so p is "
            "simulated: it is the share of simulated boards with equal methods, and with the noise of these "
            "runs, that have such a tau. Methods differ in more than one way, for example in learning rate, "
            "so an order that agrees does not show what causes forgetting.",
        )
        answers += after_correction([one.chance for _, _, one in found])
        if any(row.method == "stop_gradient" for rows in boards.values() for row in rows):
            answers.append(
                "`stop_gradient` does not train the backbone, so by construction few of its weights change."
            )
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
        stages = "end at the criterion" if by_method[BASELINE].to_criterion else "have a fixed length"
        skills = ""
        if after["retention"].value is not None:
            skills = (
                f"success on the skills goes from {format_interval(before['retention'])} to "
                f"{format_interval(after['retention'])}, and "
            )
        answers.append(
            f"On {name}, where stages {stages}, {skills}the share of correct answers goes from "
            f"{format_interval(before['question_retention'])} to "
            f"{format_interval(after['question_retention'])}."
        )
    if answers:
        answers.insert(
            0, "All figures are for plain fine-tuning, before the first target and after the last one."
        )
    return Section("Are skills and knowledge lost together?", tuple(answers))


def _policies(board: Board) -> Section:
    """Whether forgetting depends on the policy: its action head, or its size."""
    answers, lines = [], []
    for name, every in by_table(board.rows).items():
        scenario, policy = table_parts(name)
        comparisons = [one for one in every if one.method != FROZEN]  # a policy that is not trained keeps all
        for one in comparisons:
            cells = [
                format_interval(estimate if one.seeds > 1 else Estimate(estimate.value, None, None))
                for estimate in (*one.estimates[FORGOTTEN_BY], *one.estimates["adaptation"][:2])
            ]
            lines.append((scenario, one.method, policy, *cells, str(one.seeds)))
        apart = [one.estimates[FORGOTTEN_BY][2] for one in comparisons if one.seeds > 1]
        if apart:
            lower = sum(one.is_below(0) for one in apart)
            higher = sum(one.is_above(0) for one in apart)
            answers.append(
                f"On {scenario} with {policy}, by their own intervals (not corrected for "
                f"{counted(len(apart), 'comparison')}), {lower} of {counted(len(apart), 'method')} "
                f"{'has' if lower == 1 else 'have'} a lower kept share than with the flow policy, and "
                f"{higher} {'has' if higher == 1 else 'have'} a higher one. The methods have the settings "
                "that were tuned for the flow policy, and their stages take different numbers of steps, so "
                "tuning may explain a difference. So may learning: what was never learned cannot be "
                "forgotten."
            )
        elif comparisons:
            answers.append(
                f"On {scenario} with {policy}, there is only one seed, which shows nothing for certain, so "
                "the table gives no interval."
            )
    head = (
        *("scenario", "method", "other policy", "kept share, flow", "kept share, other policy", "difference"),
        *("learned, flow", "learned, other policy", "seeds"),
    )
    return Section("Does forgetting depend on the policy?", tuple(answers), head, tuple(lines))


def _undecided(judged: Sequence[Judged]) -> Section:
    """What the records cannot tell."""
    answers = []
    reasons: tuple[tuple[Verdict, str], ...] = (
        ("undecided", "runs are missing, or the intervals are too wide"),
        ("cannot be shown here", "a condition of the rule is missing, and the page of the claims says which"),
    )
    for verdict, why in reasons:
        found = [one for one in judged if one.finding.verdict == verdict]
        ids = grouped((one.evidence.scenario, one.claim.id) for one in found)
        for scenario, names in sorted(ids.items()):
            answers.append(f"{scenario}: {', '.join(names)} {PREDICATES[verdict][len(names) > 1]}; {why}.")
    return Section("What can the records not tell?", tuple(answers))
