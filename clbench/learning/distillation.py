"""Distillation of a discrete-diffusion policy for fast decoding: attention by blocks, and noise by blocks.

Fast-dVLA (Song et al., arXiv 2603.25661, sections 3.2 to 3.4): the student reads its own block and earlier
ones, each block has its own share of masked tokens, which grows along the chunk, and the student learns the
distributions of its teacher, which reads all blocks (eq. 4).

Deviations from the paper:

1. The student is a full copy of the action head. The paper trains adapters of rank 32 in a network of
   billions of weights. The backbone stays as it is, and so do the answers to questions.
2. Shares of masked tokens, and the loss, are those of the code of D2F (arXiv 2508.09192), whose recipe the
   paper follows: the cross-entropy to the teacher's distribution, which has the gradient of
   KL(teacher || student), weighted by 1 / share. The paper writes KL(student || teacher) and gives no shares.
3. The learning rate is that of pretraining.
4. The distillation takes a tenth of the steps of pretraining. The paper says a fifth to an eighth, and 4,000
   steps, which is less than a tenth of what its base models are known to have taken.
5. Blocks of several steps begin fully masked in the pipeline, but the shares of masked tokens are at most 0.7
   in training: such a student hardly ever sees a block of 16 tokens without one that is known.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from clbench.data.demonstrations import Demonstrations
from clbench.learning.optimise import deterministic, optimise
from clbench.policy.batch import Batch
from clbench.policy.discrete import DiscreteDiffusionHead
from clbench.policy.kinds import new_policy
from clbench.policy.policy import Policy
from clbench.spec.budget import Budget

LEAST_SHARE, MOST_SHARE = 0.2, 0.7
"""Bounds of the share of masked tokens in a block."""

SHARE_OF_STEPS = 0.1
"""Steps of the distillation, as a share of the pretraining steps; the paper has a fifth to an eighth."""


def distilled(
    teacher: Policy,
    demonstrations: Demonstrations,
    budget: Budget,
    generator: torch.Generator,
    block: int = 1,
) -> Policy:
    """Return a policy with block-causal attention that has learned from `teacher`, which stays as it is.

    Args:
        teacher: Policy with a bidirectional discrete-diffusion head.
        demonstrations: Demonstrations of pretraining.
        budget: Budget of pretraining.
        generator: Generator of every draw.
        block: Steps of the chunk in a block.
    """
    student = with_blocks(teacher, block)
    student.requires_grad_(False)
    head, teaching = discrete_head(student), discrete_head(teacher)
    head.requires_grad_(True)

    def loss_at(step: int) -> Tensor:
        batch = demonstrations.sample(budget.batch_size, generator).to(teacher.device)
        share = shares(torch.rand(len(batch), head.chunk // block, generator=generator)).to(teacher.device)
        drawn = torch.rand(len(batch), head.length, generator=generator).to(teacher.device)
        return distillation_loss(teacher, teaching, head, batch, share, drawn)

    with deterministic():
        optimise(
            head.parameters(),
            budget.pretraining_learning_rate,
            round(SHARE_OF_STEPS * budget.pretraining_steps),
            loss_at,
        )
    return student.requires_grad_(True)


def distillation_loss(
    teacher: Policy,
    teaching: DiscreteDiffusionHead,
    head: DiscreteDiffusionHead,
    batch: Batch,
    share: Tensor,
    drawn: Tensor,
) -> Tensor:
    """Return the loss of the student's head: the mean over the masked tokens of all samples that count.

    Args:
        teacher: Policy whose backbone reads the observations.
        teaching: Head of the teacher.
        head: Head of the student.
        batch: Demonstrated action chunks.
        share: Share of masked tokens of each block, (B, N).
        drawn: Uniform draws, (B, H * A): a token with a smaller draw than its block's share is masked.
    """
    with torch.no_grad():
        hidden = teacher.hidden_states(batch.state, batch.words, batch.image)
        mask = teacher.token_mask(batch.words)
        counts = batch.valid.bool().repeat_interleave(head.action_size, dim=1)
        by_token = share.repeat_interleave(head.length // share.shape[1], dim=1)
        hides = (drawn < by_token) | ~counts
        action = (batch.action - teacher.action_mean) / teacher.action_std
        tokens = head.tokens(action).masked_fill(hides, head.bins)
        target = teaching.logits(tokens, hidden, mask).softmax(dim=2)
    errors = -(target * head.logits(tokens, hidden, mask).log_softmax(dim=2)).sum(dim=2)
    judged = (hides & counts) / by_token
    return (errors * judged).sum() / (hides & counts).sum().clamp(min=1)


def shares(draws: Tensor) -> Tensor:
    """Return the shares of masked tokens (B, N), which grow along the chunk, from uniform draws (B, N).

    As in D2F, the first share is uniform, and each later one adds at most an equal part of the rest up to the
    bound.
    """
    first = LEAST_SHARE + (MOST_SHARE - LEAST_SHARE) * draws[:, :1]
    steps = draws[:, 1:] * (MOST_SHARE - first) / max(draws.shape[1] - 1, 1)
    return torch.cat([first, first + steps.cumsum(dim=1)], dim=1)


def with_blocks(policy: Policy, block: int) -> Policy:
    """Return a copy of a discrete-diffusion policy whose tokens read only their own block and earlier ones.

    Args:
        policy: The policy.
        block: Steps of the chunk in a block; 0 for none.
    """
    other = new_policy(dataclasses.replace(policy.config, block=block))
    other.load_state_dict(policy.state_dict())
    return other.to(policy.device)


def discrete_head(policy: Policy) -> DiscreteDiffusionHead:
    """Return the head of a discrete-diffusion policy.

    Raises:
        TypeError: The policy is of another kind.
    """
    if not isinstance(policy.head, DiscreteDiffusionHead):
        raise TypeError(f"A policy of kind {policy.config.kind!r} has no tokens to decode.")
    return policy.head
