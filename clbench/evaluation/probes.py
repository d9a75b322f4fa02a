"""Probes: measure how far a policy has moved, from the pretrained policy or in one stage."""

from __future__ import annotations

import torch
from torch import Tensor

from clbench.policy.activations import Gaussian
from clbench.policy.batch import Batch, QuestionBatch, mean_over_valid
from clbench.policy.policy import Policy, evaluating

SPARSITY_THRESHOLD = 1e-3
"""Relative change below which a weight counts as unchanged: ConSFT (arXiv 2605.08879), Eq. 8."""


@torch.no_grad()
def activations(policy: Policy, questions: QuestionBatch) -> Gaussian:
    """Return a Gaussian of the policy's hidden states on `questions`, which are on the policy's device."""
    with evaluating(policy):
        hidden = policy.hidden_states(questions.state, questions.words, questions.image)
    return Gaussian.of(hidden, policy.token_mask(questions.words))


@torch.no_grad()
def update_sparsity(policy: Policy, pretrained: Policy) -> float | None:
    """Return the share of the pretrained weights that hardly changed, None if the parameter names differ.

    ConSFT (arXiv 2605.08879), Eq. 8: relative change below 1e-3.
    """
    before, now = dict(pretrained.named_parameters()), dict(policy.named_parameters())
    if now.keys() != before.keys():
        return None
    unchanged = [
        (now[name] - value).abs() / (value.abs() + 1e-8) < SPARSITY_THRESHOLD
        for name, value in before.items()
    ]
    return sum(int(part.sum()) for part in unchanged) / sum(part.numel() for part in unchanged)


@torch.no_grad()
def predictions(policy: Policy, batch: Batch) -> Tensor:
    """Return the predictions (B, H, A) of `policy` on `batch`, which is on the policy's device."""
    with evaluating(policy):
        return policy.predict(batch)


def shift(before: Tensor, after: Tensor, valid: Tensor) -> float:
    """Return the mean squared change from predictions `before` to `after`, both (B, H, A).

    It averages as the loss does: over the action dimensions and the valid steps (B, H), then over samples.
    """
    return float(mean_over_valid((after - before).square(), valid).mean())
