"""Buffered replay: experience replay from a buffer of 2 % of the prior demonstrations.

The size of the buffer comes from arXiv 2603.03818. We have read only its abstract: with replay,
vision-language-action models forget little, even from little data. Another reader's note on the paper gives a
negative backward transfer of 0.1 to 0.2 with 2 % of the data (small networks: 0.4 to 0.5), and nearly none
with 20 %.

Details:
1. Before the first target, single time steps are drawn at random into the buffer, with replacement; all
   skills are equally likely. After each target, the same share of its data is added. No other prior data are
   seen again. The buffer also holds its share of the last target, whose demonstrations `experience_replay`
   never replays; `bytes kept` counts this share, too.
2. As in `experience_replay`, half of every batch is replayed by default. Flow time and noise are drawn anew
   each time. While the buffer is empty, because there is no earlier task, the batch holds only the target.
3. Unlike in `experience_replay`, all steps in the buffer are equally likely, so targets with longer
   demonstrations are replayed more often. A step keeps the wording of the instruction with which it was
   drawn.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from clbench.learning.method import Metadata, Method, MethodState, Stage
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy

from ._requirements import in_range

DRAWN = ("draw", "noise")
"""Parts of a batch that are drawn anew whenever a step is replayed."""


@dataclass
class BufferedReplay(Method):
    """Replay a small share of the prior demonstrations together with the target's."""

    share: float = 0.02
    """Share of the prior demonstrations in the buffer."""
    replay: float = 0.5
    """Replayed share of each batch."""

    uses = Uses(demonstrations="prepare")
    metadata = Metadata(link="https://arxiv.org/abs/2603.03818")
    tunes = ("replay", (0.75, 0.9))

    def __post_init__(self) -> None:
        in_range("share", self.share, 1e-9, 1.0)
        in_range("replay", self.replay, 0.0, 1.0)

    def _kept(self, source: Source[Batch]) -> Batch:
        return source.sample(max(1, round(self.share * len(source))))

    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Fill the buffer from the retained skills, if there are any."""
        known = len(prior.demonstrations) > 0
        self.buffer: Batch | None = self._kept(prior.demonstrations) if known else None

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        """Return one batch of target and buffered samples."""
        if self.buffer is None:
            return target.sample(target.batch_size)
        count = round(self.replay * target.batch_size)
        rows = torch.randint(len(self.buffer), (count,)).to(self.buffer.state.device)
        replayed = self.buffer[rows]
        replayed = dataclasses.replace(
            replayed, draw=torch.rand_like(replayed.draw), noise=torch.randn_like(replayed.noise)
        )
        return Batch.cat([target.sample(target.batch_size - count), replayed])

    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Add a share of the target's demonstrations to the buffer."""
        kept = self._kept(stage.target)
        self.buffer = kept if self.buffer is None else Batch.cat([self.buffer, kept])

    def state(self) -> MethodState:
        """Return the buffer without its draws, which every batch replaces; an empty buffer has no state."""
        columns = {} if self.buffer is None else vars(self.buffer)
        return {name: value for name, value in columns.items() if name not in DRAWN}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Restore the buffer."""
        columns = {name: value for name, value in state.items() if isinstance(value, Tensor)}
        if not columns:
            self.buffer = None
            return
        draw, noise = torch.zeros(len(columns["action"])), torch.zeros_like(columns["action"])
        self.buffer = Batch(**columns, draw=draw.to(noise.device), noise=noise)
