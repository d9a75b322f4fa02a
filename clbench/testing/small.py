"""What tests of a method's hooks begin with: a small policy's sizes, and sources of the toy's data."""

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
"""Sizes of a policy for the toy, as small as one with a second layer can be."""

SCENES = 200
"""States that questions are asked about."""


def toy_source(*tasks: str, seed: int = 0) -> Source[Batch]:
    """Return the demonstrations of some of the toy's tasks.

    Args:
        tasks: Their names.
        seed: Of what is drawn.
    """
    found = [TOY.task(name) for name in tasks]
    parts = [Demonstrations.of_task(task, collect(task, TOY.budget), SMALL.chunk) for task in found]
    generator = torch.Generator().manual_seed(seed)
    return Source(Demonstrations.cat(parts), generator, TOY.budget.batch_size)


def toy_questions(seed: int = 0) -> Source[QuestionBatch]:
    """Return the toy's questions about random states.

    Args:
        seed: Of what is drawn; the states are the same.
    """
    scenes = torch.randn(SCENES, 4, generator=torch.Generator().manual_seed(7))
    generator = torch.Generator().manual_seed(seed)
    return Source(Questions(resolve(TOY.questions), scenes), generator, TOY.budget.batch_size)
