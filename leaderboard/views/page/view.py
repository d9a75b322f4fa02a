"""Scenarios as the templates need them: their rows, and what these say together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from clbench.base.text import counted, printable
from clbench.records.paths import table_parts
from clbench.scoring.metric import TIE, Metric
from clbench.spec.policies import DEFAULT_POLICY, POLICIES, is_built_in, kind_of, size_of
from clbench.spec.references import BASELINE

from ...board.certainty import TiedGain
from ...board.frontier import Curve
from ...board.paths import SCENARIO
from ...board.rows import Board, Row
from ...board.summary import (
    DIVISIONS,
    ELSEWHERE,
    GAIN,
    METHODS,
    RANKED_BY,
    competing,
    divisions_of,
    tables_of,
)
from ...board.tiers import TIERS
from ...policies.compared import Comparison, Comparisons
from ...policies.decoders import Decoding, read_decoding
from ..descriptions import RULES
from ..format import (
    Column,
    agreement_text,
    machine_text,
    prediction_text,
    start_text,
    table_title,
    tiers_text,
    title_of,
    unpaired_text,
)
from .definitions import Family, families
from .rows import RowView, columns, others, places, row_view
from .stills import film, stills
from .verdict import Verdict, headline, verdicts

FEWEST = 4
"""Fewest competing methods whose ranks under each definition are worth a table."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioView:
    """A scenario and its rows."""

    id: str
    groups: Mapping[str, tuple[str, ...]]
    """Names of the tasks by group, targets in their published order."""
    tasks: Mapping[str, tuple[str, ...]]
    """The same as column heads: targets are named by place where each seed has its own order."""
    balanced: bool
    """Whether each seed has its own order of the targets."""
    steps: tuple[int, ...]
    """Evaluation points of a stage."""
    rows: tuple[RowView, ...]
    families: tuple[Family, ...]
    frontier: tuple[Curve, ...]
    """Methods along the ladder of learning rates."""
    tied: Mapping[str, Sequence[TiedGain]]
    """Gains over plain fine-tuning at settings that tuning rated as highly as the chosen one, by method."""
    start: str
    """Sentence on what the pretrained policy can do, empty if there is none."""
    machine: str
    """Sentence on a table that was made on another kind of processor, empty if there is none."""
    unpaired: str
    """Sentence on rows that began with another pretrained policy than sft, empty if none did."""
    agreement: str
    """Sentence on how alike the seeds order the methods, empty if it is not known."""
    prediction: str
    """Sentence on what predicts forgetting among the methods, empty if nothing is known."""
    comparisons: tuple[Comparison, ...]
    """The same methods with the default policy; none for a table of that policy."""
    decoding: Decoding | None
    """Decoders of the policy; None where there are none to choose among."""

    @property
    def title(self) -> str:
        """Its short name."""
        return table_title(self.id)

    @property
    def headline(self) -> str:
        """What its rows say, in one or two sentences."""
        return headline(self.table, self.tied)

    @cached_property
    def verdicts(self) -> list[Verdict]:
        """What its rows say about each division of methods."""
        return verdicts(self.table, self.tied)

    @property
    def sorted_by(self) -> str:
        """The column that the table is sorted by: a metric, or the letters where none orders all rows."""
        for metric in (GAIN, RANKED_BY):
            values = [
                (row.estimates[metric].value, row.height) for row in self.table if row.height is not None
            ]
            if all(value is not None and abs(value - height) < TIE for value, height in values):
                return metric
        return "letters"

    @property
    def protocol(self) -> str:
        """What a run does, and what the numbers are."""
        skills, targets = (len(self.groups[name]) for name in ("retained", "target"))
        policy = f"A policy with {counted(skills, 'skill')}" if skills else "A policy"
        seeds = sorted({len(view.row.seeds) for view in self.rows})
        count = counted(seeds[0], "seed") if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]} seeds"
        numbers = "Values are from one seed" if seeds == [1] else f"Values are means over {count}"
        turns = ", one after another" if targets > 1 else ""
        sentences = [
            f"{policy} is fine-tuned on {counted(targets, 'new task')}{turns}.",
            f"The final average is its success on {_all(skills, targets)} at the end.",
            f"{numbers}, with 95\N{NO-BREAK SPACE}% confidence intervals.",
        ]
        sentences += _other_policy(table_parts(self.id)[1])
        if any(row.method == BASELINE for row in self.table):
            sentences.append(f"Plain fine-tuning is called {BASELINE}.")
        return " ".join(sentences)

    @cached_property
    def stills(self) -> dict[str, str]:
        """Pictures of its tasks that have one."""
        return stills(self.id, [name for names in self.groups.values() for name in names])

    @property
    def film(self) -> str | None:
        """The film of its skills before and after, if it has one."""
        return film(self.id)

    @property
    def tiers(self) -> list[str]:
        """Tiers of its rows, the lowest first."""
        return sorted({view.row.tier for view in self.rows}, key=TIERS.index)

    @property
    def higher_tiers(self) -> str:
        """Sentence on the runs that reached a higher tier than their row, empty if there is none."""
        return tiers_text(self.table)

    @property
    def has_agents(self) -> bool:
        """Whether it has rows of policies that another program trained."""
        return any(view.row.division in ELSEWHERE for view in self.rows)

    @property
    def has_single_seeds(self) -> bool:
        """Whether a row has only one seed."""
        return any(len(view.row.seeds) == 1 for view in self.rows)

    @property
    def table(self) -> list[Row]:
        """Its rows without their sections."""
        return [view.row for view in self.rows]

    @property
    def to_criterion(self) -> bool:
        """Whether its stages end when the target is learned."""
        return self.rows[0].row.to_criterion

    @property
    def others(self) -> list[Metric]:
        """Metrics that its table does not show."""
        return others(self.table)

    @property
    def divisions(self) -> list[tuple[int, str, str, list[RowView]]]:
        """Number, name and rule of each division, and its rows."""
        views = {view.row.method: view for view in self.rows}
        return [
            (DIVISIONS.index(name), name, RULES[name], [views[row.method] for row in rows])
            for name, rows in divisions_of(self.table).items()
        ]

    @cached_property
    def columns(self) -> tuple[Column, ...]:
        """Columns of its table."""
        return columns(self.table)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return sum(len(view.row.runs) for view in self.rows)

    @property
    def competing(self) -> list[RowView]:
        """Rows of the methods that compete."""
        return [view for view in self.rows if view.row.division in METHODS]


def sorted_tables(board: Board) -> dict[str, list[Row]]:
    """Return the rows by the name of their table: the main scenario first, then stages to a criterion."""
    found = tables_of(board.rows)

    def place(name: str) -> tuple[bool, bool, int, str]:
        rows = found[name]
        return table_parts(name)[0] != SCENARIO, not rows[0].to_criterion, -len(competing(rows)), name

    return {name: found[name] for name in sorted(found, key=place)}


def scenarios(tables: Mapping[str, list[Row]], board: Board, comparisons: Comparisons) -> list[ScenarioView]:
    """Return the view of each scenario.

    Args:
        tables: Rows of each scenario, in the order of the result.
        board: The board that they are from.
        comparisons: The comparisons of its rows, from `compared.by_table`.
    """
    found = []
    decoding = read_decoding()
    for scenario, rows in tables.items():
        layout, published = rows[0].runs[0].scores.layout, rows[0].runs[0].published
        groups = {"retained": layout.retained, "target": published.target, "held out": layout.held_out}
        tasks = {**groups, "target": places(rows[0])}
        members = competing(rows)
        found.append(
            ScenarioView(
                id=scenario,
                groups=_printable(groups),
                tasks=_printable(tasks),
                balanced=published.balanced,
                steps=layout.steps,
                rows=tuple(row_view(row, rows) for row in rows),
                families=tuple(families(members)) if len(members) >= FEWEST else (),
                frontier=board.frontiers.get(scenario, ()),
                tied=board.tied.get(scenario, {}),
                start=start_text(board.starts.get(scenario)),
                machine=machine_text(board.machines.get(scenario)),
                unpaired=unpaired_text(board.unpaired.get(scenario)),
                agreement=agreement_text(board.agreements.get(scenario)),
                prediction=prediction_text(board.predictions.get(scenario, ())),
                comparisons=comparisons.get(scenario, ()),
                decoding=decoding if decoding and scenario == decoding.table else None,
            )
        )
    return found


def _printable(groups: Mapping[str, Iterable[str]]) -> dict[str, tuple[str, ...]]:
    return {group: tuple(map(printable, names)) for group, names in groups.items()}


def _other_policy(policy: str) -> list[str]:
    """Return the sentence on a built-in policy other than the default one, none for any other policy."""
    if policy == DEFAULT_POLICY or not is_built_in(policy):
        return []
    size = size_of(policy)
    layers = f", with {size[0]} channels per token and {counted(size[1], 'layer')}" if size else ""
    return [f"The policy is {title_of(policy)}{layers}: {POLICIES[kind_of(policy)]}."]


def _all(skills: int, targets: int) -> str:
    """Return what the final average counts, in words."""
    new = "the new task" if targets == 1 else "all new tasks"
    return f"the skills and {new}" if skills else new
