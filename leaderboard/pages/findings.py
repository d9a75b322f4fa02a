"""The page of the findings: what the board, the ladder and the claims say together.

Each section asks one question and answers it from the records: in sentences, and in tables with every figure
and interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import TypeAlias

from clbench.base.text import counted, listed
from clbench.records.paths import table_parts
from clbench.scoring.intervals import Estimate
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.references import BASELINE, FROZEN

from ..board.certainty import sides_of_gains
from ..board.rows import Board, Row
from ..board.summary import WITH_DEMONSTRATIONS, WITHOUT_DEMONSTRATIONS, grouped, tables_of
from ..claims.claim import DECIDED, PREDICATES
from ..claims.evidence import Evidence
from ..claims.judges import Judged
from ..policies.compared import Comparison, by_table
from ..views.charts.picture import in_both_themes
from ..views.format import MISSING, format_over_seeds
from ..views.sections import Section, Table, short
from ..views.templating import template
from .agreements import orders_section, predictors_section
from .claims_page import claims_section
from .findings_charts import gains_chart, rates_chart
from .gains import by_gain, gains_section, is_tuned, replay_section, without_tied_runs
from .learning_rates import rates_section
from .lost_skills import lost_skills_section

FORGOTTEN_BY = "kept_share"
"""Metric by which policies are compared: the final average also counts what they knew and learned."""


def page(in_short: Sequence[str], sections: Sequence[Section], *, published: bool) -> str:
    """Return the page as Markdown: what `in_short` says, and the sections.

    Args:
        in_short: The answers that most readers look for.
        sections: All sections.
        published: Whether the records are the published ones: only then does the page tell how they came
            about.
    """
    values = {"in_short": in_short, "sections": sections, "published": published}
    return template(__file__, "findings.md.jinja").render(values)


def pictures(board: Board) -> dict[str, str]:
    """Return the pictures as SVG, for a light and a dark page, by the names of their files."""
    gains = {short(name): by_gain(rows) for name, rows in _boards(board).items()}
    drawn = in_both_themes("gains", gains_chart(gains)) if any(gains.values()) else {}
    curves = {short(name): curves for name, curves in board.frontiers.items()}
    return drawn | (in_both_themes("rates", rates_chart(curves)) if curves else {})


def sections(board: Board, judged: Sequence[Judged], evidence: Callable[[str], Evidence]) -> list[Section]:
    """Return the sections that the records can fill, at least in part.

    Args:
        board: The board of the records.
        judged: Findings on the claims.
        evidence: Returns the runs of the scenario with a Gymnasium id, those of the ladder included.
    """
    boards = _boards(board)
    found = (
        gains_section(boards, board.tied),
        replay_section(boards, board.tied),
        rates_section(board.frontiers, _usual(board), evidence),
        lost_skills_section(boards),
        claims_section(judged),
        orders_section(board, boards),
        predictors_section(board, boards),
        _knowledge(_usual(board)),
        _policies(board),
    )
    return [section for section in found if section.answers or section.tables]


def in_short(board: Board, judged: Sequence[Judged]) -> list[str]:
    """Return the answers that most readers look for; `sections` have their figures and limits."""
    boards = _boards(board)
    above: dict[str, list[Row]] = {}
    baseline = "tuned plain fine-tuning" if is_tuned(boards.values()) else "plain fine-tuning"
    for name, rows in boards.items():
        sides = sides_of_gains(rows, board.tied.get(name, {}))
        if others := by_gain(rows):
            above[name] = [row for row in others if sides.get(row.method) == 1]
    divisions = {"Without": WITHOUT_DEMONSTRATIONS, "With": WITH_DEMONSTRATIONS}
    answers = []
    for data, names in divisions.items() if above else ():
        best = {name: [row for row in rows if row.division in names][:1] for name, rows in above.items()}
        gains = grouped(
            (row.method, f"{format_over_seeds(row.estimates['gain'])} on {short(name)}")
            for name, rows in best.items()
            for row in rows
        )
        parts = [f"`{method}` gains {listed(texts)}" for method, texts in gains.items()]
        if none := [name for name, rows in best.items() if not rows]:
            parts.append(f"no method is certainly better than {baseline} on {listed(map(short, none))}")
        answers.append(f"{data} prior demonstrations: {'; '.join(parts)}.")
    return [*answers, *without_tied_runs(boards, board.tied), *_claims_in_short(judged)]


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


_Losses: TypeAlias = tuple[bool, str, tuple[float | None, float | None]]
"""Whether stages end at the criterion, the scenario, and the losses of skills and of answers."""


def _knowledge(boards: dict[str, list[Row]]) -> Section:
    """Return whether skills and answers to questions are lost together."""
    lines: list[tuple[str, ...]] = []
    losses: list[_Losses] = []
    for name, rows in boards.items():
        by_method = {row.method: row for row in rows}
        if BASELINE not in by_method or FROZEN not in by_method:
            continue
        after, before = (by_method[method].estimates for method in (BASELINE, FROZEN))
        if after["question_retention"].value is None:
            continue
        to_criterion = by_method[BASELINE].to_criterion
        skills, answers = ((before[one], after[one]) for one in ("retention", "question_retention"))
        losses.append((to_criterion, short(name), (_loss(*skills), _loss(*answers))))
        stages = "to the criterion" if to_criterion else "of a fixed length"
        lines.append((short(name), stages, _change(*skills), _change(*answers)))
    head = ("scenario", "stages", "success on the skills", "share of correct answers")
    notes = ("Plain fine-tuning, before the first target and after the last one.",) if lines else ()
    tables = (Table(head, tuple(lines)),) if lines else ()
    return Section("Are skills and knowledge lost together?", tuple(_largest_losses(losses)), tables, notes)


def _change(before: Estimate, after: Estimate) -> str:
    """Return the cell of a quantity before and after training."""
    return MISSING if after.value is None else f"{format_over_seeds(before)} to {format_over_seeds(after)}"


def _loss(before: Estimate, after: Estimate) -> float | None:
    """Return how much a quantity fell, None if it is missing."""
    return None if before.value is None or after.value is None else before.value - after.value


def _largest_losses(losses: Sequence[_Losses]) -> list[str]:
    """Return the largest losses of skills and of answers, for stages of each kind, with their scenarios."""
    sentences = []
    for kind, words in ((True, "end at the criterion"), (False, "have a fixed length")):
        found = [(name, lost) for is_kind, name, lost in losses if is_kind == kind]
        halves: list[str] = []
        for place, what in enumerate(("success on the skills", "the share of correct answers")):
            # a rise is no fall
            known = [(max(loss, 0.0), name) for name, lost in found if (loss := lost[place]) is not None]
            if known:
                loss, name = max(known, key=itemgetter(0))
                halves.append(f"{what}{'' if halves else ' falls'} by up to {loss:.2f} ({name})")
        if halves:
            sentences.append(f"Where stages {words}, {', and '.join(halves)}.")
    return sentences


def _policies(board: Board) -> Section:
    """Return whether forgetting depends on the policy: its action head, or its size."""
    answers, lines = [], []
    for name, every in by_table(board.rows).items():
        scenario, policy = table_parts(name)
        comparisons = [one for one in every if one.method != FROZEN]  # a policy that is not trained keeps all
        lines += [_policy_line(scenario, policy, one) for one in comparisons]
        answers += _of_a_policy(scenario, policy, comparisons)
    head = (
        *("scenario", "method", "other policy", "kept share, flow", "kept share, other policy", "difference"),
        *("learned, flow", "learned, other policy", "seeds"),
    )
    tables = (Table(head, tuple(lines)),) if lines else ()
    question = "Does forgetting depend on the policy?"
    return Section(question, tuple(answers), tables, (OTHER_REASONS,) if lines else ())


OTHER_REASONS = (
    "The methods have the settings that were tuned for the flow policy, and their stages take different "
    "numbers of steps, so tuning may explain a difference. So may learning: what was never learned cannot be "
    "forgotten."
)


def _policy_line(scenario: str, policy: str, one: Comparison) -> tuple[str, ...]:
    """Return the cells of a method."""
    estimates = (*one.estimates[FORGOTTEN_BY], *one.estimates["adaptation"][:2])
    cells = map(format_over_seeds, estimates)
    return (short(scenario), f"`{one.method}`", policy, *cells, str(one.seeds))


def _of_a_policy(scenario: str, policy: str, comparisons: Sequence[Comparison]) -> list[str]:
    """Return how many methods forget more, and how many less, with a policy than with the default one."""
    if not comparisons:
        return []
    apart = [one.estimates[FORGOTTEN_BY][2] for one in comparisons if one.seeds > 1]
    if not apart:
        return [
            f"On {short(scenario)} with {policy}, there is only one seed, so the table gives no interval."
        ]
    lower = sum(one.is_below(0) for one in apart)
    higher = sum(one.is_above(0) for one in apart)
    return [
        f"On {short(scenario)} with {policy}, by their own intervals (not corrected for "
        f"{counted(len(apart), 'comparison')}), {lower} of {counted(len(apart), 'method')} "
        f"{'has' if lower == 1 else 'have'} a lower kept share than with the flow policy, and {higher} "
        f"{'has' if higher == 1 else 'have'} a higher one."
    ]
