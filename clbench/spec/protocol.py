"""The evaluation protocol: which episodes a run evaluates, and after which steps.

It is pure data, stated once. A run plays these episodes, a progress bar counts them, the scores expect them,
and a verifier draws some of them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from clbench.spec.scenario import Scenario

Split = Literal["validation", "test", "perturbed"]
"""Purpose of an episode. Choices may look at validation episodes; scores are made of test episodes alone. A
perturbed episode is the test episode of the same number in a perturbed world
(`clbench.worlds.perturbation`)."""

SPLITS: tuple[Split, ...] = ("validation", "test", "perturbed")

ScoredSplit = Literal["test", "validation"]
"""Split whose episodes are scored: "validation" in a tuning run, "test" otherwise."""


EPISODE_WEIGHT = 0.3
"""Duration of an evaluation episode in optimiser steps, for the time left that a progress bar shows."""


class Point(NamedTuple):
    """A moment of a run: after some optimiser steps of a stage."""

    stage: int
    """Stage, 0 before any target, k while target k is learned."""
    step: int
    """Optimiser steps done in the stage."""


class EpisodeKey(NamedTuple):
    """The identity of an episode of a scenario, besides the seed of the run."""

    task: str
    split: Split
    number: int


@dataclass(frozen=True)
class Protocol:
    """The evaluation of one run: its points, and the episodes at each of them."""

    retained: tuple[str, ...]
    """Names of the retained skills."""
    target: tuple[str, ...]
    """Names of the targets, in the order in which they are learned."""
    held_out: tuple[str, ...]
    """Names of the tasks that are never trained."""
    steps: tuple[int, ...]
    """Steps of a stage after which the policy is evaluated, rising; the last one is the end of the stage."""
    validation_episodes: int
    """Validation episodes of a task."""
    test_episodes: int
    """Test episodes of a task, and as many perturbed ones."""
    curve_episodes: int
    """Test episodes of a task at the points before the end of a stage: the first ones."""
    split: ScoredSplit = "test"
    """The split that is scored: "test", or "validation" in a tuning run."""
    perturb: bool = False
    """Whether the retained skills also meet perturbed episodes at the end of each stage."""

    @classmethod
    def of(cls, scenario: Scenario, split: ScoredSplit = "test", perturb: bool = False) -> Protocol:
        """Return the protocol of a run on `scenario`.

        Args:
            scenario: Scenario with the targets that are learned, in their order.
            split: The split that is scored.
            perturb: Whether the retained skills also meet perturbed episodes.
        """
        budget = scenario.budget
        retained, target, held_out = (
            tuple(task.name for task in group)
            for group in (scenario.retained, scenario.target, scenario.held_out)
        )
        return cls(
            retained,
            target,
            held_out,
            budget.evaluation_steps,
            budget.validation_episodes,
            budget.test_episodes,
            budget.curve_episodes,
            split,
            perturb,
        )

    @property
    def tasks(self) -> tuple[str, ...]:
        """All tasks: retained, then target, then held out."""
        return self.retained + self.target + self.held_out

    @property
    def stages(self) -> range:
        """Numbers of the stages, from 0."""
        return range(len(self.target) + 1)

    def end(self, stage: int) -> Point:
        """Return the end of a stage; stage 0 has no steps and ends at step 0."""
        return Point(stage, self.steps[-1] if stage else 0)

    def is_end(self, point: Point) -> bool:
        """Return whether a stage ends at `point`."""
        return point == self.end(point.stage)

    def points(self, stage: int) -> tuple[Point, ...]:
        """Return the evaluation points of a stage; the last one is its end."""
        return tuple(Point(stage, step) for step in self.steps) if stage else (self.end(0),)

    def episodes(self, point: Point) -> list[EpisodeKey]:
        """Return the episodes to play at `point`, in their order.

        At the end of a stage these are all scored episodes of all tasks, and the perturbed ones of the
        retained skills. Before the end they are the first scored episodes of what the stage can change: the
        retained skills and its target. At every point the target has all its validation episodes, so that
        choices need not look at test episodes.
        """
        target = self.target[point.stage - 1 : point.stage] if point.stage else ()
        at_end = self.is_end(point)
        keys = self._each(
            self.tasks if at_end else self.retained + target, self.split, self.scored_episodes(at_end)
        )
        if self.split == "test":
            keys += self._each(target, "validation", self.validation_episodes)
        if self.perturb and at_end:
            keys += self._each(self.retained, "perturbed", self.test_episodes)
        return keys

    def scored_episodes(self, at_end: bool) -> int:
        """Return the number of scored episodes of a task, at the end of a stage or before it."""
        if self.split == "validation":
            return self.validation_episodes
        return self.test_episodes if at_end else self.curve_episodes

    @staticmethod
    def _each(tasks: Sequence[str], split: Split, count: int) -> list[EpisodeKey]:
        return [EpisodeKey(task, split, number) for task in tasks for number in range(count)]
