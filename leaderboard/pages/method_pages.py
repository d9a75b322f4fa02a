"""A page for each method, from its code and its records. The same content gives the same bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from clbench.scoring.metrics import measure

from ..board.rows import Row, Table
from ..board.runs import DIVISIONS, Run, is_number, printable, read_run, read_runs
from ..claims.claim import CLAIMS, Finding
from ..claims.evidence import Evidence
from ..views.markdown import arxiv_ids, grid, linked, prose, run_command
from ..views.table import MISSING, escaped, interval, number_text, shown, title_of
from .descriptions import Description, of_one_module

HEADINGS = (
    "Idea",
    "Paper",
    "Rule",
    "Stored",
    "Implementation details",
    "Hyper-parameters",
    "Diagnostics",
    "Results here",
    "Command",
)
"""Of every page, in this order."""

BESIDE = ("sft", "experience_replay", "frozen")
"""Methods whose rows stand beside every other's."""

TRIED = ("adaptation", "retention", "retention_at_matched_adaptation", "question_retention")
"""Metrics that settings are compared by."""

USED = {
    "never": "It never touches prior {}.",
    "prepare": "It reads prior {} before the first target only.",
    "throughout": "It reads prior {} all the time, so that all of them count as kept.",
}


@dataclass(frozen=True, eq=False)
class Sources:
    """What pages are made from besides the code."""

    evidence: Evidence
    """Records of the scenario."""
    findings: Mapping[str, Finding]
    """What they say to the claims, by id."""
    rows: Mapping[str, Row]
    """Rows of the board by method."""
    tuning: Sequence[Run]
    """Runs on validation episodes; their method is a label, as "consft+tau_start=0.1"."""


def read_sources(evidence: Evidence, findings: Mapping[str, Finding], board: Table, tuning: Path) -> Sources:
    """Return the sources; a folder that is not there holds no runs."""
    runs, _ = read_runs(tuning, partial(read_run, split="validation", changed=None), ())
    rows = {row.method: row for row in board.rows if row.scenario == evidence.scenario}
    return Sources(evidence, findings, rows, [run for run in runs if run.scenario == evidence.scenario])


def pages(methods: Sequence[Description], sources: Sources) -> dict[str, str]:
    """Return the pages by file name."""
    of_methods = {f"{method.name}.md": _page(method, methods, sources) for method in methods}
    return {"README.md": _contents(methods), **of_methods}


def _contents(methods: Sequence[Description]) -> str:
    """Return the list of all methods by division."""
    lines = ["# Methods", "", prose("Made by `clbench method-pages` from the code and the records.")]
    for division in DIVISIONS:
        members = [method for method in methods if method.division == division]
        if members:
            lines += ["", f"## {division.capitalize()}", ""]
            lines += [f"- [{escaped(one.name)}]({one.name}.md): {prose(one.summary)}" for one in members]
    return "\n".join(lines) + "\n"


def _page(method: Description, methods: Sequence[Description], sources: Sources) -> str:
    """Return the page of one method."""
    text = method.text
    parts = (
        [prose(text.idea), "", prose(method.summary)],
        _paper(method),
        _paragraphs(text.rule) or ["All of it is in the idea and the details."],
        _stored(method, sources),
        [f"{number}. {prose(item)}" for number, item in enumerate(text.details, 1)] or ["None."],
        _hyper_parameters(method),
        _diagnostics(method, sources),
        _results(method, methods, sources),
        _commands(method, sources),
    )
    lines = [f"# {escaped(method.name)}"]
    for heading, part in zip(HEADINGS, parts, strict=True):
        lines += ["", f"## {heading}", "", *part]
    return "\n".join(lines) + "\n"


def _paragraphs(texts: Sequence[str]) -> list[str]:
    """Return the lines of paragraphs with blank lines between."""
    return [line for text in texts for line in ("", prose(text))][1:]


def _paper(method: Description) -> list[str]:
    main = arxiv_ids(" ".join((method.text.idea, *method.text.rule)))
    others = [one for one in arxiv_ids(" ".join(method.text.details)) if one not in main]
    lines = [f"{_links(main)}."] if main else ["None: it is part of the benchmark."]
    return [*lines, "", f"In the details: {_links(others)}."] if others else lines


def _links(ids: Sequence[str]) -> str:
    return ", ".join(linked(f"arXiv {one}") for one in ids)


def _stored(method: Description, sources: Sources) -> list[str]:
    """Return what the method may look at again, and what it keeps and adds."""
    uses = method.cls.uses
    lines = [
        f"- {USED[when].format(kind)}"
        for kind, when in (("demonstrations", uses.demonstrations), ("questions", uses.questions))
    ]
    lines.append(f"- Division: {method.division}.")
    lines += [f"- Handed from stage to stage: {prose(words)}" for words in method.hook("state")[:1]]
    costs = sources.rows[method.name].costs if method.name in sources.rows else {}
    for name, words in (("bytes_kept", "Bytes kept"), ("parameters_added", "Parameters added")):
        value = number_text(costs[name], ",.0f") if name in costs else "no records yet"
        lines.append(f"- {words}: {value}.")
    return lines


def _hyper_parameters(method: Description) -> list[str]:
    if not method.hyper_parameters:
        return ["None."]
    rows = [(f"`{one.name}`", f"`{one.default}`", prose(one.meaning)) for one in method.hyper_parameters]
    return grid(("name", "default", "meaning"), rows)


def _diagnostics(method: Description, sources: Sources) -> list[str]:
    """Return what the method tells about itself, and the means of what is a number."""
    texts = method.hook("diagnostics")
    if not texts:
        return ["None."]
    runs = sources.evidence.runs.get(method.name, {}).values()
    stages = [stage for run in runs for stage in run.record.diagnostics.values() if isinstance(stage, dict)]
    names = dict.fromkeys(name for stage in stages for name, value in stage.items() if is_number(value))
    figures = {
        name: sources.evidence.diagnostic(name, method.name, f"{name} of {method.name}") for name in names
    }
    rows = [(escaped(name), interval(figure.estimate, ".4g")) for name, figure in figures.items()]
    table = ["", *grid(("mean over stages and seeds", "value"), rows, 1)] if rows else []
    return [*_paragraphs(texts), *table]


# ---- results -----------------------------------------------------------------------------------------------


def _results(method: Description, methods: Sequence[Description], sources: Sources) -> list[str]:
    """Return the method's row beside others, the claims it has a part in, and the settings tried."""
    command = run_command(sources.evidence.scenario, method.name)
    board = _board(method, sources) or [f"There are no records of it yet: `{command}` makes them."]
    claims, tried = _claims(method, sources), _tried(method, methods, sources)
    if claims:
        claims = ["", "### Claims", "", *claims]
    if tried:
        tried = ["", "### Settings tried", "", *tried]
    return [*board, *claims, *tried]


def _board(method: Description, sources: Sources) -> list[str]:
    if method.name not in sources.rows:
        return []
    names = [name for name in dict.fromkeys((method.name, *BESIDE)) if name in sources.rows]
    rows = [sources.rows[name] for name in names]
    table = [
        (title_of(one.name), *(interval(row.estimates[one.name]) for row in rows)) for one in shown(rows)
    ]
    table.append(("seeds", *(str(len(row.seeds)) for row in rows)))
    scenario = escaped(sources.evidence.scenario)
    return [f"On {scenario}, with 95 % intervals:", "", *grid(("", *map(escaped, names)), table, len(names))]


def _claims(method: Description, sources: Sources) -> list[str]:
    """Return a line for each claim that the method has a part in, those that it is about first."""
    subject, part = [], []
    for identifier, finding in sources.findings.items():
        line = (
            f"- [{identifier}](../claims.md#{identifier.lower()}), {finding.verdict}: "
            f"{prose(CLAIMS[identifier].words)}"
        )
        about = {_base(label) for label in finding.about}
        about |= {_base(figure.methods[0]) for figure in finding.figures}
        figures = (*finding.figures, *finding.controls)
        if method.name in about:
            subject.append(line)
        elif any(method.name == _base(label) for figure in figures for label in figure.methods):
            part.append(f"{line} It stands beside.")
    return subject + part


def _base(label: str) -> str:
    return label.partition("+")[0]


def _tried(method: Description, methods: Sequence[Description], sources: Sources) -> list[str]:
    """Return the table of the settings that were compared on validation episodes, none if there were none."""
    mates = {one.name: one for one in of_one_module(methods, method)}
    runs = [run for run in sources.tuning if run.record.run["method"] in mates and _has_changes(run)]
    if not runs:
        return []
    rows = []
    for seed in sorted({run.seed for run in runs}):
        baseline = next((run for run in sources.tuning if (run.method, run.seed) == ("sft", seed)), None)
        members = sorted((run for run in runs if run.seed == seed), key=_order)
        rows += [_tried_row("sft, as it is", baseline, baseline)] if baseline else []
        rows += [_tried_row(_settings(run, mates), run, baseline) for run in members]
    return [
        "On validation episodes, with seeds that no board reports; choices were made here and nowhere else.",
        "",
        *grid(("settings", "seed", "targets", *map(title_of, TRIED)), rows, 2 + len(TRIED)),
    ]


def _has_changes(run: Run) -> bool:
    return bool(run.record.run["changes"])


def _order(run: Run) -> list[tuple[str, str, float, str]]:
    """Return what settings are sorted by: numbers by size."""
    changes = sorted(run.record.run["changes"].items())
    return [
        (run.record.run["method"], name, value if is_number(value) else 0.0, str(value))
        for name, value in changes
    ]


def _settings(run: Run, mates: Mapping[str, Description]) -> str:
    """Return the changed settings, and the methods of the module that have just these."""
    changes = ", ".join(f"{name} = {value}" for name, value in sorted(run.record.run["changes"].items()))
    same = [name for name, one in mates.items() if one.defaults == run.record.run["settings"]]
    return escaped(changes + (f" ({' and '.join(same)})" if same else ""))


def _tried_row(settings: str, run: Run, baseline: Run | None) -> tuple[str, ...]:
    comparable = baseline is not None and baseline.scores.layout == run.scores.layout
    references = {"sft": baseline.scores} if comparable and baseline else {}
    values = (measure(name, run.scores, references) for name in TRIED)
    counts = (str(run.seed), str(len(run.scores.layout.target)))
    return settings, *counts, *(number_text(value, ".2f", MISSING) for value in values)


def _commands(method: Description, sources: Sources) -> list[str]:
    """Return the commands that make the records, and those of the settings tried."""
    scenario = sources.evidence.scenario
    lines = [run_command(scenario, method.name)]
    runs = [run for run in sources.tuning if run.record.run["method"] == method.name and _has_changes(run)]
    tried: dict[str, dict[str, None]] = {}
    for run in sorted(runs, key=_order):
        for name, value in run.record.run["changes"].items():
            tried.setdefault(printable(name), {})[printable(str(value))] = None
    if tried:
        values = [f"--values.{name} {','.join(values)}" for name, values in sorted(tried.items())]
        targets = max(len(run.scores.layout.target) for run in runs)
        lines.append(" ".join(["clbench tune", scenario, method.name, *values, f"--targets {targets}"]))
    return ["```console", *lines, "```"]
