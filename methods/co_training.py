"""Co-training: plain fine-tuning that continues to train on questions.

The auxiliary objective is present at every step. AEGIS (arXiv 2604.16067) calls this the costly alternative;
the capability vector of CapVector (arXiv 2605.10903) is meant to replace it.

Details:
1. Each batch of demonstrations comes with half as many questions, as in pretraining.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Metadata, Method, Progress
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import Policy

from ._questions import with_questions
from ._requirements import in_range


@dataclass
class CoTraining(Method):
    """Minimise the sum of the target's action loss and the answer loss of the questions."""

    auxiliary: float = 1.0
    """Factor of the answer loss."""

    uses = Uses(questions="throughout")
    needs = ("answers",)
    metadata = Metadata(link="https://arxiv.org/abs/2604.16067")
    tunes = ("auxiliary", (0.3, 3.0))

    def __post_init__(self) -> None:
        in_range("auxiliary", self.auxiliary, 0.0)

    def batch(self, target: Source[Batch], prior: Prior) -> tuple[Batch, QuestionBatch]:
        """Return a batch of the target, and half as many questions."""
        return with_questions(target, prior.questions)

    def loss(self, policy: Policy, batch: tuple[Batch, QuestionBatch], progress: Progress) -> Tensor:
        """Return the action loss plus the weighted answer loss."""
        demonstrations, questions = batch
        return (
            policy.action_loss(demonstrations).mean() + self.auxiliary * policy.answer_loss(questions).mean()
        )
