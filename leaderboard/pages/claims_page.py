"""The page of the claims and their table in the terminal. The same findings give the same bytes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from clbench.base.text import counted

from ..board.commands import run_command
from ..claims.claim import tally
from ..claims.evidence import LEAST_SEEDS, Figure
from ..claims.judges import Judged
from ..views.format import MISSING, format_interval
from ..views.markdown import templates

INTRODUCTION = (
    "This page judges claims of papers with a policy of less than a million parameters. Generated "
    "by `clbench claims` from the records alone; each verdict follows from a rule. The rules were written "
    "before the records of these boards, but some changed later: the list says how many, each rule says "
    "when, and docs/history.md says why. On 2026-11-26, changed rules turned 15 of 41 verdicts without a "
    'new record, 13 of them into "cannot be shown here"; docs/history.md lists them, and says that boards '
    "got more seeds after a first look. `sft` is plain fine-tuning. Most claims are judged on scenarios "
    "whose stages end when the target is learned, so that methods are compared at equal learning: each at "
    "the settings that tuning chose, or at one learning rate, written as `sft@0.3` for sft at 0.3 of the "
    "scenario's learning rate. `lora+rank=4` is lora with one setting changed. On "
    "clbench/FetchKnowledge-v1 no setting was tuned. Numbers are means over seeds with 95 % confidence "
    "intervals over seeds (docs/guide/statistics.md); differences and ratios are paired by seed and "
    "episode. Each verdict takes its intervals alone, without correction for the number of verdicts and "
    "controls: where a true value lies at the bar of a rule, one interval in 40 is wrongly beyond it. A "
    'rule that asks for an interval needs {seeds} seeds. "Cannot be shown here" means that a condition of '
    "the rule is missing, so that no figure speaks for or against the claim; a sentence says which. "
    "`consft` is the published loss with a tuned first temperature, as its authors tune it. "
    "`consft_calibrated` has the published constants, and multiplies the loss inside the weight by a "
    "tuned factor, because the published constants leave nearly all weights of this small policy at their "
    "floor. A claim on ConSFT holds by an arm that counts on its board, and fails only if both arms do. "
    "On clbench/MetaWorld-v1, most of what is lost is in skills whose opposite or variant is a target, "
    "and joint training loses some of it, too (docs/guide/metaworld.md): verdicts there say little about "
    "skills that have nothing to do with the targets. A control is the method without the one ingredient "
    "that is supposed to explain its success. `{missing}` marks a value that could not be computed."
)
"""Text above the table."""


def page(judged: Sequence[Judged]) -> str:
    """Return the page as Markdown."""
    template = templates(Path(__file__).with_name("templates")).get_template("claims.md.jinja")
    by_claim = [(claim, list(members)) for claim, members in groupby(judged, key=lambda one: one.claim)]
    refused = {entry.path: entry for one in judged for entry in one.evidence.not_used}
    return template.render(
        introduction=INTRODUCTION.format(seeds=LEAST_SEEDS, missing=MISSING),
        tally=_tally(judged),
        judged=judged,
        papers=groupby(by_claim, key=lambda pair: pair[0].paper),
        not_used=list(refused.values()),
        missing=_missing,
    )


def _tally(judged: Sequence[Judged]) -> list[str]:
    """Return sentences for each scenario: claims by verdict, and how many rules knew its records."""
    sentences = []
    for scenario in dict.fromkeys(one.evidence.scenario for one in judged):
        here = [one for one in judged if one.evidence.scenario == scenario]
        verdicts = tally(one.finding.verdict for one in here)
        sentences.append(f"{scenario}: {verdicts}. {_corrected(here)}".rstrip())
    return sentences


def _corrected(here: Sequence[Judged]) -> str:
    """Return how many rules changed after the first record of the scenario on which they judge."""
    began = here[0].evidence.began
    if began is None:
        return ""
    later = sum(1 for one in here if one.claim.settled > began)
    first = f"The first record used here dates from {began:%Y-%m-%d}"
    return f"{first}; {later or 'none'} of the {counted(len(here), 'rule')} changed after it."


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
