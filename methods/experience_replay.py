"""Experience replay: every batch mixes the target with demonstrations of earlier tasks.

This is rehearsal as in Rolnick et al. 2019 (arXiv 1811.11682), without their additional terms that clone the
behaviour; arXiv 2603.03818 applies rehearsal to vision-language-action models.

Details:
1. Prior data are all demonstrations of the retained skills and of the earlier targets. All tasks are equally
   likely.
2. The batch has the budget's size: replayed samples replace samples of the target.
3. If there is no earlier task, the batch holds only the target.
"""

from dataclasses import dataclass

from clbench.learning.method import Metadata, Method
from clbench.learning.prior import Prior, Source, Uses
from clbench.policy.batch import Batch

from ._requirements import in_range


@dataclass
class ExperienceReplay(Method):
    """Replay prior demonstrations together with the target's."""

    replay: float = 0.5
    """Replayed share of each batch; 0.5 is 1:1."""

    uses = Uses(demonstrations="throughout")
    metadata = Metadata(link="https://arxiv.org/abs/1811.11682")
    tunes = ("replay", (0.75, 0.9))

    def __post_init__(self) -> None:
        in_range("replay", self.replay, 0.0, 1.0)

    def batch(self, target: Source[Batch], prior: Prior) -> Batch:
        """Return one batch of target and prior samples."""
        replayed = round(self.replay * target.batch_size)
        if not len(prior.demonstrations):
            return target.sample(target.batch_size)
        return Batch.cat([target.sample(target.batch_size - replayed), prior.demonstrations.sample(replayed)])
