"""Stop-gradient: the action head reads the backbone, but sends no gradient into it.

A baseline of AEGIS (arXiv 2604.16067). It keeps the backbone by not training it: the answers to questions
cannot change.

Details:
1. The hidden states of every layer are detached, keys and values alike.
2. The optimiser gets the head's weights only.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from clbench.learning.method import Metadata, Method, Progress, Stage
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy


@dataclass
class StopGradient(Method):
    """Train the action head alone, on the hidden states of a fixed backbone."""

    metadata = Metadata(link="https://arxiv.org/abs/2604.16067")
    needs = ("hidden_states",)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return the head's parameters."""
        return policy.head.parameters()

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the action loss on detached hidden states."""
        with torch.no_grad():
            hidden = policy.hidden_states(batch.state, batch.words, batch.image)
        return policy.action_loss(batch, hidden).mean()
