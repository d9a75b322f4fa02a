"""Budgets: the data, the optimiser steps and the evaluation episodes that every method gets."""

from __future__ import annotations

from dataclasses import dataclass

from clbench.base.errors import InputError
from clbench.spec.protocol import Split


@dataclass(frozen=True)
class Budget:
    """What every method gets: data, steps, a policy of one size, and evaluation episodes."""

    demonstrations: int = 200
    """Expert episodes per task."""
    noisy_demonstrations: float = 0.5
    """Share of the demonstrations with action noise: random actions are executed, the expert's are recorded."""
    question_episodes: int = 200
    """Episodes whose states the training questions ask about; a quarter as many more are for the report."""
    test_questions: int = 1000
    """Questions asked at the end of each stage."""
    pretraining_steps: int = 3000
    """Optimiser steps on the retained tasks and the training questions."""
    pretraining_learning_rate: float = 1.5e-3
    """Peak step size of pretraining."""
    adaptation_steps: int = 300
    """Optimiser steps on each target task."""
    learning_rate: float = 3e-4
    """Peak step size of adaptation."""
    batch_size: int = 64
    """Samples per step."""
    policy_width: int = 96
    """Channels of the policy's tokens."""
    policy_layers: int = 3
    """Layers of the policy's backbone, and as many of its action head."""
    evaluation_points: int = 4
    """How often the policy is evaluated while a target is learned, the end included."""
    validation_episodes: int = 10
    """Episodes per task that choices may look at."""
    test_episodes: int = 20
    """Episodes per task that scores are made of, and nothing else."""
    curve_episodes: int = 5
    """How many of the test episodes are run at the points before a stage's end."""

    def __post_init__(self) -> None:
        if self.curve_episodes > self.test_episodes:
            raise InputError(
                f"curve_episodes are the first of the {self.test_episodes} test episodes: "
                f"{self.curve_episodes} are too many."
            )

    def episodes(self, split: Split) -> int:
        """Return how many episodes per task `split` has."""
        return self.validation_episodes if split == "validation" else self.test_episodes

    @property
    def evaluation_steps(self) -> tuple[int, ...]:
        """After how many optimiser steps of a stage the policy is evaluated; the last is its end.

        Each point lies at half the steps of the next: a policy learns and forgets most at the beginning.
        """
        points = (self.adaptation_steps >> halvings for halvings in range(self.evaluation_points))
        return tuple(sorted({point for point in points if point}))
