"""The evaluation protocol: which episodes a run evaluates, and after which steps.

It is pure data, stated once. A run plays these episodes, a progress bar counts them, the scores expect them,
and a verifier draws some of them again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

Split = Literal["validation", "test", "perturbed"]
"""Purpose of an episode. Choices may look at validation episodes; scores come from test episodes alone. A
perturbed episode is the test episode of the same number in a perturbed world
(`clbench.worlds.perturbation`)."""

SPLITS: tuple[Split, ...] = ("validation", "test", "perturbed")

ScoredSplit = Literal["test", "validation"]
"""Split whose episodes are scored: "validation" in a tuning run, "test" otherwise."""


DEFAULT_SEEDS = 4
"""Number of seeds per method if none is given. Four balance the orders of a balanced scenario of four
targets; eight separate similar methods (docs/guide/statistics.md)."""

MOST_SEEDS = 10_000
"""Maximum number of seeds in one command: a typing error must not plan for hours."""

LARGEST_SEED = 2**64 - 1
"""The largest seed: PyTorch takes no larger one, and records hold no larger number."""

FIRST_TUNING_SEED = 100
"""First seed of tuning: no board uses this seed or a later one."""

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
    """Name of the task."""
    split: Split
    """Split of the episode."""
    number: int
    """Number of the initial state within its task and split, from 0."""


def check_steps(last: int) -> tuple[int, ...]:
    """Return the steps of a stage at which its criterion is checked, rising.

    The first check comes before any step, the last one after all steps. In between, checks are 2 steps apart
    up to step 20, since targets are learned in 10 to 30 steps at the scenario's learning rate. Later checks
    are 12 % apart, so that a longer stage is at most an eighth longer than it had to be.

    Args:
        last: Maximum number of steps of a stage.
    """
    steps = [0]
    while steps[-1] < last:
        steps.append(steps[-1] + max(2, round(0.12 * steps[-1])))
    return (*steps[:-1], last)


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
    """Whether the skills and the stage's target also meet perturbed episodes at the end of each stage."""
    criterion: float | None = None
    """Success rate on the target's validation episodes that ends a stage before its last step."""
    ends: tuple[int, ...] | None = None
    """Steps of each stage of a finished run; None if all stages are equally long, or before the run."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """All tasks: retained, then target, then held out."""
        return self.retained + self.target + self.held_out

    @property
    def stages(self) -> range:
        """Numbers of the stages, from 0."""
        return range(len(self.target) + 1)

    def end(self, stage: int) -> Point:
        """Return the end of a stage; before a run with a criterion, return the latest possible end.

        Stage 0 has no steps and ends at step 0.
        """
        if not stage:
            return Point(0, 0)
        return Point(stage, self.steps[-1] if self.ends is None else self.ends[stage - 1])

    def is_end(self, point: Point) -> bool:
        """Return whether a stage ends at `point`, which the run evaluates."""
        any_step = self.criterion is not None and self.ends is None
        return any_step or point == self.end(point.stage)

    def points(self, stage: int) -> tuple[Point, ...]:
        """Return the evaluation points of a stage; the last one is its end."""
        on_the_way = self.steps[:-1] if stage else ()
        return (*(Point(stage, step) for step in on_the_way), self.end(stage))

    def episodes(self, point: Point) -> list[EpisodeKey]:
        """Return the episodes to play at `point`, in their order.

        At the end of a stage these are all scored episodes of all tasks, and the perturbed ones of the
        retained skills and the stage's target. Before the end they are the first scored episodes of what the
        stage can change: the retained skills and its target. Without a criterion the target has all its
        validation episodes at every point, so that choices need not look at test episodes.
        """
        target = self.learned(point.stage)
        at_end = self.is_end(point)
        keys = self._each(
            self.tasks if at_end else self.retained + target, self.split, self.scored_episodes(at_end)
        )
        if self.split == "test" and self.criterion is None:
            keys += self._each(target, "validation", self.validation_episodes)
        if self.perturb and at_end:
            keys += self._each(self.perturbed_tasks(point.stage), "perturbed", self.test_episodes)
        return keys

    def learned(self, stage: int) -> tuple[str, ...]:
        """Return the target of a stage, as a tuple; nothing is learned in stage 0."""
        return self.target[stage - 1 : stage] if stage else ()

    def perturbed_tasks(self, stage: int) -> tuple[str, ...]:
        """Return the tasks with perturbed episodes at the end of a stage of a run that perturbs."""
        return self.retained + self.learned(stage)

    def is_learned(self, successes: int) -> bool:
        """Return whether this number of successes in a target's validation episodes meets the criterion."""
        return self.criterion is not None and successes >= self.goal

    @property
    def goal(self) -> int:
        """Least number of successes in a target's validation episodes that meets the criterion."""
        assert self.criterion is not None
        return math.ceil(self.criterion * self.validation_episodes - 1e-9)

    def scored_episodes(self, at_end: bool) -> int:
        """Return the number of scored episodes of a task, at the end of a stage or before it."""
        if self.split == "validation":
            return self.validation_episodes
        return self.test_episodes if at_end else self.curve_episodes

    @property
    def captured_episodes(self) -> int:
        """Episodes at the end of each stage that ask for skills in the scenes of its target."""
        return self.scored_episodes(True) if self.criterion is not None and self.retained else 0

    @staticmethod
    def _each(tasks: Sequence[str], split: Split, count: int) -> list[EpisodeKey]:
        return [EpisodeKey(task, split, number) for task in tasks for number in range(count)]
