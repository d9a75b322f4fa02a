"""FastDVLA: a capability vector is added to the pretrained weights, and an orthogonal regulariser keeps it.

This is the method of CapVector (arXiv 2605.10903), which the abstract of "Fast-dVLA" (arXiv 2603.25661)
describes by mistake: the body of Fast-dVLA accelerates discrete-diffusion policies. The equations are
CapVector's. Two short fine-tunings on known skills, one with an auxiliary objective and one without, give two
sets of weights; their difference is the capability vector (Eq. 3). It is added to the pretrained weights
(Eq. 4). Plain fine-tuning follows, with a penalty on moving the weights where the vector is large:
lambda sum_i |g_i (theta_i - theta_meta_i)| (Eq. 7 and 8). The aim is to learn a target faster, not to forget
less.

CapVector's equations, tables and constants come from another reader's note, and two digests agree with it. We
have read only that paper's abstract: below, "the paper" means the paper as this note describes it. We have
read the whole paper of Fast-dVLA.

Details:
1. The auxiliary objective is to answer questions. The paper's Spatial Forcing aligns hidden states with those
   of a vision model instead. Both objectives give the backbone a second task besides acting, but the paper's
   second task is new to the policy, while questions are a part of the pretraining here. The vector therefore
   mostly shows the cost of 150 steps without questions: on Fetch-v1, seed 0, the two fine-tunings differ by
   0.78 in norm. Without questions, the weights move 1.02 away from the pretrained policy, and with questions
   1.13, in directions with a cosine of 0.74. A scenario whose policy has not been pretrained on questions
   would test the paper's premise more directly.
2. The paper extracts the vector from a small set of data that the policy has yet to learn. Here the
   extraction set is the demonstrations of all retained skills, which the policy has learned. So it is our
   choice of data that makes the method read prior demonstrations. The two fine-tunings take 150 steps each;
   the notes do not say how many the paper takes. Their learning rate rises for 8 steps and then falls along a
   cosine to a tenth, also where stages have a constant rate. Both see the same samples, in the same order and
   with the same draws.
3. The vector covers all parameters, including those of the answer head, which only the auxiliary objective
   trains. The paper drops the module of its objective. No parameter is newly initialised.
4. theta_meta is the merged policy for all targets of the sequence; the paper fine-tunes on one target.
5. The regulariser's gradient is added in closed form, lambda |g| sign(theta - theta_meta), with sign(0) = 0.
6. LoRA is not used: the full matrices are regularised. The paper chose lambda = 1e-4 for a policy of 7
   billion parameters, where the penalty covers only the A matrices of LoRA; here, tuning tried 0.01 and 1. At
   1e-4, which is the default and what tuning chose on MetaWorld-v1, the pull is at most about 1e-4 times the
   loss's gradient: the regulariser is in effect off.
7. The gradients of the regulariser and of the loss are clipped together, to a norm of 1, and go through Adam.
8. The vector is cached, but the steps that made it count in every row.
9. If nothing is retained, there is no skill to make a vector from: the run fails and says so.
10. Of the method's own settings, tuning chose only lambda. The auxiliary objective has the factor that
   pretraining gives questions, 1 (Spatial Forcing: 0.5), and alpha is the published 1.1. In the paper, the
   merge is worth more than the regulariser: 8.0 points of LIBERO's average after 5,000 steps, against 1.6
   (Table 1).

`direction="random"` is the control: a random vector with the capability vector's norm in each matrix.
"""

from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from clbench.base.cache import cache_folder, cached, hash_of, hash_of_tensors
from clbench.base.source import TRAINING_SOURCES, source_hash
from clbench.learning.method import Metadata, Method, MethodState, Stage
from clbench.learning.optimise import optimise
from clbench.learning.prior import Prior, Uses
from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.policy import Policy
from clbench.runs.fingerprint import arithmetic

from ._projection import random_like
from ._questions import with_questions
from ._requirements import in_range, one_of
from ._weights import Weights, copy_of, packed, unpacked

Drawn = list[tuple[Batch, QuestionBatch]]


@dataclass
class FastDVLA(Method):
    """Add a capability vector to the pretrained weights, and protect it during fine-tuning."""

    alpha: float = 1.1
    """Factor of the vector in the merge (Table S1)."""
    orthogonal: float = 1e-4
    """Factor lambda of the regulariser (Fig. 2b)."""
    auxiliary: float = 1.0
    """Factor of the auxiliary objective in the fine-tuning that makes the vector."""
    steps: int = 150
    """Optimiser steps of each of the two fine-tunings."""
    step_size: float = 3e-4
    """Peak learning rate of these fine-tunings, as in most scenarios; `step_factor` does not change it."""
    direction: str = "capability"
    """Vector to merge: "capability", or "random" for the control."""

    uses = Uses(demonstrations="prepare", questions="prepare")
    needs = ("answers",)
    metadata = Metadata(link="https://arxiv.org/abs/2605.10903")
    tunes = ("orthogonal", (1e-2, 1.0))

    def __post_init__(self) -> None:
        for name in ("alpha", "orthogonal", "auxiliary"):
            in_range(name, getattr(self, name), 0.0)
        in_range("steps", self.steps, 1)
        in_range("step_size", self.step_size, 1e-12)
        one_of("direction", self.direction, ("capability", "random"))

    def prepare(self, policy: Policy, prior: Prior) -> int:
        """Make the capability vector or read it from the cache, and merge it."""
        drawn = [with_questions(prior.demonstrations, prior.questions) for _ in range(self.steps)]
        self.vector = self._cached_vector(policy, drawn)
        if self.direction == "random":
            self.vector = {name: random_like([value])[0] for name, value in self.vector.items()}
        with torch.no_grad():
            for name, parameter in policy.named_parameters():
                parameter.add_(self.vector[name], alpha=self.alpha)
        self.merged = copy_of(policy)
        return 2 * self.steps

    def _cached_vector(self, policy: Policy, drawn: Drawn) -> Weights:
        """Return theta_ao - theta_ft (Eq. 3), cached by policy, drawn samples and settings."""
        columns = {
            f"{number}.{type(part).__name__}.{name}": value
            for number, parts in enumerate(drawn)
            for part in parts
            for name, value in vars(part).items()
        }
        inputs = {
            "policy": hash_of_tensors(policy.state_dict()),
            "hardware": arithmetic(str(policy.device)),
            "drawn": hash_of_tensors(columns),
            "settings": [self.auxiliary, self.steps, self.step_size],
            "source": source_hash(__name__, *TRAINING_SOURCES),
            "torch": torch.__version__,
        }

        def make(folder: Path) -> None:
            plain = _fine_tuned(policy, drawn, 0.0, self.step_size)
            with_auxiliary = _fine_tuned(policy, drawn, self.auxiliary, self.step_size)
            vector = {name: with_auxiliary[name] - value for name, value in plain.items()}
            save_file(vector, folder / "vector.safetensors")

        folder = cached(cache_folder() / "vectors" / hash_of(inputs), inputs, make)
        return load_file(folder / "vector.safetensors", device=str(policy.device))

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return all parameters, and compute the regulariser's weights."""
        self.pull = {name: self.orthogonal * value.abs() for name, value in self.vector.items()}
        return policy.parameters()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the loss and the orthogonal regulariser (Eq. 8)."""
        loss.backward()  # type: ignore[no-untyped-call]
        with torch.no_grad():
            for name, parameter in policy.named_parameters():
                if parameter.grad is not None:
                    parameter.grad.addcmul_((parameter - self.merged[name]).sign_(), self.pull[name])

    def state(self) -> MethodState:
        """Return the vector and the merged weights."""
        return {**packed("vector", self.vector), **packed("merged", self.merged)}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Restore the vector and the merged weights."""
        self.vector, self.merged = unpacked("vector", state), unpacked("merged", state)


def _fine_tuned(policy: Policy, drawn: Drawn, auxiliary: float, step_size: float) -> Weights:
    """Return the weights of a copy of the policy, fine-tuned on the drawn samples in their order."""
    copy = deepcopy(policy)
    batches: Iterator[tuple[Batch, QuestionBatch]] = iter(drawn)

    def loss_at(step: int) -> Tensor:
        batch, questions = next(batches)
        loss = copy.action_loss(batch).mean()
        return loss + auxiliary * copy.answer_loss(questions).mean() if auxiliary else loss

    optimise(copy.parameters(), step_size, len(drawn), loss_at)
    return copy_of(copy)
