"""Joint: training on the demonstrations of all skills and targets so far, and on the questions.

This is a reference row: it keeps these demonstrations, so it does not solve forgetting. Like every other
method, it never sees demonstrations of the background, the tasks of pretraining that no score counts. It is
not an upper bound: it is not tuned, and where stages end at a criterion, they end after few steps. Replay
scores higher there, and also on FetchPixels-v0. The success of `joint` right after a target is a* in
intransigence (Chaudhry 2018).

Details:
1. A step reads a batch of the target, as many prior samples if there are any, and half as many questions: 2.5
   times the samples of a step of `sft`.
"""

from dataclasses import dataclass

from torch import Tensor

from clbench.learning.method import Method, Progress
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import Policy

from ._questions import with_questions


@dataclass
class Joint(Method):
    """Train on the target, all prior demonstrations and the questions together."""

    uses = Uses(demonstrations="throughout", questions="throughout", reference=True)
    needs = ("answers",)

    def batch(self, target: Source[Batch], prior: Prior) -> tuple[Batch, QuestionBatch]:
        """Return target samples, as many prior samples if there are any, and half as many questions."""
        batch, questions = with_questions(target, prior.questions)
        if len(prior.demonstrations):
            batch = Batch.cat([batch, prior.demonstrations.sample(target.batch_size)])
        return batch, questions

    def loss(self, policy: Policy, batch: tuple[Batch, QuestionBatch], progress: Progress) -> Tensor:
        """Return the sum of the action loss and the answer loss, which pretraining also minimises."""
        demonstrations, questions = batch
        return policy.action_loss(demonstrations).mean() + policy.answer_loss(questions).mean()
