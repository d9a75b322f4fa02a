"""Budgets: the data, the optimiser steps and the evaluation episodes that every method gets."""

from __future__ import annotations

from dataclasses import dataclass

from clbench.base.errors import InputError
from clbench.spec.fields import check_number, check_positive, check_share, check_whole
from clbench.spec.protocol import Split, check_steps

HEADS = 4
"""Attention heads of a policy, which share its width."""


@dataclass(frozen=True)
class Budget:
    """Data, optimiser steps, size of the policy and evaluation episodes: the same for every method."""

    demonstrations: int = 200
    """Expert episodes per task."""
    noisy_demonstrations: float = 0.5
    """Share of the expert's attempts that may have action noise, from 0 to 1: some executed actions are
    random, while the recorded ones stay the expert's. The noise begins at random, with the task's probability
    in each step, and failed attempts are dropped: on Fetch-v1, 0.24 of the demonstrations contain some."""
    question_episodes: int = 200
    """Episodes that give the states of the training questions; the test questions get a quarter as many."""
    test_questions: int = 1000
    """Test questions asked at the end of each stage."""
    pretraining_steps: int = 3000
    """Optimiser steps of pretraining: on the retained skills, the background and the training questions."""
    pretraining_learning_rate: float = 1.5e-3
    """Peak learning rate of pretraining."""
    adaptation_steps: int = 300
    """Optimiser steps on each target; with a criterion, the maximum."""
    criterion: float | None = None
    """Success rate on the target's validation episodes that ends a stage; without a criterion, all stages
    are equally long."""
    learning_rate: float = 3e-4
    """Peak learning rate of adaptation, which each method multiplies by its `step_factor`."""
    batch_size: int = 64
    """Samples per optimiser step."""
    policy_width: int = 96
    """Channels of the policy's tokens."""
    policy_layers: int = 3
    """Layers of the policy's backbone, and as many of its action head."""
    evaluation_points: int = 4
    """Number of evaluation points of each stage, including its end; with a criterion, only its end."""
    validation_episodes: int = 10
    """Validation episodes per task; they may guide choices."""
    test_episodes: int = 20
    """Test episodes per task; they give scores and never guide choices."""
    curve_episodes: int = 5
    """Number of test episodes per task, counted from the first, at the points before the end of a stage."""

    def __post_init__(self) -> None:
        check_whole(self, 1, "demonstrations", "question_episodes", "test_questions")
        check_whole(self, 1, "adaptation_steps", "policy_width", "policy_layers")
        check_whole(self, 2, "batch_size")  # pretraining asks half as many questions
        check_whole(self, 1, "evaluation_points", "validation_episodes", "test_episodes")
        check_whole(self, 0, "pretraining_steps", "curve_episodes")
        check_positive(self, "pretraining_learning_rate", "learning_rate")
        check_share(self, "noisy_demonstrations")
        if self.curve_episodes > self.test_episodes:
            raise InputError(
                f"Budget.curve_episodes must be from 0 to test_episodes ({self.test_episodes}), not "
                f"{self.curve_episodes}."
            )
        if self.policy_width % HEADS:
            raise InputError(
                f"Budget.policy_width must be a multiple of {HEADS}, the number of attention heads, not "
                f"{self.policy_width}."
            )
        if self.criterion is not None:
            check_number(self, "criterion")
            if not 0 < self.criterion <= 1:
                raise InputError(
                    f"Budget.criterion must be a success rate above 0, at most 1, not {self.criterion}."
                )

    def episodes(self, split: Split) -> int:
        """Return the number of episodes per task in `split`."""
        return self.validation_episodes if split == "validation" else self.test_episodes

    @property
    def evaluation_steps(self) -> tuple[int, ...]:
        """Evaluation points of a stage, in optimiser steps, rising; the last one is the end of the stage.

        Each point comes at half the steps of the next: a policy learns and forgets most at the beginning.
        """
        halvings = range(self.evaluation_points if self.criterion is None else 1)
        points = (self.adaptation_steps >> halving for halving in halvings)
        return tuple(sorted({point for point in points if point}))

    @property
    def check_steps(self) -> tuple[int, ...]:
        """Steps of a stage at which the criterion is checked, rising; none without a criterion."""
        return () if self.criterion is None else check_steps(self.adaptation_steps)
