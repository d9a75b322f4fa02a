"""A card for each scenario: what there is to do in it, and whether it tells methods apart.

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
from clbench.scoring.intervals import Estimate, bootstrap, paired_difference, row_generator, student_quantile
from clbench.scoring.layout import Array, average
from clbench.scoring.ranks import deviation_of_differences
from clbench.scoring.rates import Rates
from clbench.spec.budget import Budget
from clbench.spec.identifiers import folder_name
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

from ..board.rows import RANKED_BY, Row, Table
from ..board.runs import METHODS, differences, printable
from ..views.markdown import grid, prose, run_command
from ..views.table import MISSING, escaped, interval, number_text, title_of
from .descriptions import field_docstrings
from .scenario_tasks import Experts, picture_path

GROUPS = {
    "retained": "Retained skills, which the policy is pretrained on and must keep",
    "target": "Targets, learned in this order",
    "held_out": "Held-out tasks, never trained",
}

REFERENCES = ("sft", "joint", "frozen", "from_scratch")
"""Methods without whose records nothing can be said of a scenario."""

COLUMNS = ("retention", "adaptation", RANKED_BY, "zero_shot", "question_retention")
"""Metrics of these."""

COMPARED = ("retention", "adaptation", RANKED_BY, "question_retention")
"""Metrics that methods are told apart by; none needs a reference."""

SEEDS = (3, 5, 10)
"""The first is what `clbench run` and `clbench submit` do."""

PRETRAINED = 0.90
"""Least success of the pretrained policy on the retained skills: what it does not know it cannot forget."""

PRETRAINED_OF: Mapping[str, float] = {"clbench/DMControl-v0": 0.80, "clbench/FetchPixels-v0": 0.80}
"""The same, where experts are learned, or the policy sees pictures alone."""

ADAPTATION, RETENTION, FORGETTING, JOINT, FROZEN = 0.85, 0.50, 0.40, 0.07, 0.30
"""Bars of the others: fine-tuning must learn, and forget: the skills or, where there are none, the earlier
targets; one policy must be able to do all tasks; and the targets must need to be learned."""

NO_ESTIMATE = Estimate(None, None, None)


@dataclass(frozen=True)
class Bar:
    """What a scenario must be like to tell methods apart."""

    words: str
    """What is measured."""
    limit: float
    """Where the bar lies."""
    estimate: Estimate
    """What was measured."""
    at_least: bool = False
    """Whether it must be at least the limit, not at most."""

    @property
    def verdict(self) -> str:
        """Whether the value holds the bar; nothing is said of its interval."""
        if self.estimate.value is None:
            return MISSING
        above = round(self.estimate.value - self.limit, 9)
        return "holds" if (above >= 0 if self.at_least else above <= 0) else "does not hold"


@dataclass(frozen=True, eq=False)
class Card:
    """All that the card of a scenario is made from."""

    scenario: Scenario
    """What the code says."""
    board: Table
    """What the records say."""
    experts: Experts
    """How often the experts succeed."""
    pictures: frozenset[str]
    """Names of the tasks that there is a picture of."""

    @cached_property
    def rows(self) -> dict[str, Row]:
        """Rows of the scenario by method, in the order of the board."""
        return {row.method: row for row in self.board.rows if row.scenario == self.scenario.id}

    def page(self) -> str:
        """Return the card as Markdown."""
        id_ = self.scenario.id
        lines = [
            f"# {escaped(id_)}",
            "",
            prose(self.scenario.description),
            "",
            prose(f"Made by `clbench scenario-card {id_}` from the code and the records."),
        ]
        parts = {
            "Tasks": self._tasks(),
            "Budget": self._budget(),
            "Questions": self._questions(),
            "Whether it tells methods apart": self._validity(),
            "How small a difference it resolves": self._resolution(),
            "Order of the targets": self._orders(),
            "Versions": self._versions(),
        }
        for heading, part in parts.items():
            lines += ["", f"## {heading}", "", *part]
        return "\n".join(lines) + "\n"

    # ---- what the code says ------------------------------------------------------------------------

    def _tasks(self) -> list[str]:
        lines = [
            f"Expert: its success, undisturbed, in {self.experts.episodes} episodes that serve nothing else. "
            "Horizon: the steps of an episode that fails. A picture shows the expert halfway through one."
        ]
        for group, words in GROUPS.items():
            tasks: tuple[Task, ...] = getattr(self.scenario, group)
            table = grid(("task", "picture", "instructions", "expert", "horizon"), map(self._task, tasks), 2)
            lines += ["", f"### {words}", "", *(table if tasks else ["None."])]
        without = [task.name for task in self.scenario.tasks if task.name not in self.pictures]
        if without:
            names = ", ".join(map(escaped, without))
            lines += ["", f"Without a picture: {names}. Nothing could draw where this card was made."]
        return lines

    def _task(self, task: Task) -> tuple[str, ...]:
        picture = MISSING
        if task.name in self.pictures:
            path = picture_path(Path(folder_name(self.scenario.id)), task)
            picture = f"![{escaped(task.name)}]({path.as_posix()})"
        share = self.experts.successes[task.name] / self.experts.episodes
        instructions = "<br>".join(map(escaped, task.instructions))
        return escaped(task.name), picture, instructions, number_text(share, ".2f"), str(task.horizon)

    def _budget(self) -> list[str]:
        meanings, values = field_docstrings(Budget), dataclasses.asdict(self.scenario.budget)
        rows = [(f"`{name}`", prose(meanings[name]), f"{value:g}") for name, value in values.items()]
        points = ", ".join(map(str, self.scenario.budget.evaluation_steps))
        words = f"A stage is evaluated after {points} steps."
        return ["The same for every method.", "", *grid(("name", "meaning", "value"), rows, 1), "", words]

    def _questions(self) -> list[str]:
        rows = [
            (
                escaped(kind.name),
                "<br>".join(map(escaped, kind.wordings)),
                ", ".join(map(escaped, kind.answers)),
            )
            for kind in resolve(self.scenario.questions)
        ]
        return grid(("kind", "wordings", "answers"), rows)

    # ---- what the records say ----------------------------------------------------------------------

    def _validity(self) -> list[str]:
        """Return what the references do, and which bars hold."""
        head = ("", "retained skills", "targets", "all trained", "held out", "questions", "seeds")
        rows = [self._pretrained(self.rows["sft"])] if "sft" in self.rows else []
        for row in (self.rows[name] for name in REFERENCES if name in self.rows):
            rows.append(_cells(row.method, [row.estimates[name] for name in COLUMNS], row))
        lines = [
            "Success with 95 % intervals over seeds. Pretrained: before any target. Others: each target "
            "right after it was learned, all else after the last one. A verdict is by the value alone.",
            "",
            *grid(head, rows, len(head) - 1),
        ]
        bars = [
            (
                prose(bar.words),
                f"{'at least' if bar.at_least else 'at most'} {bar.limit:.2f}",
                interval(bar.estimate),
                bar.verdict,
            )
            for bar in self._bars()
        ]
        lines += ["", *grid(("bar", "must be", "is", "verdict"), bars)]
        missing = [name for name in REFERENCES if name not in self.rows]
        if missing:
            command = run_command(self.scenario.id, *missing)
            lines += ["", f"Missing: records of {', '.join(missing)}. `{command}` makes them."]
        return [*lines, *self._other_version()]

    def _pretrained(self, row: Row) -> tuple[str, ...]:
        quantities = (_retained, _targets, _trained, _held_out, _answers)
        return _cells("pretrained", [self._at_the_start(row, quantity) for quantity in quantities], row)

    def _at_the_start(self, row: Row, quantity: Callable[[Rates], Array]) -> Estimate:
        """Return a quantity (..., runs) of the pretrained policies that the runs of a row begin with."""
        generator = row_generator(self.scenario.id, f"pretrained {quantity.__name__}")
        runs = {"one": list(row.scores.values())}
        return bootstrap(lambda of: average(quantity(of["one"])), runs, generator, span=(0, 1))

    def _bars(self) -> list[Bar]:
        """Return the bars; where nothing is retained, fine-tuning must forget the earlier targets instead."""
        sft, id_ = self.rows.get("sft"), self.scenario.id
        bars = [Bar("adaptation of sft", ADAPTATION, self._metric("adaptation", "sft"), at_least=True)]
        if self.scenario.retained:
            start = self._at_the_start(sft, _retained) if sft else NO_ESTIMATE
            limit = PRETRAINED_OF.get(id_, PRETRAINED)
            bars.insert(0, Bar("pretrained policy on the retained skills", limit, start, at_least=True))
            bars.append(Bar("retention of sft", RETENTION, self._metric("retention", "sft")))
        else:
            forgetting = self._metric("forgetting", "sft")
            bars.append(Bar("forgetting of earlier targets by sft", FORGETTING, forgetting, at_least=True))
        bars.append(self._joint())
        bars.append(Bar("adaptation of frozen", FROZEN, self._metric("adaptation", "frozen")))
        return bars

    def _metric(self, name: str, method: str) -> Estimate:
        return self.rows[method].estimates[name] if method in self.rows else NO_ESTIMATE

    def _joint(self) -> Bar:
        """Return how far joint training is below the best of all other methods."""
        values = {name: row.estimates[RANKED_BY].value for name, row in self.rows.items() if name != "joint"}
        known = {name: value for name, value in values.items() if value is not None}
        if not known or "joint" not in self.rows:
            return Bar("best final average less that of joint", JOINT, NO_ESTIMATE)
        best = max(known, key=known.__getitem__)
        generator = row_generator(self.scenario.id, f"{best} - joint")
        runs, others = self.rows[best].scores, self.rows["joint"].scores
        words = f"best final average, of {printable(best)}, less that of joint"
        return Bar(words, JOINT, paired_difference(RANKED_BY, runs, others, generator))

    def _other_version(self) -> list[str]:
        """Return what the records say otherwise than the code."""
        theirs = self.board.scenarios.get(self.scenario.id)
        if theirs is None:
            return []
        groups = {group: [task.name for task in getattr(self.scenario, group)] for group in GROUPS}
        ours: dict[str, Any] = {**groups, "budget": dataclasses.asdict(self.scenario.budget)}
        fields = differences(ours, {name: theirs[name] for name in ours})
        words = f"The records are of another version of this scenario: {', '.join(fields)} differ."
        return ["", words] if fields else []

    def _resolution(self) -> list[str]:
        """Return how far two methods must lie apart to be told apart."""
        competing = [row for row in self.rows.values() if row.division in METHODS]
        episodes = self.scenario.budget.test_episodes
        rows = []
        for metric in COMPARED:
            deviation = deviation_of_differences(metric, [row.scores for row in competing])
            if deviation is not None:
                widths = [student_quantile(n - 1) * deviation / math.sqrt(n) for n in SEEDS]
                rows.append((title_of(metric), *(number_text(one, ".3f") for one in (deviation, *widths))))
        if not rows:
            return [f"Unknown: it takes {SEEDS[0]} seeds of two methods that compete."]
        head = ("metric", "deviation of a difference", *(f"{count} seeds" for count in SEEDS))
        return [
            "Two methods are told apart if they differ by more than this: half of the width to expect of the "
            f"95 % interval of their difference (docs/statistics.md), with {episodes} episodes of each task; "
            f"{SEEDS[0]} seeds are the default. The deviation is measured: that of the difference of two "
            "methods from seed to seed, the luck of their episodes included, root mean square over all pairs "
            f"of the {len(competing)} competing methods.",
            "",
            *grid(head, rows, len(head) - 1),
            *_ranks(competing),
        ]

    def _orders(self) -> list[str]:
        """Return how much depends on the order of the targets."""
        several = [row for row in self.rows.values() if len(row.orders.orders) > 1]
        if not several:
            command = f"clbench run {self.scenario.id} sft --order 1"
            return [
                f"No order but the published one was run. `{command}` and so on: three orders give a range."
            ]
        rows = []
        for row in several:
            each = ", ".join(
                f"{one.number}: {number_text(one.final_average, '.2f')}" for one in row.orders.orders
            )
            seeds = ", ".join(map(str, row.orders.seeds)) or MISSING
            rows.append((escaped(row.method), each, seeds, number_text(row.orders.sensitivity, ".2f")))
        words = (
            "Final average with the targets in other orders, 0 the published one, and order sensitivity: the "
            "greatest less the least of three or more."
        )
        return [words, "", *grid(("method", "by order", "seeds", "order sensitivity"), rows, 1)]

    def _versions(self) -> list[str]:
        """Return the versions of the tasks, and of what the records were made with."""
        of_tasks: dict[int, list[str]] = {}
        for task in self.scenario.tasks:
            of_tasks.setdefault(task.version, []).append(escaped(task.name))
        lines = [f"- Version {number}: {', '.join(names)}." for number, names in sorted(of_tasks.items())]
        found: dict[str, set[str]] = {}
        for run in (run for name in REFERENCES if name in self.rows for run in self.rows[name].runs):
            versions = run.record.fingerprint.get("versions")
            for package, version in versions.items() if isinstance(versions, dict) else ():
                found.setdefault(escaped(str(package)), set()).add(escaped(str(version)))
        if found:
            packages = ", ".join(f"{name} {' and '.join(sorted(found[name]))}" for name in sorted(found))
            lines.append(
                f"- Records of {', '.join(name for name in REFERENCES if name in self.rows)}: {packages}."
            )
        return lines


def _cells(name: str, estimates: Sequence[Estimate], row: Row) -> tuple[str, ...]:
    return escaped(name), *map(interval, estimates), str(len(row.seeds))


def _ranks(competing: Sequence[Row]) -> list[str]:
    """Return how many methods of each division the board tells apart."""
    lines = []
    for division in METHODS:
        members = [row for row in competing if row.division == division and row.rank is not None]
        if len(members) > 1:
            ranks = len({row.rank for row in members})
            lines.append(f"- {division}: {len(members)} methods, {ranks} ranks.")
    return ["", "Rows that share a rank on the board are not told apart:", "", *lines] if lines else []


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
    asked, correct = rates.asked[..., 0, :].sum(axis=-1), rates.correct[..., 0, :].sum(axis=-1)
    return np.where(asked > 0, correct / np.maximum(asked, 1), np.nan)
