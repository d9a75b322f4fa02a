"""Material for tests of a method's hooks: the sizes of a small policy, and sources of the toy's data."""

from __future__ import annotations

import torch

from clbench.base.entry_points import resolve
from clbench.data.demonstrations import Demonstrations, collect
from clbench.data.questions import Questions
from clbench.learning.prior import Source
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import PolicyConfig
from clbench.testing.toy import TOY

SMALL = PolicyConfig(state_size=4, action_size=2, width=32, layers=2)
"""Sizes of a small policy with two layers for the toy."""

SCENES = 200
"""Number of states that questions ask about."""


def toy_source(*tasks: str, seed: int = 0) -> Source[Batch]:
    """Return the demonstrations of some of the toy's tasks.

    Args:
        tasks: Names of the tasks.
        seed: Seed of the draws.
    """
    found = [TOY.task(name) for name in tasks]
    parts = [Demonstrations.of_task(task, collect(task, TOY.budget), SMALL.chunk) for task in found]
    generator = torch.Generator().manual_seed(seed)
    return Source(Demonstrations.cat(parts), generator, TOY.budget.batch_size)


def toy_questions(seed: int = 0) -> Source[QuestionBatch]:
    """Return the toy's questions about random states.

    Args:
        seed: Seed of the draws; the states do not depend on it.
    """
    scenes = torch.randn(SCENES, 4, generator=torch.Generator().manual_seed(7))
    generator = torch.Generator().manual_seed(seed)
    return Source(Questions(resolve(TOY.questions), scenes), generator, TOY.budget.batch_size)
