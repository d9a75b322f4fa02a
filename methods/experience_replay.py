"""Experience replay: every batch mixes the target with demonstrations of what was learned before.

Rehearsal as in Rolnick et al. 2019 (arXiv 1811.11682), for vision-language-action models in arXiv 2603.03818.
Details:
1. Prior data are all demonstrations of the retained skills and of the targets learned before, each task as
   likely as the other.
2. The batch has the budget's size: the share of replay is taken out of the target's.
3. Where nothing was learned before, the batch is the target's alone.
"""

from dataclasses import dataclass

from clbench.learning.method import Metadata, Method
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch


@dataclass
class ExperienceReplay(Method):
    """Replay prior demonstrations next to the target's."""

    replay: float = 0.5
    """Share of each batch that is replayed; 0.5 is 1:1."""

    uses = Uses(demonstrations="throughout")
    metadata = Metadata(link="https://arxiv.org/abs/1811.11682")

    def __post_init__(self) -> None:
        if not 0 <= self.replay <= 1:
            raise ValueError(f"replay must be from 0 to 1, not {self.replay}.")

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        """Return target and prior samples in one batch."""
        replayed = round(self.replay * target.batch_size)
        if not len(prior.demonstrations):
            return target.sample(target.batch_size)
        return Batch.cat([target.sample(target.batch_size - replayed), prior.demonstrations.sample(replayed)])
