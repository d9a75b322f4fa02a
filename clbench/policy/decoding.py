"""Decoders of a masked chunk: easy first, and the pipeline of blocks of Fast-dVLA.

Fast-dVLA (Song et al., arXiv 2603.25661, section 3.4 and Algorithm 1): the chunk grows block by block. The
next block begins before the last one is complete, all blocks that have begun share each forward, and the keys
and values of the observation and of complete blocks are kept. A block is complete when none of its tokens is
masked. It is fully activated (D2F's word, arXiv 2508.09192) when it takes tokens however sure they are.

Details that the paper leaves open:

1. A fully activated block takes at least one token of each forward. The paper's floor(R / n) is 0 for a last
   token.
2. Keys of a complete block are kept by the forward after the one that completed it, which no longer reads its
   masks (as in the code of D2F, whose recipe the paper follows).
3. A block that begins when its predecessor has passed `activate` is fully activated in its first forward, as
   in the code of D2F. Algorithm 1, as we noted it, marks the block after that forward: blocks of 1 step would
   take 15.4 forwards instead of 14.1.
4. Easy-first decoding, with which the pipeline is compared, also reads the observation once for a chunk: only
   the head runs in each forward. The paper's base models read the observation in every forward, and much of
   its speed-up comes from keeping that part.
5. Many chunks at a time are decoded without kept keys. No token reads a later block, so the tokens are equal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from clbench.base.errors import InputError
from clbench.spec.fields import check_share, check_whole

if TYPE_CHECKING:
    from clbench.policy.discrete import DiscreteDiffusionHead

EASY_FIRST_STEPS = 12
"""Forwards of easy-first decoding: the number of Discrete Diffusion VLA (arXiv 2508.20072)."""


Decoder: TypeAlias = "Callable[[DiscreteDiffusionHead, list[Tensor], Tensor], Tensor]"
"""Maps a head, hidden states of the backbone and the mask (B, 1, 1, P) to the tokens (B, H * A)."""


@dataclass(frozen=True)
class Thresholds:
    """When the pipeline takes a token and begins a block; the defaults are the paper's.

    Raises:
        InputError: `add` or `activate` is not a share below 1: a complete block must exceed both.
    """

    confidence: float = 0.5
    """Probability from which a token is taken (tau_conf)."""
    add: float = 0.5
    """Share of a block's tokens above which the next block begins (tau_add)."""
    activate: float = 0.7
    """Share of a block's tokens above which the next one takes a part of its tokens at each forward, however
    sure they are (tau_act)."""
    part: int = 2
    """Such a block takes at least one in `part` of its masked tokens at each forward (n)."""

    def __post_init__(self) -> None:
        check_share(self, "add", "activate")
        check_whole(self, 1, "part")
        if max(self.add, self.activate) == 1:
            raise InputError("add and activate must be below 1: a complete block must exceed them.")


IN_SEQUENCE = Thresholds(add=0.999, activate=0.999)
"""Thresholds with which a block begins when the one before it is complete (Block Diffusion)."""


@dataclass
class Work:
    """The forwards of the head that a decoder made."""

    spans: list[tuple[int, int]] = field(default_factory=list)
    """First token of each forward, and the token after its last."""

    @property
    def tokens(self) -> int:
        """Number of tokens in all forwards."""
        return sum(end - first for first, end in self.spans)


def easy_first(
    head: DiscreteDiffusionHead,
    hidden: list[Tensor],
    mask: Tensor,
    steps: int = EASY_FIRST_STEPS,
    work: Work | None = None,
) -> Tensor:
    """Return the tokens (B, H * A) after `steps` forwards, each of which keeps the surest predictions.

    After forward s, floor(L cos(pi / 2 * s / steps)) of the L tokens are still masked. With a single step,
    every token is the likeliest one. `work` receives the forwards.
    """
    length = head.length
    tokens = torch.full((len(mask), length), head.bins, device=mask.device)
    for step in range(1, steps + 1):
        confidence, best = head.logits(tokens, hidden, mask).softmax(dim=2).max(dim=2)
        hides = tokens == head.bins
        keep = math.floor(length * math.cos(math.pi / 2 * step / steps))
        order = confidence.masked_fill(~hides, math.inf).argsort(dim=1, descending=True, stable=True)
        tokens = torch.where(hides & (order.argsort(dim=1) < length - keep), best, tokens)
        if work is not None:
            work.spans.append((0, length))
    return tokens


def pipelined(
    head: DiscreteDiffusionHead,
    hidden: list[Tensor],
    mask: Tensor,
    thresholds: Thresholds = Thresholds(),
    block: int | None = None,
    cached: bool = False,
    work: Work | None = None,
) -> Tensor:
    """Return the tokens (B, H * A) that the pipeline of blocks decodes.

    Args:
        head: Head of the policy.
        hidden: Hidden states of the backbone, one (B, P, W) per layer.
        mask: Mask of the prefix tokens that are read, (B, 1, 1, P).
        thresholds: When tokens are taken and blocks begin.
        block: Steps of a block. None means the blocks of the head's attention, or the whole chunk if it has
            no blocks. If `cached`, a head without blocks may be given some: its kept keys are then stale.
        cached: Whether the keys and values of complete blocks are kept; chunks are then decoded one by one.
        work: Receives the forwards.
    """
    steps = (head.block or head.chunk) if block is None else block
    if steps < 1 or head.chunk % steps:
        raise InputError(f"A chunk of {head.chunk} steps cannot be cut into blocks of {steps}.")
    if not cached and steps not in (head.block, head.chunk):
        raise InputError(
            f"Blocks of {steps} steps need kept keys (cached=True): the head's blocks have "
            f"{head.block} steps."
        )
    if cached and len(mask) > 1:
        rows = range(len(mask))
        parts = [[layer[row : row + 1] for layer in hidden] for row in rows]
        one_by_one = [
            pipelined(head, part, mask[row : row + 1], thresholds, block, True, work)
            for row, part in zip(rows, parts, strict=True)
        ]
        return torch.cat(one_by_one)
    blocks = Blocks(head, len(mask), steps, thresholds, mask.device)
    forward = Kept(head, hidden, mask, steps) if cached else None
    while blocks.any_masked:
        blocks.add()
        if forward is None:
            first, end = 0, head.length
            logits = head.logits(blocks.tokens, hidden, mask)
        else:
            first, end = forward.place, blocks.end
            logits = forward(blocks.tokens[:, first:end], blocks.complete)
        if work is not None:
            work.spans.append((first, end))
        blocks.take(logits, first)
    return blocks.tokens


class Kept:
    """Forwards of one chunk that keep the keys and values of the observation and of complete blocks."""

    def __init__(self, head: DiscreteDiffusionHead, hidden: list[Tensor], mask: Tensor, steps: int) -> None:
        self.head, self.mask = head, mask
        self.size = steps * head.action_size
        """Tokens of a block."""
        self.place = 0
        """First token whose keys are not kept."""
        self.keys = head.begin(hidden)

    def __call__(self, tokens: Tensor, complete: int) -> Tensor:
        """Return the logits (1, n, K) of the tokens (1, n) from `place` on.

        The first `complete` blocks have no mask: their keys and values are kept.
        """
        logits, keys = self.head.go_on(tokens, self.place, self.keys, self.mask)
        self.place = complete * self.size
        self.keys = [layer[:, :, :, : self.mask.shape[3] + self.place] for layer in keys]
        return logits


class Blocks:
    """The state of the pipeline for B chunks of N blocks: their tokens, and which blocks have begun."""

    def __init__(
        self,
        head: DiscreteDiffusionHead,
        batch: int,
        steps: int,
        thresholds: Thresholds,
        device: torch.device,
    ) -> None:
        self.bins, self.thresholds = head.bins, thresholds
        count = head.chunk // steps
        self.shape = (count, steps * head.action_size)
        """Blocks, and tokens of a block."""
        self.tokens = torch.full((batch, head.length), self.bins, device=device)
        self.number = torch.arange(count, device=device)
        self.begun = torch.ones(batch, 1, dtype=torch.int64, device=device)
        """Number of blocks that have begun, (B, 1)."""
        self.activated = (self.number == 0).expand(batch, -1).clone()
        """Whether a block is fully activated, (B, N); the first one is from the start."""
        self._look()

    def _look(self) -> None:
        """Count the masked tokens of each block again, after some were taken."""
        self.masked = (self.tokens == self.bins).view(-1, *self.shape)
        left = self.masked.sum(dim=2)
        self.left = left
        """Number of masked tokens by block, (B, N)."""
        self.share = 1 - left / self.shape[1]
        """Share of each block's tokens that are decoded, (B, N)."""
        by_block = left.amax(dim=0).tolist()
        self.any_masked = any(by_block)
        """Whether a token of any chunk is masked."""
        self.complete = next((number for number, count in enumerate(by_block) if count), len(by_block))
        """Number of leading blocks without a mask in all chunks."""

    @property
    def end(self) -> int:
        """Place after the last token of the blocks that have begun in any chunk."""
        return int(self.begun.max()) * self.shape[1]

    def add(self) -> None:
        """Begin the next block of each chunk whose last block is far enough, and fully activate blocks."""
        last = self.share.gather(1, self.begun - 1)
        self.begun += (last > self.thresholds.add) & (self.begun < self.shape[0])
        follows = self.share[:, :-1] > self.thresholds.activate
        self.activated[:, 1:] |= follows & (self.number < self.begun)[:, 1:]

    def take(self, logits: Tensor, first: int) -> None:
        """Take the sure tokens, given the logits (B, n, K) of the tokens from `first` on."""
        confidence, best = logits.softmax(dim=2).max(dim=2)
        confidence = confidence.nan_to_num()  # a diverged policy is sure of nothing, and must come to an end
        rest = self.tokens.shape[1] - first - logits.shape[1]
        sure = F.pad(confidence, (first, rest)).view(-1, *self.shape)
        masked = self.masked & (self.number < self.begun)[:, :, None]
        sure = sure.masked_fill(~masked, -math.inf)
        least = (self.left // self.thresholds.part).clamp(min=1)[:, :, None]
        bar = sure.sort(dim=2, descending=True).values.gather(2, least - 1)
        bar = bar.clamp(max=self.thresholds.confidence)
        bar = torch.where(self.activated[:, :, None], bar, self.thresholds.confidence)
        taken = (masked & (sure >= bar)).flatten(1)
        self.tokens = torch.where(taken, F.pad(best, (first, rest)), self.tokens)
        self._look()
