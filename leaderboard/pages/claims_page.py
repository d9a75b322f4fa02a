"""The page of the claims, their section in the findings, and their table in the terminal.

The same findings give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table as TerminalTable
from rich.text import Text

from clbench.base.text import counted, listed

from ..board.commands import run_command
from ..board.summary import grouped
from ..claims.claim import DECIDED, KNOWLEDGE, Claim, tally
from ..claims.evidence import LEAST_SEEDS, Figure
from ..claims.judges import Judged
from ..views.format import MISSING, format_interval
from ..views.sections import Section, Table, short
from ..views.templating import template

CHECKS = {"replayed": "replayed {}", "retrained": "repeated {} as a whole"}
"""What another process did with the records of a tier."""


def page(judged: Sequence[Judged], records: Path, controls: Path, *, published: bool) -> str:
    """Return the page as Markdown.

    Args:
        judged: Findings on the claims.
        records: Folder of the records, which commands on the page name.
        controls: Folder of the records with changed settings, likewise.
        published: Whether the records are the published ones: only then does the page tell how they came
            about.
    """
    by_claim = grouped((one.claim, one) for one in judged)
    refused = {entry.path: entry for one in judged for entry in one.evidence.not_used}
    return template(__file__, "claims.md.jinja").render(
        seeds=LEAST_SEEDS,
        tally=_tally(judged),
        verdicts=verdicts(judged),
        papers=grouped((claim.paper, (claim, members)) for claim, members in by_claim.items()).items(),
        not_used=list(refused.values()),
        missing=partial(_missing, records, controls),
        checked=_checked,
        published=published,
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


def _missing(records: Path, controls: Path, one: Judged) -> list[str]:
    """Return the commands that make what the figures of a finding lack in the folders of records."""
    figures = (*one.finding.figures, *one.finding.controls)
    labels = dict.fromkeys(label for figure in figures for label in figure.missing)
    plain = [label for label in labels if "+" not in label and "@" not in label]
    scenario = one.evidence.scenario
    groups = [plain, *([label] for label in labels if label not in plain)]
    commands = [run_command(scenario, *one, records=records, controls=controls) for one in groups if one]
    return [f"`{command}`." for command in commands]


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


def verdicts(judged: Sequence[Judged]) -> Table:
    """Return the table of the claims: what is measured, and on each board the verdict with its value."""
    boards = tuple(dict.fromkeys(one.evidence.scenario for one in judged))
    found = grouped((one.claim, one) for one in judged)
    lines = tuple(_verdict_line(claim, members, boards) for claim, members in found.items())
    return Table(("id", "claim", "measured quantity", *map(short, boards)), lines)


def _verdict_line(claim: Claim, judged: Sequence[Judged], boards: Sequence[str]) -> tuple[str, ...]:
    figures = [one.finding.figures[0] for one in judged if one.finding.figures]
    what = figures[0].what if figures else MISSING
    cells = {one.evidence.scenario: _verdict_cell(one, what) for one in judged}
    return (claim.id, claim.words, what, *(cells.get(board, "") for board in boards))


def _verdict_cell(one: Judged, what: str) -> str:
    """Return a verdict with the value of its first figure, if that is the figure `what` and has a value."""
    first = one.finding.figures[:1]
    shown = [figure for figure in first if figure.what == what and figure.estimate.value is not None]
    return ": ".join([one.finding.verdict, *map(figure_text, shown)])


# ---- the section of the findings ---------------------------------------------------------------------------

HOW_IT_WAS_MADE = (
    "FetchKnowledge-v1 was made to show claims on knowledge: its steps are large, and training goes on long "
    "after the target is learned."
)

UNDECIDED = (
    "A claim is undecided if runs are missing or intervals are too wide. It cannot be shown if a condition "
    "of its rule is missing."
)


def claims_section(judged: Sequence[Judged]) -> Section:
    """Return which claims of the papers hold, on which board, and what explains it."""
    answers = [
        f"{paper} has {tally(one.finding.verdict for one in every if not one.claim.uncounted)}."
        f"{_uncounted(every)}"
        for paper, every in grouped((one.claim.paper.name, one) for one in judged).items()
    ]
    explained = Table(("claim", "scenario", "verdict", "remark"), tuple(_explanations(judged)))
    tables = [table for table in (_plain(verdicts(judged)), explained) if table.lines]
    is_made = any(one.claim.scenarios == KNOWLEDGE for one in judged)
    notes = (UNDECIDED, HOW_IT_WAS_MADE) if is_made else (UNDECIDED,)
    question = "Which claims of the papers hold here?"
    return Section(question, tuple(answers), tuple(tables), notes if answers else ())


def _plain(table: Table) -> Table:
    """Return the table of the verdicts without its figures, which the page of the claims has."""
    head = (*table.head[:2], *table.head[3:])
    lines = ((*line[:2], *(cell.partition(":")[0] for cell in line[3:])) for line in table.lines)
    return Table(head, tuple(lines))


def _explanations(judged: Sequence[Judged]) -> list[tuple[str, ...]]:
    """Return the last conclusion from the figures and controls of each verdict that is a yes or a no."""
    told = grouped(
        ((one.claim.id, one.finding.verdict, sentence), short(one.evidence.scenario))
        for one in judged
        if one.finding.verdict in DECIDED
        for sentence in one.finding.sentences[-1:]
    )
    return [(claim, listed(boards), verdict, sentence) for (claim, verdict, sentence), boards in told.items()]


def _uncounted(judged: Sequence[Judged]) -> str:
    """Return in a sentence which claims are not counted, and why."""
    found = grouped((one.claim, one.finding.verdict) for one in judged if one.claim.uncounted)
    return "".join(
        f" {claim.id} is {claim.uncounted} and is not counted; it has {tally(given)}."
        for claim, given in found.items()
    )


# ---- the terminal ------------------------------------------------------------------------------------------


def terminal(judged: Sequence[Judged]) -> TerminalTable:
    """Return the short table: claim, scenario, verdict and the first figure."""
    table = TerminalTable(box=SIMPLE_HEAD, padding=0, pad_edge=False)
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
