"""method_template: what it does, in one line, and the paper that describes it.

The rule in full, if the line above is not all of it.

Details:
1. Number each difference from the paper, and each choice that the paper leaves open.
2. `share` was chosen with `clbench tune`, which looks at validation episodes alone.
"""

from dataclasses import dataclass

from clbench import Batch, Metadata, Method, Policy, Progress, Uses
from torch import Tensor


@dataclass
class MethodTemplate(Method):
    """Leave the samples with the highest losses out of each step."""

    # Fields are hyper-parameters; the constructor stores them or refuses them.
    share: float = 0.9
    """Share of the batch that is trained on."""

    # Use of the prior data: "never", "prepare" (before the first target) or
    # "throughout". The method competes with methods that read the same data.
    uses = Uses(demonstrations="never", questions="never")
    metadata = Metadata(
        authors="Your name",
        link="https://example.org",
        licence="MIT",
        version="0.1",
    )

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise ValueError(f"share must be above 0 and at most 1, not {self.share}.")

    # Override what differs from plain fine-tuning; this hook is an example. The others
    # are watch_pretraining, prepare, start_task, batch, gradients, learning_rate,
    # end_task, diagnostics, and state with load_state: every stage begins with a new
    # object of the class, which has only what load_state sets.
    # help(clbench.Method) describes their arguments and results.
    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        """Return the mean of the lowest losses."""
        losses = policy.action_loss(batch)  # (B,): one for each sample
        count = max(1, round(self.share * len(losses)))
        return losses.topk(count, largest=False).values.mean()
