"""A page for each method, from its code and its records. The same content gives the same bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jinja2 import Template

from clbench.scoring.intervals import Estimate
from clbench.scoring.metrics import measure

from ..board.rows import Row, Table
from ..board.runs import DIVISIONS, Run, is_number, printable, read_run, read_runs
from ..claims.evidence import Evidence
from ..claims.judges import Judged
from ..views.descriptions import COMMON, Description, common_hyper_parameters, of_one_module
from ..views.format import shown
from ..views.markdown import arxiv_ids, templates
from .commands import run_command

COMPARISONS = ("sft", "experience_replay", "frozen")
"""Methods whose rows are next to the method's own."""

TRIED = ("adaptation", "retention", "retention_at_matched_adaptation", "question_retention")
"""Metrics that settings are compared by."""

USED = {
    "never": "It never uses prior {}.",
    "prepare": "It reads prior {} only before the first target.",
    "throughout": "It reads prior {} throughout, so all of them count as kept.",
}
"""Sentence for each access to prior data."""


@dataclass(frozen=True, eq=False)
class Sources:
    """Sources of the pages besides the code."""

    evidence: Evidence
    """Records of the scenario."""
    judged: Sequence[Judged]
    """Findings on the claims."""
    rows: Mapping[str, Row]
    """Rows of the board by method."""
    tuning: Sequence[Run]
    """Runs on validation episodes; their method is a label, for example "consft+tau_start=0.1"."""


@dataclass(frozen=True)
class Part:
    """The part that a method has in a claim."""

    id: str
    """Identifier of the claim."""
    words: str
    """The claim in our words."""
    verdict: str
    """Verdict on the claim."""
    subject: bool
    """Whether the claim is about the method; if not, its figures only compare with the method."""


@dataclass(frozen=True)
class Tried:
    """Settings that were compared on validation episodes."""

    settings: str
    """Changed settings, with the methods that have them by default."""
    seed: int
    """Seed of the run."""
    targets: int
    """Number of targets that were learned."""
    metrics: tuple[float | None, ...]
    """Values of the metrics in `TRIED`."""


def read_sources(evidence: Evidence, judged: Sequence[Judged], board: Table, tuning: Path) -> Sources:
    """Return the sources; a missing folder counts as empty."""
    runs, _ = read_runs(tuning, partial(read_run, split="validation", changed=None), ())
    rows = {row.method: row for row in board.rows if row.scenario == evidence.scenario}
    return Sources(evidence, judged, rows, [run for run in runs if run.scenario == evidence.scenario])


def pages(methods: Sequence[Description], sources: Sources) -> dict[str, str]:
    """Return the pages by file name."""
    of_methods = {f"{method.name}.md": _page(method, methods, sources) for method in methods}
    return {"README.md": _contents(methods), **of_methods}


def _contents(methods: Sequence[Description]) -> str:
    """Return the list of all methods by division."""
    divisions = {name: [one for one in methods if one.division == name] for name in DIVISIONS}
    present = {name: members for name, members in divisions.items() if members}
    return _template("methods.md.jinja").render(divisions=present, common=common_hyper_parameters())


def _page(method: Description, methods: Sequence[Description], sources: Sources) -> str:
    """Return the page of one method."""
    text, uses, scenario = method.text, method.cls.uses, sources.evidence.scenario
    papers = arxiv_ids(" ".join((text.idea, *text.rule)))
    names = [name for name in dict.fromkeys((method.name, *COMPARISONS)) if name in sources.rows]
    return _template("method.md.jinja").render(
        method=method,
        papers=papers,
        other_papers=[one for one in arxiv_ids(" ".join(text.details)) if one not in papers],
        uses=[
            USED[when].format(kind)
            for kind, when in (("demonstrations", uses.demonstrations), ("questions", uses.questions))
        ],
        costs=sources.rows[method.name].costs if method.name in sources.rows else {},
        diagnostics=_diagnostics(method, sources),
        scenario=scenario,
        rows=[sources.rows[name] for name in names] if method.name in names else [],
        shown=shown,
        command=run_command(scenario, method.name),
        claims=_claims(method, sources),
        tried=_tried(method, methods, sources),
        tried_metrics=TRIED,
        commands=_commands(method, sources),
    )


def _template(name: str) -> Template:
    return templates(Path(__file__).with_name("templates")).get_template(name)


def _diagnostics(method: Description, sources: Sources) -> dict[str, Estimate]:
    """Return the means of the numbers among the method's diagnostics, by name."""
    if not method.hook("diagnostics"):
        return {}
    runs = sources.evidence.runs.get(method.name, {}).values()
    stages = [stage for run in runs for stage in run.record.diagnostics.values() if isinstance(stage, dict)]
    names = dict.fromkeys(name for stage in stages for name, value in stage.items() if is_number(value))
    return {name: _mean_diagnostic(method.name, name, sources) for name in names}


def _mean_diagnostic(method: str, name: str, sources: Sources) -> Estimate:
    figure = sources.evidence.diagnostic(method, f"{name} of {method}", lambda stage: stage.get(name))
    return figure.estimate


# ---- claims ------------------------------------------------------------------------------------------------


def _claims(method: Description, sources: Sources) -> list[Part]:
    """Return the part of the method in each claim, the claims about the method first."""
    parts: dict[str, Part] = {}
    for one in sources.judged:
        finding = one.finding
        about = {_base(label) for label in finding.about}
        about |= {_base(figure.methods[0]) for figure in finding.figures}
        compared = {
            _base(label) for figure in (*finding.figures, *finding.controls) for label in figure.methods
        }
        if method.name not in about | compared:
            continue
        verdict = f"{finding.verdict} ({one.evidence.scenario.rpartition('/')[2]})"
        known = parts.get(one.claim.id)
        parts[one.claim.id] = Part(
            one.claim.id,
            one.claim.words,
            f"{known.verdict}, {verdict}" if known else verdict,
            subject=method.name in about or (known is not None and known.subject),
        )
    return sorted(parts.values(), key=lambda part: not part.subject)


def _base(label: str) -> str:
    return label.partition("+")[0].partition("@")[0]


# ---- settings ----------------------------------------------------------------------------------------------


def _tried(method: Description, methods: Sequence[Description], sources: Sources) -> list[Tried]:
    """Return the settings that were compared on validation episodes."""
    mates = {one.name: one for one in of_one_module(methods, method)}
    runs = [run for run in sources.tuning if run.record.run.method in mates and _has_changes(run)]
    rows = []
    for seed in sorted({run.seed for run in runs}):
        baseline = next((run for run in sources.tuning if (run.method, run.seed) == ("sft", seed)), None)
        members = sorted((run for run in runs if run.seed == seed), key=_order)
        rows += [_tried_row("sft, unchanged", baseline, baseline)] if baseline else []
        rows += [_tried_row(_settings(run, mates), run, baseline) for run in members]
    return rows


def _has_changes(run: Run) -> bool:
    return bool(run.record.run.changes)


def _order(run: Run) -> list[tuple[str, str, float, str]]:
    """Return the sort key of settings: numbers by size."""
    changes = sorted(run.record.run.changes.items())
    return [
        (run.record.run.method, name, value if is_number(value) else 0.0, str(value))
        for name, value in changes
    ]


def _settings(run: Run, mates: Mapping[str, Description]) -> str:
    """Return the changed settings, and the methods of the module that have exactly these."""
    changes = ", ".join(f"{name} = {value}" for name, value in sorted(run.record.run.changes.items()))
    settings = {**COMMON, **run.record.run.settings}  # an older record lacks what was added later
    same = [name for name, one in mates.items() if one.defaults == settings]
    return changes + (f" ({' and '.join(same)})" if same else "")


def _tried_row(settings: str, run: Run, baseline: Run | None) -> Tried:
    comparable = baseline is not None and baseline.scores.layout == run.scores.layout
    references = {"sft": baseline.scores} if comparable and baseline else {}
    values = tuple(measure(name, run.scores, references) for name in TRIED)
    return Tried(settings, run.seed, len(run.scores.layout.target), values)


def _commands(method: Description, sources: Sources) -> list[str]:
    """Return the commands that make the records, also for the settings tried."""
    scenario = sources.evidence.scenario
    lines = [run_command(scenario, method.name)]
    runs = [run for run in sources.tuning if run.record.run.method == method.name and _has_changes(run)]
    tried: dict[str, dict[str, None]] = {}
    for run in sorted(runs, key=_order):
        for name, value in run.record.run.changes.items():
            tried.setdefault(printable(name), {})[printable(str(value))] = None
    if tried:
        values = [f"--values.{name} {','.join(values)}" for name, values in sorted(tried.items())]
        targets = max(len(run.scores.layout.target) for run in runs)
        lines.append(" ".join(["clbench tune", scenario, method.name, *values, f"--targets {targets}"]))
    return lines
