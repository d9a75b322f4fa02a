"""A card for each scenario: its tasks, spaces and budget, and whether it tells methods apart.

The same code, records, measurements and pictures give the same bytes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from clbench.base.entry_points import resolve
from clbench.base.text import field_docstrings, printable
from clbench.records.paths import RECORDS
from clbench.scoring.groups import deviation_of_differences, least_difference
from clbench.scoring.intervals import (
    NO_ESTIMATE,
    Estimate,
    estimate_quantity,
    paired_difference,
    row_generator,
)
from clbench.scoring.layout import Array, average
from clbench.scoring.rates import Rates
from clbench.spec.budget import Budget
from clbench.spec.identifiers import folder_name
from clbench.spec.protocol import DEFAULT_SEEDS, check_steps
from clbench.spec.references import COMPARED
from clbench.spec.scenario import Scenario

from ..board.commands import run_command
from ..board.rows import Board, Row
from ..board.runs import differences
from ..board.summary import RANKED_BY, competing, divisions_of, grouped
from ..views.format import MISSING
from ..views.templating import template
from .scenario_spaces import spaces_of
from .scenario_tasks import Experts, picture_path

GROUPS = {
    "retained": "Retained skills, which the policy is pretrained on and must keep",
    "target": "Targets, learned in this order",
    "held_out": "Held-out tasks, never trained",
}

OWN_ORDERS = "Targets; each seed learns them in its own order"
"""Title of the targets of a balanced scenario."""

COLUMNS = ("retention", "adaptation", RANKED_BY, "zero_shot", "question_retention")
"""Metrics of the references."""

TELLING = ("retention", "adaptation", RANKED_BY, "question_retention")
"""Metrics that tell methods apart; none needs a reference."""

SEEDS = (DEFAULT_SEEDS, 2 * DEFAULT_SEEDS)
"""Numbers of seeds for which a card says which differences can be told apart."""

PRETRAINED = 0.90
"""Lowest success of the pretrained policy on the retained skills: it cannot forget what it does not know."""

PRETRAINED_OF: Mapping[str, float] = {"clbench/DMControl-v0": 0.80, "clbench/FetchPixels-v0": 0.80}
"""The same bar where experts are learned, or where the policy sees pictures only."""

LEAST_LEARNED, MOST_KEPT, LEAST_FORGOTTEN, MOST_BEHIND, MOST_UNTRAINED = 0.85, 0.50, 0.40, 0.07, 0.30
"""The other bars: fine-tuning must learn, and must forget the skills (or the earlier targets, where there are
no skills); joint training, one policy for all tasks, must not be far behind; and a frozen policy must not do
the targets."""

OF_SFT, LEAST_AHEAD, LEAST_OF_REPLAY, MOST_BEFORE, LEAST_CHECKS = (0.30, 0.85), 0.10, 0.90, 0.30, 8
"""Bars of a scenario whose stages end when the target is learned: the range of the final average of sft; how
far experience replay must be ahead of it, and how good it must be; the success on a target before its stage;
and the checks until a target is learned, so that their distance does not decide the result."""


@dataclass(frozen=True)
class Bar:
    """A condition that a scenario must meet to tell methods apart."""

    words: str
    """Measured quantity, in words."""
    limit: float
    """Limit of the quantity."""
    estimate: Estimate
    """Measured value with its interval."""
    at_least: bool = False
    """Whether the value must be at least the limit (otherwise at most)."""

    @property
    def verdict(self) -> str:
        """Whether the value meets the limit; the interval does not count."""
        if self.estimate.value is None:
            return MISSING
        above = round(self.estimate.value - self.limit, 9)
        return "holds" if (above >= 0 if self.at_least else above <= 0) else "does not hold"


@dataclass(frozen=True, eq=False)
class Card:
    """The card of a scenario and its sources."""

    scenario: Scenario
    """Scenario in the code."""
    board: Board
    """Board of the records."""
    experts: Experts
    """Measured success of the experts."""
    pictures: frozenset[str]
    """Names of the tasks that have a picture."""
    typed: str = ""
    """The scenario as a command names it, with its module if it has one; its id if empty."""
    records: Path = RECORDS
    """Folder of the records."""

    @cached_property
    def rows(self) -> dict[str, Row]:
        """Rows of the scenario by method, in the order of the board."""
        return {row.method: row for row in self.board.rows if row.scenario == self.scenario.id}

    def _command(self, methods: Sequence[str]) -> str:
        return run_command(self.typed or self.scenario.id, *methods, records=self.records)

    def page(self) -> str:
        """Return the card as Markdown."""
        present = [self.rows[name] for name in COMPARED if name in self.rows]
        needed = COMPARED if self.scenario.budget.criterion is None else (*COMPARED, "experience_replay")
        missing = [name for name in needed if name not in self.rows]
        members = competing(self.rows.values())
        largest = max(divisions_of(members).values(), key=len, default=[])
        meanings, values = field_docstrings(Budget), dataclasses.asdict(self.scenario.budget)
        references = [
            (row.method, [row.estimates[name] for name in COLUMNS], len(row.seeds)) for row in present
        ]
        return template(__file__, "scenario.md.jinja").render(
            scenario=self.scenario,
            typed=self.typed or self.scenario.id,
            groups=GROUPS | ({"target": OWN_ORDERS} if self.scenario.balanced else {}),
            experts=self.experts,
            pictures={
                task.name: picture_path(Path(folder_name(self.scenario.id)), task).as_posix()
                for task in self.scenario.tasks
                if task.name in self.pictures
            },
            without_picture=[name for name in self.experts.successes if name not in self.pictures],
            without_expert=[
                task.name for task in self.scenario.tasks if task.name not in self.experts.successes
            ],
            spaces=spaces_of(self.scenario),
            budget=[(name, meanings[name], value) for name, value in values.items()],
            questions=resolve(self.scenario.questions),
            references=[*self._pretrained(), *references],
            bars=self._bars(),
            missing=missing,
            missing_command=self._command(missing) if missing else "",
            other_version=self._other_version(),
            seed_counts=SEEDS,
            largest=largest,
            resolution=_resolution(largest) if len(largest) > 1 else {},
            group_counts=_group_counts(members),
            orders=[row for row in self.rows.values() if len(row.orders.orders) > 1],
            task_versions=self._task_versions(),
            recorded=[row.method for row in present],
            packages=_packages(present),
        )

    # ---- whether it tells methods apart ------------------------------------------------------------

    def _pretrained(self) -> list[tuple[str, list[Estimate], int]]:
        """Return the line of the pretrained policies, none without runs of sft, which begin with them."""
        if "sft" not in self.rows:
            return []
        row, quantities = self.rows["sft"], (_retained, _targets, _trained, _held_out, _answers)
        return [("pretrained", [self._of_runs(row, one) for one in quantities], len(row.seeds))]

    def _of_runs(
        self, row: Row, quantity: Callable[[Rates], Array], span: tuple[float, float] = (0, 1)
    ) -> Estimate:
        """Return the mean of a quantity (..., runs) over the runs of a row; most are about how runs begin."""
        generator = row_generator(self.scenario.id, f"pretrained {quantity.__name__}")
        runs = {"one": list(row.scores.values())}
        return estimate_quantity(lambda of: average(quantity(of["one"])), runs, generator, span=span)

    def _bars(self) -> list[Bar]:
        """Return the bars; without retained skills, fine-tuning must forget the earlier targets instead."""
        if self.scenario.budget.criterion is not None:
            return self._bars_to_criterion()
        sft, id_ = self.rows.get("sft"), self.scenario.id
        bars = [Bar("adaptation of sft", LEAST_LEARNED, self._metric("adaptation", "sft"), at_least=True)]
        if self.scenario.retained:
            start = self._of_runs(sft, _retained) if sft else NO_ESTIMATE
            limit = PRETRAINED_OF.get(id_, PRETRAINED)
            bars.insert(0, Bar("pretrained policy on the retained skills", limit, start, at_least=True))
            bars.append(Bar("retention of sft", MOST_KEPT, self._metric("retention", "sft")))
        else:
            forgetting = self._metric("forgetting", "sft")
            bars.append(
                Bar("forgetting of earlier targets by sft", LEAST_FORGOTTEN, forgetting, at_least=True)
            )
        bars.append(self._joint())
        bars.append(Bar("adaptation of frozen", MOST_UNTRAINED, self._metric("adaptation", "frozen")))
        return bars

    def _bars_to_criterion(self) -> list[Bar]:
        """Return the bars where stages end when the target is learned: there must be room on both sides."""
        sft = self.rows.get("sft")
        average_of_sft = self._metric(RANKED_BY, "sft")
        replay = self._metric(RANKED_BY, "experience_replay")
        before = self._of_runs(sft, _before_its_stage) if sft else NO_ESTIMATE
        checks = self._of_runs(sft, _checks, (0, math.inf)) if sft else NO_ESTIMATE
        ahead, above = self._difference("experience_replay", "sft"), self._difference("sft", "frozen")
        return [
            Bar("final average of sft", OF_SFT[0], average_of_sft, at_least=True),
            Bar("final average of sft", OF_SFT[1], average_of_sft),
            Bar("final average of experience_replay", LEAST_OF_REPLAY, replay, at_least=True),
            Bar("final average of experience_replay minus that of sft", LEAST_AHEAD, ahead, at_least=True),
            Bar("final average of sft minus that of frozen", 0.0, above, at_least=True),
            Bar("success of sft on a target before its stage", MOST_BEFORE, before),
            Bar("checks of sft until a target is learned", LEAST_CHECKS, checks, at_least=True),
        ]

    def _difference(self, method: str, other: str) -> Estimate:
        """Return the paired difference of the final averages of two methods."""
        if method not in self.rows or other not in self.rows:
            return NO_ESTIMATE
        generator = row_generator(self.scenario.id, f"{method} - {other}")
        return paired_difference(RANKED_BY, self.rows[method].scores, self.rows[other].scores, generator)

    def _metric(self, name: str, method: str) -> Estimate:
        return self.rows[method].estimates[name] if method in self.rows else NO_ESTIMATE

    def _joint(self) -> Bar:
        """Return the bar on how far joint training is below the best other method."""
        values = {name: row.estimates[RANKED_BY].value for name, row in self.rows.items() if name != "joint"}
        known = {name: value for name, value in values.items() if value is not None}
        if not known or "joint" not in self.rows:
            return Bar("best final average minus that of joint", MOST_BEHIND, NO_ESTIMATE)
        best = max(known, key=known.__getitem__)
        words = f"best final average (of {printable(best)}) minus that of joint"
        return Bar(words, MOST_BEHIND, self._difference(best, "joint"))

    def _other_version(self) -> list[str]:
        """Return the fields in which the records differ from the code."""
        theirs = self.board.scenarios.get(self.scenario.id)
        if theirs is None:
            return []
        groups = {group: [task.name for task in getattr(self.scenario, group)] for group in GROUPS}
        ours: dict[str, Any] = {**groups, "budget": dataclasses.asdict(self.scenario.budget)}
        return differences(ours, {name: getattr(theirs, name) for name in ours})

    def _task_versions(self) -> dict[int, list[str]]:
        """Return the names of the tasks by their version."""
        return dict(sorted(grouped((task.version, task.name) for task in self.scenario.tasks).items()))


def _resolution(rows: Sequence[Row]) -> dict[str, list[float]]:
    """Return by metric the deviation of a difference, then the smallest difference for each of `SEEDS`.

    Args:
        rows: The rows of a division, which the test of the board compares with each other.
    """
    found = {}
    for metric in TELLING:
        deviation = deviation_of_differences(metric, [row.scores for row in rows])
        if deviation:  # equal differences for all seeds tell nothing
            needed = [least_difference(deviation, len(rows), seeds) for seeds in SEEDS]
            found[metric] = [deviation, *needed]
    return found


def _group_counts(rows: Sequence[Row]) -> list[tuple[str, int, int]]:
    """Return how many methods each division has, and how many groups they form on the board."""
    found = []
    for division, members in divisions_of(row for row in rows if row.letters).items():
        if len(members) > 1:
            letters = {letter for row in members for letter in row.letters or ""}
            found.append((division, len(members), len(letters)))
    return found


def _packages(rows: Sequence[Row]) -> dict[str, list[str]]:
    """Return the versions of the packages that the records of `rows` were made with."""
    found: dict[str, set[str]] = {}
    for run in (run for row in rows for run in row.runs):
        versions = run.record.fingerprint.get("versions")
        for package, version in versions.items() if isinstance(versions, dict) else ():
            found.setdefault(str(package), set()).add(str(version))
    return {name: sorted(found[name]) for name in sorted(found)}


# ---- quantities of the pretrained policy, (..., runs) ------------------------------------------------------


def _retained(rates: Rates) -> Array:
    return average(rates.retained[..., 0, :])


def _targets(rates: Rates) -> Array:
    return average(rates.target[..., 0, :])


def _trained(rates: Rates) -> Array:
    trained = rates.layout.columns("held_out").start
    return average(rates.success[..., 0, :trained])


def _held_out(rates: Rates) -> Array:
    return average(rates.held_out[..., 0, :])


def _answers(rates: Rates) -> Array:
    return rates.answered[..., 0]


# ---- quantities of stages that end when the target is learned, (..., runs) --------------------------------


def _before_its_stage(rates: Rates) -> Array:
    return average(rates.starts)


def _checks(rates: Rates) -> Array:
    planned = check_steps(rates.layout.steps[-1])
    checks = np.searchsorted(planned, rates.steps, side="right")
    return average(np.where(np.isnan(rates.steps), np.nan, checks))  # NaN would count as all checks
