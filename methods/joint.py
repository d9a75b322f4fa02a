"""Joint: all data of everything met so far, questions included. The upper guide.

A reference row: it keeps every demonstration and is no answer to forgetting, but it says what this policy and
this budget of steps allow. Its success right after a target is the a* of intransigence (Chaudhry 2018).
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Method, Progress
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import Policy


@dataclass
class Joint(Method):
    """Train on the target, on all prior demonstrations and on the questions at once."""

    uses = Uses(demonstrations="throughout", questions="throughout", reference=True)

    def batch(self, target: Source[Batch], prior: Prior) -> tuple[Batch, QuestionBatch]:
        """Return a batch of the target, one of prior demonstrations, if any, and half a one of questions."""
        size = target.batch_size
        batch = target.sample(size)
        if len(prior.demonstrations):
            batch = Batch.cat([batch, prior.demonstrations.sample(size)])
        return batch, prior.questions.sample(size // 2)

    def loss(self, policy: Policy, batch: tuple[Batch, QuestionBatch], progress: Progress) -> Tensor:
        """Return the sum of the action loss and the answer loss, as in pretraining."""
        demonstrations, questions = batch
        return policy.action_loss(demonstrations).mean() + policy.answer_loss(questions).mean()
