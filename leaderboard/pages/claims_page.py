"""The page of the claims and their table in the terminal. The same findings give the same bytes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from ..board.commands import run_command
from ..claims.claim import tally
from ..claims.evidence import LEAST_SEEDS, Figure
from ..claims.judges import CLAIMS, Judged
from ..views.format import MISSING, format_interval
from ..views.markdown import templates

CORRECTED = ("C2", "C3", "C4", "C6", "C7", "C8", "A7", "F1", "F2", "F3", "F5", "F6")
"""Claims whose rules were corrected with the records known: docs/history.md says how."""

INTRODUCTION = (
    "How the claims of the papers fare here, with a policy of less than a million parameters. Generated "
    "by `clbench claims` from the records alone; each verdict follows from a rule. The rules were written "
    "before the records of these boards, but {corrected} of {claims} were corrected with the records known: "
    "docs/history.md says how, and that boards got more seeds after a first look. `sft` is plain "
    "fine-tuning. Most claims are judged on scenarios whose stages end when the target is learned, so that "
    "methods are compared at equal learning: each at the settings that tuning chose, or at one learning "
    "rate, written as `sft@0.3` for sft at 0.3 of the scenario's learning rate. `lora+rank=4` is lora with "
    "one setting changed. On clbench/FetchKnowledge-v1 no setting was tuned. Numbers are means over seeds "
    "with 95 % confidence intervals over seeds (docs/guide/statistics.md); differences and ratios are paired "
    "by seed and episode. Each verdict takes its intervals alone, without correction for the number of "
    "verdicts: where a true value lies at the bar of a rule, one interval in 40 is wrongly beyond it. "
    'A rule that asks for an interval needs {seeds} seeds. "Cannot be shown here" means that the '
    "setting could not have shown the claim, whether it is true or not. A control is the method without "
    "the one ingredient that is supposed to explain its success. `{missing}` marks a value that could not "
    "be computed."
)
"""Text above the table."""


def page(judged: Sequence[Judged]) -> str:
    """Return the page as Markdown."""
    template = templates(Path(__file__).with_name("templates")).get_template("claims.md.jinja")
    by_claim = [(claim, list(members)) for claim, members in groupby(judged, key=lambda one: one.claim)]
    refused = {entry.path: entry for one in judged for entry in one.evidence.not_used}
    return template.render(
        introduction=INTRODUCTION.format(
            corrected=len(CORRECTED), claims=len(CLAIMS), seeds=LEAST_SEEDS, missing=MISSING
        ),
        tally=_tally(judged),
        judged=judged,
        papers=groupby(by_claim, key=lambda pair: pair[0].paper),
        not_used=list(refused.values()),
        missing=_missing,
    )


def _tally(judged: Sequence[Judged]) -> list[str]:
    """Return a sentence for each scenario with the number of claims by verdict."""
    sentences = []
    for scenario in dict.fromkeys(one.evidence.scenario for one in judged):
        verdicts = (one.finding.verdict for one in judged if one.evidence.scenario == scenario)
        sentences.append(f"{scenario}: {tally(verdicts)}.")
    return sentences


def _missing(one: Judged) -> list[str]:
    """Return the commands that make what the figures of a finding lack."""
    figures = (*one.finding.figures, *one.finding.controls)
    labels = dict.fromkeys(label for figure in figures for label in figure.missing)
    plain = [label for label in labels if "+" not in label and "@" not in label]
    scenario = one.evidence.scenario
    lines = [f"`{run_command(scenario, *plain)}`."] if plain else []
    lines += [f"`{run_command(scenario, label)}`." for label in labels if label not in plain]
    return lines


def figure_text(figure: Figure) -> str:
    """Return the value of a figure with its interval."""
    return format_interval(figure.estimate, figure.form)


def terminal(judged: Sequence[Judged]) -> Table:
    """Return the short table: claim, scenario, verdict and the first figure."""
    table = Table(box=SIMPLE_HEAD, padding=0, pad_edge=False)
    table.add_column("id")
    table.add_column("scenario", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column("figure")  # value and name in one column: two columns leave the name 6 of 80 characters
    for one in judged:
        figure = one.finding.figures[0] if one.finding.figures else None
        table.add_row(
            Text(f"{one.claim.id} "),
            Text(f"{one.evidence.scenario.rpartition('/')[2]} "),
            Text(f"{one.finding.verdict} "),
            Text(f"{figure_text(figure)} {figure.what}" if figure else MISSING),
        )
    return table
