"""The page of the claims and their table in the terminal. The same findings give the same bytes."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from clbench.base.text import counted, listed

from ..board.commands import run_command
from ..board.summary import grouped
from ..claims.claim import tally
from ..claims.evidence import LEAST_SEEDS, Figure
from ..claims.judges import Judged
from ..views.format import MISSING, format_interval
from ..views.templating import template

CHECKS = {"replayed": "replayed {}", "retrained": "repeated {} as a whole"}
"""What another process did with the records of a tier."""


def page(judged: Sequence[Judged]) -> str:
    """Return the page as Markdown."""
    by_claim = grouped((one.claim, one) for one in judged)
    refused = {entry.path: entry for one in judged for entry in one.evidence.not_used}
    return template(__file__, "claims.md.jinja").render(
        seeds=LEAST_SEEDS,
        tally=_tally(judged),
        judged=judged,
        papers=grouped((claim.paper, (claim, members)) for claim, members in by_claim.items()).items(),
        not_used=list(refused.values()),
        missing=_missing,
        checked=_checked,
    )


def _tally(judged: Sequence[Judged]) -> list[str]:
    """Return sentences for each scenario: claims by verdict, and how many rules knew its records."""
    sentences = []
    for scenario in dict.fromkeys(one.evidence.scenario for one in judged):
        here = [one for one in judged if one.evidence.scenario == scenario]
        verdicts = tally(one.finding.verdict for one in here)
        sentences.append(f"{scenario} has {verdicts}. {_corrected(here)}".rstrip())
    return sentences


def _corrected(here: Sequence[Judged]) -> str:
    """Return how many rules changed after the first record of the scenario that they judge."""
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


def _checked(one: Judged) -> list[str]:
    """Return how many records behind a finding were replayed or repeated; nothing if there are none."""
    read = {
        (label, seed)
        for figure in (*one.finding.figures, *one.finding.controls)
        for label in figure.methods
        for seed in figure.seeds
    }
    runs = one.evidence.runs
    tiers = [runs[label][seed].tier for label, seed in read if seed in runs.get(label, {})]
    if not tiers:
        return []
    counts = ((tiers.count(tier), words) for tier, words in CHECKS.items())
    done = listed([words.format(count) for count, words in counts if count]) or "replayed none"
    return [f"Of the {counted(len(tiers), 'record')} behind the figures, another process {done}."]


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
