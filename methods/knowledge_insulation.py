"""Knowledge insulation: the backbone trains on questions, not on the head's gradient (arXiv 2505.23705).

Details:
1. The backbone trains only on questions. In the paper it also learns to predict discrete action tokens
   (FAST), which this policy does not have, so here the backbone learns nothing about the new task.
2. Each batch of demonstrations comes with half as many questions, as in pretraining.
3. The paper stops the gradient at the backbone's keys and values, which its action expert reads. Here the
   head reads the backbone's hidden states, detached, with key and value maps of its own.
4. The factor alpha = 1 weights the action loss. It has almost no effect here: the action loss trains only the
   head, the answer loss trains only the backbone, and Adam cancels a constant factor. A factor of 0.3 or 3
   changes a step by 2 to 3 %, through the clipping that both losses share. Tuning therefore tries learning
   rates instead.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Metadata, Method, Progress
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import Policy

from ._questions import with_questions
from ._requirements import in_range


@dataclass
class KnowledgeInsulation(Method):
    """Train the head on detached hidden states, and the backbone on questions."""

    alpha: float = 1.0
    """Factor of the action loss."""

    uses = Uses(questions="throughout")
    needs = ("hidden_states", "answers")
    metadata = Metadata(link="https://arxiv.org/abs/2505.23705")

    def __post_init__(self) -> None:
        in_range("alpha", self.alpha, 0.0)

    def batch(self, target: Source[Batch], prior: Prior) -> tuple[Batch, QuestionBatch]:
        """Return a batch of the target, and half as many questions."""
        return with_questions(target, prior.questions)

    def loss(self, policy: Policy, batch: tuple[Batch, QuestionBatch], progress: Progress) -> Tensor:
        """Return the answer loss plus the action loss, whose gradient reaches the head alone."""
        demonstrations, questions = batch
        with torch.no_grad():
            hidden = policy.hidden_states(demonstrations.state, demonstrations.words, demonstrations.image)
        action_loss = policy.action_loss(demonstrations, hidden)
        return policy.answer_loss(questions).mean() + self.alpha * action_loss.mean()
