"""Batches of demonstrations and questions, in the same proportion as in pretraining."""

from clbench.learning.prior import Source
from clbench.policy.batch import Batch, QuestionBatch


def with_questions(
    demonstrations: Source[Batch], questions: Source[QuestionBatch]
) -> tuple[Batch, QuestionBatch]:
    """Return a batch of demonstrations, and half as many questions."""
    size = demonstrations.batch_size
    return demonstrations.sample(size), questions.sample(size // 2)
