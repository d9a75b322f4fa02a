"""A page for each method, from its code and its records. The same content gives the same bytes."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from clbench.base.text import listed
from clbench.learning.registry import load_method
from clbench.runs.tuning import CONTROL_OF, Tuned, fixed_settings, rated_best, tuned, tuned_scenarios
from clbench.scoring.intervals import UNBOUNDED, Estimate
from clbench.scoring.reading import is_number
from clbench.spec.identifiers import folder_name
from clbench.spec.references import BASELINE, FROZEN

from ..board.commands import commands_of, run_command
from ..board.frontier import FACTOR
from ..board.rows import Row
from ..board.runs import PRIOR
from ..board.summary import DIVISIONS, grouped
from ..claims.aegis import SHARES
from ..claims.evidence import SHARE, Evidence
from ..claims.judges import Judged
from ..views.descriptions import Description, common_hyper_parameters
from ..views.format import shown
from ..views.templating import arxiv_ids, template

COMPARISONS = ("sft", "experience_replay", "frozen")
"""Methods whose rows are next to the method's own."""

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
    board: Sequence[Row]
    """Rows of the board."""

    @cached_property
    def rows(self) -> dict[str, Row]:
        """Rows of the scenario by method."""
        return {row.method: row for row in self.board if row.scenario == self.evidence.scenario}


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
    """A setting that tuning tried, with its scores on validation episodes."""

    scenario: str
    """Scenario that it was tried on."""
    settings: str
    """Hyper-parameters that tuning sets."""
    learned: float | None
    """Success on each target right after it was learned; None if a run failed."""
    final_average: float | None
    """Success after the last target on everything that was ever trained; None if a run failed."""
    chosen: bool
    """Whether tuning chose it."""


def pages(methods: Sequence[Description], sources: Sources) -> dict[str, str]:
    """Return the pages by file name."""
    of_methods = {f"{method.name}.md": _page(method, sources) for method in methods}
    return {"README.md": _contents(methods), **of_methods}


def _contents(methods: Sequence[Description]) -> str:
    """Return the list of all methods by division."""
    divisions = {name: [one for one in methods if one.division == name] for name in DIVISIONS}
    present = {name: members for name, members in divisions.items() if members}
    return template(__file__, "methods.md.jinja").render(divisions=present, common=common_hyper_parameters())


def _page(method: Description, sources: Sources) -> str:
    """Return the page of one method."""
    text, scenario = method.text, sources.evidence.scenario
    papers = arxiv_ids(" ".join((text.idea, *text.rule)))
    names = [name for name in dict.fromkeys((method.name, *COMPARISONS)) if name in sources.rows]
    return template(__file__, "method.md.jinja").render(
        method=method,
        papers=papers,
        other_papers=[one for one in arxiv_ids(" ".join(text.details)) if one not in papers],
        uses=[USED[getattr(method.cls.uses, kind)].format(kind) for kind in PRIOR],
        costs=sources.rows[method.name].costs if method.name in sources.rows else {},
        diagnostics=_diagnostics(method, sources),
        scenario=scenario,
        rows=[sources.rows[name] for name in names] if method.name in names else [],
        shown=shown,
        rates=_rates(method.name, sources),
        command=run_command(scenario, method.name),
        claims=_claims(method, sources),
        chosen=_chosen(method.name),
        control_of=CONTROL_OF.get(method.name),
        tried=[] if method.name in CONTROL_OF else _tried(method.name),
        doubts=[] if method.name in CONTROL_OF else _doubts(method.name),
        commands=_commands(method.name, sources),
    )


def _diagnostics(method: Description, sources: Sources) -> dict[str, Estimate]:
    """Return the means of the numbers among the method's diagnostics, by name."""
    if not method.hook("diagnostics"):
        return {}
    runs = sources.evidence.runs.get(method.name, {}).values()
    stages = [stage for run in runs for stage in run.record.diagnostics.values() if isinstance(stage, dict)]
    names = dict.fromkeys(name for stage in stages for name, value in stage.items() if is_number(value))
    return {name: _mean_diagnostic(method.name, name, sources) for name in names}


def _mean_diagnostic(method: str, name: str, sources: Sources) -> Estimate:
    span = SHARE if name in SHARES else UNBOUNDED  # as on the page of the claims
    return sources.evidence.diagnostic(method, f"{name} of {method}", name, span).estimate


def _rates(method: str, sources: Sources) -> str:
    """Return the sentence on the learning rates behind steps and speed, "" if they are those of sft."""
    row, baseline = (sources.rows.get(name) for name in (method, BASELINE))
    if row is None or baseline is None or method == FROZEN or not row.to_criterion:
        return ""
    own, other = (one.runs[0].record.run.settings.get(FACTOR, 1.0) for one in (row, baseline))
    if own == other:
        return ""
    return (
        f"Steps and speed also depend on the learning rate: `{FACTOR}` is {own:g} for `{method}` and "
        f"{other:g} for `{BASELINE}`."
    )


# ---- claims ------------------------------------------------------------------------------------------------


def _claims(method: Description, sources: Sources) -> list[Part]:
    """Return the part of the method in each claim, the claims about the method first."""
    parts: dict[str, Part] = {}
    for one in sources.judged:
        finding = one.finding
        about = {_base(label) for label in finding.about}
        about |= {_base(figure.methods[0]) for figure in finding.figures if figure.methods}
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


def _tunings(method: str) -> list[tuple[str, Tuned]]:
    """Return the scenarios on which a method was tuned, with what tuning chose and tried."""
    return [(scenario, found) for scenario in tuned_scenarios() if (found := tuned(scenario).get(method))]


def _chosen(method: str) -> list[str]:
    """Return the settings that tuning chose, board by board: "`step_factor` = 0.3 on clbench/Fetch-v1"."""
    return [f"{_words(found.settings, '`{}`')} on {scenario}" for scenario, found in _tunings(method)]


def _tried(method: str) -> list[Tried]:
    """Return the settings that tuning tried, board by board."""
    return [
        Tried(scenario, _words(one.settings), one.learned, one.final_average, one.settings == found.settings)
        for scenario, found in _tunings(method)
        for one in found.tried
    ]


def _doubts(method: str) -> list[str]:
    """Return sentences on choices that a tie decided, or that lie at the end of a range."""
    sentences: list[str] = []
    ends: list[tuple[str, str]] = []
    for scenario, found in _tunings(method):
        sentences += [
            f"On {scenario}, {_words(one.settings, '`{}`')} ties with the chosen setting but was "
            "tried later, so it has no row on the board."
            for one in rated_best(found.tried)
            if one.settings != found.settings
        ]
        factors = [one.settings.get(FACTOR, 1.0) for one in found.tried]
        for end, factor in (("smallest", min(factors)), ("largest", max(factors))):
            if found.settings.get(FACTOR, 1.0) == factor and min(factors) < max(factors):
                ends.append((end, scenario))
    if ends:
        where = listed(f"the {end} tried on {listed(scenarios)}" for end, scenarios in grouped(ends).items())
        sentences.append(f"The chosen learning rate is {where}; a wider range might contain a better one.")
    return sentences


def _words(settings: Mapping[str, Any], form: str = "{}") -> str:
    return ", ".join(f"{form.format(name)} = {value:g}" for name, value in sorted(settings.items()))


def _commands(method: str, sources: Sources) -> list[str]:
    """Return the commands that make the rows of the method, and those that tuned it."""
    scenarios = dict.fromkeys((sources.evidence.scenario, *tuned_scenarios()))
    rows = [row for row in sources.board if row.method == method and row.scenario in scenarios]
    lines = [line for row in rows for line in commands_of(row.runs)]
    lines = lines or [run_command(sources.evidence.scenario, method)]
    tuned_as = CONTROL_OF.get(method, method)
    boards = [one for one in tuned_scenarios() if method in tuned(one)]
    for one in boards:
        words = ["clbench", "tune", one, tuned_as]
        for name, value in fixed_settings(load_method(tuned_as), tuned(one)[tuned_as]).items():
            words += [f"--set.{name}", f"{value:g}"]
        lines.append(shlex.join([*words, "--write", f"{Path('methods/tuned', folder_name(one))}.json"]))
    return lines
