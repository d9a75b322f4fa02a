"""Buffered replay: experience replay from a buffer of 2 % of the prior demonstrations.

The buffer sizes of arXiv 2603.03818, where a few per cent of the data nearly stop the forgetting of
vision-language-action models.

Details:
1. The buffer is drawn at random, moment by moment, each skill as likely as the other, before the first
   target; of each target the same share is added when it was learned. Nothing else of the prior data is seen
   again.
2. As in `experience_replay`, half of every batch is replayed. Flow time and noise are drawn anew each time.
   While the buffer is empty, as nothing was learned before, the batch is the target's alone.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Metadata, Method, Stage, State
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._requirements import blank_batch, in_range


@dataclass
class BufferedReplay(Method):
    """Replay a small share of the prior demonstrations next to the target's."""

    share: float = 0.02
    """Of the prior demonstrations that is kept."""
    replay: float = 0.5
    """Share of each batch that is replayed."""

    uses = Uses(demonstrations="prepare")
    metadata = Metadata(link="https://arxiv.org/abs/2603.03818")

    def __post_init__(self) -> None:
        in_range("share", self.share, 1e-9, 1.0)
        in_range("replay", self.replay, 0.0, 1.0)

    def _kept(self, source: Source[Batch]) -> Batch:
        return source.sample(max(1, round(self.share * len(source))))

    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Fill the buffer from the retained skills, if there are any."""
        known = len(prior.demonstrations)
        self.buffer = self._kept(prior.demonstrations) if known else blank_batch(policy, 0)

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        """Return target and buffered samples in one batch."""
        if not len(self.buffer):
            return target.sample(target.batch_size)
        count = round(self.replay * target.batch_size)
        rows = torch.randint(len(self.buffer), (count,)).to(self.buffer.state.device)
        replayed = Batch(**{name: value[rows] for name, value in vars(self.buffer).items()})
        replayed = dataclasses.replace(
            replayed, draw=torch.rand_like(replayed.draw), noise=torch.randn_like(replayed.noise)
        )
        return Batch.cat([target.sample(target.batch_size - count), replayed])

    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Add a share of the target."""
        self.buffer = Batch.cat([self.buffer, self._kept(stage.target)])

    def state(self) -> State:
        """Return the buffer."""
        return {**vars(self.buffer)}

    def load_state(self, policy: Policy, state: State) -> None:
        """Take the buffer back."""
        self.buffer = Batch(**{name: value for name, value in state.items() if isinstance(value, Tensor)})
