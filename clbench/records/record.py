"""The record: the one file that a run leaves, written once and never edited.

A record holds every evaluation episode, every answer count, and how far the policy moved. Values that can
be computed from these are not stored.
"""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import compress
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from clbench.base.text import printable
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.protocol import Point, Protocol, ScoredSplit, Split

if TYPE_CHECKING:
    import pandas

SCHEMA = 5
"""Version of the file format. A reader refuses a newer one, and converts older ones
(`clbench.records.history`)."""

EPISODE_COLUMNS = ("stage", "step", "task", "split", "episode", "success", "return", "length")
"""`stage` and `step` are the evaluation point: see `clbench.spec.protocol.Point`. `episode` numbers the
initial state inside its task and split. `clbench.spec.protocol.Protocol.episodes` says which episodes each
point has."""

FARTHEST = 1e18
"""An activation drift or shift above this comes from a policy that diverged, and is recorded as None."""


Row = TypeVar("Row")


class EpisodeRow(NamedTuple):
    """A row of `Record.episodes`: one evaluation episode at one point."""

    stage: int
    """Stage, 0 before the first target."""
    step: int
    """Optimiser steps done in the stage."""
    task: str
    """Name of the task."""
    split: Split
    """Split of the episode."""
    episode: int
    """Number of the initial state within its task and split."""
    success: int
    """1 if the success rule held before the horizon, else 0."""
    total_reward: float | None
    """Sum of the dense rewards, None if it is not finite."""
    length: int
    """Steps until success or the horizon."""

    @property
    def point(self) -> Point:
        """The evaluation point."""
        return Point(self.stage, self.step)


class AnswerRow(NamedTuple):
    """A row of `Record.answers`: the answers to one kind of question at one point.

    A policy that was trained elsewhere is asked 0 questions.
    """

    stage: int
    """Stage, 0 before the first target."""
    step: int
    """Optimiser steps done in the stage."""
    kind: str
    """Kind of question."""
    asked: int
    """Number of questions."""
    correct: int
    """Number of correct answers."""


class PolicyRow(NamedTuple):
    """A row of `Record.policy`: how far the policy has moved at one point.

    The last two are measured only at the ends of stages. Each value may be None.
    """

    stage: int
    """Stage, 0 before the first target."""
    step: int
    """Optimiser steps done in the stage."""
    update_sparsity: float | None
    """Share of the policy's parameters whose relative change from pretraining is below 1e-3."""
    activation_drift: float | None
    """Squared 2-Wasserstein distance between the hidden states of this policy and of the pretrained one on
    the questions, averaged over layers."""
    shift: float | None
    """Mean squared change of what `Policy.predict` returns (a flow policy: the velocity) on 256 samples of
    the stage's target since the beginning of the stage, in normalised actions."""
    captured: float | None
    """Share of episodes in which the policy does the stage's target although it is told to do a retained
    skill."""


class CheckRow(NamedTuple):
    """A row of `Record.checks`: a check of whether the target is learned.

    A check plays the target's validation episodes until its outcome is certain.
    """

    stage: int
    """Stage whose criterion was checked."""
    step: int
    """Optimiser steps done in the stage."""
    episodes: int
    """Validation episodes that had ended when the outcome was certain."""
    successes: int
    """Successes among them."""


@dataclass
class Relearning:
    """How plain fine-tuning regained the retained skill that succeeds least, after the last stage."""

    skill: str
    """Name of the skill: the one with the fewest successes, the first on a tie."""
    successes: int
    """Successes of the final policy in the skill's validation episodes."""
    steps: int
    """Optimiser steps until the criterion was met; if it was not, the most steps of a stage."""
    met: bool
    """Whether the criterion was met."""


ONLINE_USES: dict[str, Any] = {
    "demonstrations": "never",
    "questions": "never",
    "reference": False,
    "online": True,
}
"""`RunInfo.uses` of an agent: it uses no prior data of clbench, and another program trains it."""

EXTERNAL_USES: dict[str, Any] = {"external": True}
"""`RunInfo.uses` of a policy that was trained elsewhere. Nothing is known about its data: it may even have
learned from the demonstrations of clbench, which can be exported."""


@dataclass
class RunInfo:
    """The run. Two runs with equal `RunInfo` and `ScenarioInfo` are the same run."""

    scenario: str
    """Gymnasium id of the scenario."""
    method: str
    """Name of the method, or "module:Class"."""
    seed: int
    """Seed of the run."""
    device: str
    """Device on which the policy was computed."""
    split: ScoredSplit
    """The split that is scored: "test", or "validation" for a tuning run."""
    settings: dict[str, Any]
    """All hyper-parameters by name."""
    changes: dict[str, Any]
    """Hyper-parameters that differ from those tuned for the scenario or, without tuning, from the method's
    defaults, by name."""
    uses: dict[str, Any]
    """The prior data that the method may read; `online` is true for an agent of another program, and
    `external` for a policy that a server offered, about whose data nothing is known."""
    order: int = 0
    """Order in which the targets were learned; 0 is the published one. See
    `clbench.spec.scenario.target_order`."""
    perturb: bool = False
    """Whether the retained skills and each stage's target were also evaluated on perturbed episodes."""
    policy: str = DEFAULT_POLICY
    """Name of the policy."""

    @property
    def trained_elsewhere(self) -> bool:
        """Whether another program trained the policy: an agent, or a policy that a server offered."""
        return bool(self.uses.get("online") or self.uses.get("external"))


@dataclass
class ScenarioInfo:
    """The scenario of a run, in full."""

    id: str
    """Gymnasium id."""
    retained: list[str]
    """Names of the retained skills."""
    target: list[str]
    """Names of the targets, in the order in which they were learned."""
    held_out: list[str]
    """Names of the tasks that are never trained."""
    evaluation_steps: list[int]
    """Steps of a stage after which the policy was evaluated; the last one is the end of the stage."""
    budget: dict[str, Any]
    """Fields of `clbench.Budget` by name."""
    balanced: bool = False
    """Whether each seed has its own order of the targets: see `clbench.spec.scenario.balanced_order`."""

    def protocol(
        self, split: ScoredSplit = "test", perturb: bool = False, ends: tuple[int, ...] | None = None
    ) -> Protocol:
        """Return the evaluation protocol of a run on this scenario.

        Args:
            split: The split that is scored.
            perturb: Whether the retained skills and each stage's target are also evaluated on perturbed
                episodes.
            ends: Steps of each stage, once the run has finished; None before, or if all are equally long.
        """
        return Protocol(
            retained=tuple(self.retained),
            target=tuple(self.target),
            held_out=tuple(self.held_out),
            steps=tuple(self.evaluation_steps),
            validation_episodes=self.budget["validation_episodes"],
            test_episodes=self.budget["test_episodes"],
            curve_episodes=self.budget["curve_episodes"],
            split=split,
            perturb=perturb,
            criterion=self.budget.get("criterion"),
            ends=ends,
        )


@dataclass
class Costs:
    """What a run cost. A cost that is not known is None: a failed run may lack some costs."""

    optimiser_steps: int | None = None
    """Optimiser steps, including the preparation."""
    parameters: int | None = None
    """Parameters of the pretrained policy, or of an agent's network."""
    preparation_steps: int | None = None
    """Optimiser steps before the first target."""
    parameters_added: int | None = None
    """Parameters of the final policy minus those of the pretrained one; negative if it has fewer."""
    bytes_kept: int | None = None
    """Bytes of prior data and of method state that a stage passes to the next one, the most of any stage."""
    environment_steps: int | None = None
    """Environment steps of an agent that learned online."""


@dataclass(repr=False)
class Record:
    """What one run did, and the outcome. The order of the fields is part of the file format."""

    status: Literal["success", "failed"]
    """Whether the run completed."""
    run: RunInfo
    """The run: scenario, method, seed and settings."""
    scenario: ScenarioInfo
    """The scenario in full."""
    episodes: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in EPISODE_COLUMNS})
    """Evaluation episodes as columns of equal length, see `EPISODE_COLUMNS`."""
    answers: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in AnswerRow._fields})
    """Answers to test questions (in a tuning run: to training questions) as columns, see `AnswerRow`."""
    policy: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in PolicyRow._fields})
    """Changes of the policy as columns, see `PolicyRow`."""
    checks: dict[str, list[Any]] = field(default_factory=lambda: {name: [] for name in CheckRow._fields})
    """Checks of the criterion as columns, see `CheckRow`."""
    relearning: Relearning | None = None
    """Relearning of the skill that succeeds least. None if it was not measured: without a criterion or a
    retained skill, in a tuning run, or where plain fine-tuning failed."""
    costs: Costs = field(default_factory=Costs)
    """What the run cost."""
    diagnostics: dict[str, Any] = field(default_factory=dict)
    """What the method reports about itself, by stage."""
    fingerprint: dict[str, Any] = field(default_factory=dict)
    """Commit, package versions, hardware, `rollouts` (a hash for each world), `method` (authors, version,
    hash of the source), and the hash of the pretrained policy."""
    timing: dict[str, Any] = field(default_factory=dict)
    """All that may differ between equal runs: dates, seconds, and `step_ratio`, the time of a step divided by
    that of plain fine-tuning on the same machine."""
    error: dict[str, str] | None = None
    """For a failed run: `where` (the hook and stage), `type`, `message`, `traceback`."""

    def __repr__(self) -> str:
        run = self.run
        policy = "" if run.policy == DEFAULT_POLICY else f", {run.policy}"
        name = printable(f"{run.method} on {run.scenario}{policy}, seed {run.seed}")
        return f"<Record of {name}: {self.status}, {len(self.episodes['task']):,} episodes>"

    def _repr_html_(self) -> str:
        """Return the success rates of the ends of stages as a table, for notebooks."""
        from clbench.records.tables import matrix

        table = matrix(self).map(lambda rate: f"{rate:.2f}").to_html(notebook=True)
        return f"<p>{html.escape(repr(self))}</p>{table}"

    def frame(self) -> pandas.DataFrame:
        """Return the evaluation episodes as a table, see `clbench.load_records`."""
        from clbench.records.tables import frame

        return frame(self)

    def matrix(self) -> pandas.DataFrame:
        """Return the success rates at the ends of stages (rows) on all tasks (columns), with labels."""
        from clbench.records.tables import matrix

        return matrix(self)

    def episode_rows(self) -> list[EpisodeRow]:
        """Return the rows of `episodes`."""
        return _rows(EpisodeRow, self.episodes)

    def answer_rows(self) -> list[AnswerRow]:
        """Return the rows of `answers`."""
        return _rows(AnswerRow, self.answers)

    def policy_rows(self) -> list[PolicyRow]:
        """Return the rows of `policy`."""
        return _rows(PolicyRow, self.policy)

    def check_rows(self) -> list[CheckRow]:
        """Return the rows of `checks`."""
        return _rows(CheckRow, self.checks)

    @property
    def failure(self) -> str | None:
        """Where and why the run failed, such as "stage 1 (push): ValueError: no"; None if it did not."""
        if self.error is None:
            return None
        return ": ".join(self.error[name] for name in ("where", "type", "message"))

    def retained_at_start(self) -> float | None:
        """Return the success on the retained skills before the first target; None if there are none."""
        found = [
            row.success
            for row in self.episode_rows()
            if row.stage == 0 and row.split == self.run.split and row.task in self.scenario.retained
        ]
        return sum(found) / len(found) if found else None

    def add_episode(self, row: EpisodeRow) -> None:
        """Append a row to `episodes`."""
        _append(self.episodes, row)

    def add_answers(self, row: AnswerRow) -> None:
        """Append a row to `answers`."""
        _append(self.answers, row)

    def add_check(self, row: CheckRow) -> None:
        """Append a row to `checks`."""
        _append(self.checks, row)

    def add_policy(self, row: PolicyRow) -> None:
        """Append a row to `policy`."""
        _append(self.policy, row)

    def drop_stages(self, first: int) -> None:
        """Remove the stages from `first` on, for a run whose stages another program trains one by one."""
        for table in (self.episodes, self.answers):
            stays = [stage < first for stage in table["stage"]]
            for column in table.values():
                column[:] = compress(column, stays)
        self.diagnostics = {name: found for name, found in self.diagnostics.items() if int(name) < first}
        del self.timing["stages"][first:]


def _rows(row: Callable[..., Row], columns: dict[str, list[Any]]) -> list[Row]:
    return [row(*values) for values in zip(*columns.values(), strict=True)]


def _append(columns: dict[str, list[Any]], row: tuple[Any, ...]) -> None:
    for column, value in zip(columns.values(), row, strict=True):
        column.append(value)
