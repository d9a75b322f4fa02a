"""The page and the terminal's table of the claims. The same findings give the same bytes."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby

from rich.box import SIMPLE_HEAD
from rich.table import Table as Grid
from rich.text import Text

from ..board.costs import STEP_TIME
from ..views.markdown import grid, linked, prose, run_command
from ..views.table import MISSING, escaped, interval
from .claim import CLAIMS, Claim, Finding, Paper
from .evidence import LEAST_SEEDS, Evidence, Figure
from .judges import LATER

Findings = Mapping[str, Finding]

STEP_TIME_COMMAND = "make benchmark"
"""What leaves the step times."""


def page(evidence: Evidence, findings: Findings) -> str:
    """Return the page as Markdown."""
    head = [
        "# Claims",
        "",
        prose(
            f"What the records of {evidence.scenario} say to the claims of the papers. Made by `clbench "
            "claims` from records alone, each verdict by a rule that was in the code before the records. "
            "Numbers are means over seeds with 95 % intervals over seeds (docs/guide/statistics.md); "
            "differences and ratios are paired by seed and episode. Where a rule asks for an interval, it "
            f"needs {LEAST_SEEDS} seeds. Matched adaptation: each method is looked at where it first reaches "
            "90 % of what sft reaches on the target. A control does what the method does, but for the one "
            f"thing that is to explain its success. `{MISSING}` stands for what could not be computed."
        ),
        "",
        *grid(
            ("id", "claim", "verdict", "here", "in the paper"),
            [_summary(claim, findings[claim.id]) for claim in CLAIMS.values()],
        ),
    ]
    parts = []
    for paper, claims in groupby(CLAIMS.values(), key=lambda claim: claim.paper):
        parts += ["", f"## {_of(paper)}"]
        parts += [line for claim in claims for line in _section(evidence, claim, findings[claim.id])]
    for identifier, (paper, words) in LATER.items():
        parts += ["", f"## {_of(paper)}", "", f"### {identifier}", "", prose(f"{words} Later work.")]
    return "\n".join([*head, *parts, *_not_used(evidence)]) + "\n"


def _summary(claim: Claim, finding: Finding) -> tuple[str, ...]:
    here = number_text(finding.figures[0]) if finding.figures else MISSING
    return (
        f"[{claim.id}](#{claim.id.lower()})",
        prose(claim.words),
        finding.verdict,
        here,
        prose(claim.reported),
    )


def _of(paper: Paper) -> str:
    return f"{prose(paper.name)} ({', '.join(linked(f'arXiv {one}') for one in paper.arxiv)})"


def _section(evidence: Evidence, claim: Claim, finding: Finding) -> list[str]:
    """Return all that is known of a claim."""
    lines = [
        "",
        f"### {claim.id}",
        "",
        f"{prose(claim.words)} **{finding.verdict.capitalize()}.**",
        "",
        f"- Rule: {prose(claim.rule)}",
        f"- In the paper: {prose(claim.reported)}.",
        *(f"- {prose(sentence)}" for sentence in finding.sentences),
        *(f"- {prose(words)}" for words in finding.missing),
        *(f"- Missing: {words}" for words in _missing(evidence, finding)),
    ]
    rows = [_row(figure, "") for figure in finding.figures]
    rows += [_row(figure, "control: ") for figure in finding.controls]
    return [*lines, "", *grid(("figure", "value", "seeds", "note"), rows)] if rows else lines


def _row(figure: Figure, role: str) -> tuple[str, ...]:
    seeds = ", ".join(map(str, figure.seeds)) or MISSING
    return role + prose(figure.what), number_text(figure), seeds, prose(figure.note)


def number_text(figure: Figure) -> str:
    return interval(figure.estimate, figure.form)


def _missing(evidence: Evidence, finding: Finding) -> list[str]:
    """Return what the figures of a finding lack, with the commands that make it."""
    labels = dict.fromkeys(
        label for figure in (*finding.figures, *finding.controls) for label in figure.missing
    )
    plain = [label for label in labels if "+" not in label and label != "step time"]
    changed = [label for label in labels if "+" in label]
    lines = [f"`{run_command(evidence.scenario, *plain)}`."] if plain else []
    lines += [f"`{run_command(evidence.scenario, label)}`." for label in changed]
    if "step time" in labels:
        lines.append(f"`{STEP_TIME_COMMAND}`, which leaves `{STEP_TIME.as_posix()}`.")
    return lines


def _not_used(evidence: Evidence) -> list[str]:
    if not evidence.not_used:
        return []
    entries = [f"- {escaped(entry.path)}: {escaped(entry.reason)}" for entry in evidence.not_used]
    return ["", "## Records not used", "", *entries]


def terminal(findings: Findings) -> Grid:
    """Return the short table: id, verdict, our figure."""
    table = Grid(box=SIMPLE_HEAD, padding=0, pad_edge=False)
    table.add_column("id")
    table.add_column("verdict", no_wrap=True)
    table.add_column("here", no_wrap=True)
    table.add_column("of what", overflow="fold")
    for identifier, finding in findings.items():
        figure = finding.figures[0] if finding.figures else None
        table.add_row(
            Text(f"{identifier} "),
            Text(f"{finding.verdict}  "),
            Text(f"{number_text(figure)}  " if figure else MISSING),
            Text(figure.what if figure else ""),
        )
    return table
