import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from clbench.base.errors import InputError
from clbench.policy.decoding import IN_SEQUENCE, Kept, Thresholds, Work, easy_first, pipelined
from clbench.policy.discrete import DiscreteDiffusionHead

CHUNK, ACTION, BINS, WIDTH, LAYERS, PREFIX = 8, 3, 11, 16, 2, 6
LENGTH = CHUNK * ACTION
EVERY_BLOCK = pytest.mark.parametrize("block", [1, 2, 4, 8])


def head(block: int, sharpness: float = 12.0, seed: int = 0) -> DiscreteDiffusionHead:
    """Return a head whose probabilities lie between 1 / K and 1, as those of a trained head do."""
    torch.manual_seed(seed)
    made = DiscreteDiffusionHead(ACTION, CHUNK, WIDTH, LAYERS, 2, BINS, block)
    torch.nn.init.normal_(made.step, std=0.5)
    last = made.bin_out[1]
    assert isinstance(last, torch.nn.Linear)
    last.weight.data *= sharpness
    return made.eval().requires_grad_(False)


def observation(batch: int, seed: int = 0) -> tuple[list[Tensor], Tensor]:
    generator = torch.Generator().manual_seed(seed)
    hidden = [torch.randn(batch, PREFIX, WIDTH, generator=generator) for _ in range(LAYERS)]
    mask = torch.ones(batch, 1, 1, PREFIX, dtype=torch.bool)
    mask[::2, :, :, -2:] = False
    return hidden, mask


def algorithm_1(made: DiscreteDiffusionHead, hidden: Any, mask: Tensor, told: Thresholds) -> tuple[Any, int]:
    """Decode one chunk with loops over blocks and tokens, and return the tokens and the forwards.

    It is as the paper writes it, but for details 1 and 3 of the decoder.
    """
    size = (made.block or CHUNK) * ACTION
    tokens, begun, active = [made.bins] * LENGTH, 1, {0}

    def decoded(block: int) -> float:
        return sum(token != made.bins for token in tokens[block * size : (block + 1) * size]) / size

    forwards = 0
    while made.bins in tokens:
        if decoded(begun - 1) > told.add and begun < LENGTH // size:
            begun += 1
        active |= {block for block in range(1, begun) if decoded(block - 1) > told.activate}
        logits = made.logits(torch.tensor([tokens]), hidden, mask)[0].double().numpy()
        chances = np.exp(logits - logits.max(axis=1, keepdims=True))
        chances = (chances / chances.sum(axis=1, keepdims=True)).astype(np.float32)
        forwards += 1
        for block in range(begun):
            rest = [place for place in range(block * size, (block + 1) * size) if tokens[place] == made.bins]
            bar = told.confidence
            if block in active and rest:
                surest = sorted((chances[place].max() for place in rest), reverse=True)
                bar = min(bar, surest[max(1, len(rest) // told.part) - 1])
            for place in rest:
                if chances[place].max() >= bar:
                    tokens[place] = int(chances[place].argmax())
    return tokens, forwards


@EVERY_BLOCK
def test_the_pipeline_decodes_as_algorithm_1_says(block: int) -> None:
    for seed in range(6):
        made, (hidden, mask) = head(block, seed=seed), observation(1, seed)
        work = Work()
        tokens = pipelined(made, hidden, mask, work=work)
        expected, forwards = algorithm_1(made, hidden, mask, Thresholds())
        assert tokens[0].tolist() == expected
        assert len(work.spans) == forwards


@pytest.mark.parametrize("block", [2, 4])
def test_a_block_must_exceed_the_share_that_activates_the_next_one(block: int) -> None:
    told = Thresholds(confidence=0.9, add=0.25, activate=0.5)  # blocks are often decoded to one half
    for seed in range(12):
        made, (hidden, mask) = head(block, seed=seed), observation(1, seed)
        expected, _ = algorithm_1(made, hidden, mask, told)
        assert pipelined(made, hidden, mask, told)[0].tolist() == expected


@EVERY_BLOCK
def test_kept_keys_change_no_logit(block: int) -> None:
    made, (hidden, mask) = head(block), observation(1)
    size = block * ACTION
    tokens = torch.randint(0, BINS, (1, LENGTH), generator=torch.Generator().manual_seed(1))
    whole = made.logits(tokens, hidden, mask)
    forward = Kept(made, hidden, mask, block)
    for complete in range(LENGTH // size):
        end = min((complete + 2) * size, LENGTH)
        first = forward.place
        torch.testing.assert_close(
            forward(tokens[:, first:end], complete + 1), whole[:, first:end], atol=1e-5, rtol=0
        )


@EVERY_BLOCK
@pytest.mark.parametrize("told", [Thresholds(), IN_SEQUENCE, Thresholds(0.9, 0.3, 0.8, 3)], ids=str)
def test_many_chunks_get_the_tokens_of_each_alone_with_or_without_kept_keys(
    block: int, told: Thresholds
) -> None:
    made, (hidden, mask) = head(block), observation(7)
    together = pipelined(made, hidden, mask, told)
    assert together.equal(pipelined(made, hidden, mask, told, cached=True))
    for row in range(7):
        alone = pipelined(made, [layer[row : row + 1] for layer in hidden], mask[row : row + 1], told)
        assert together[row].equal(alone[0])


@EVERY_BLOCK
def test_logits_of_earlier_blocks_do_not_depend_on_later_tokens(block: int) -> None:
    made, (hidden, mask) = head(block), observation(2)
    tokens = torch.randint(0, BINS + 1, (2, LENGTH), generator=torch.Generator().manual_seed(2))
    before = made.logits(tokens, hidden, mask)
    size = block * ACTION
    for first in range(size, LENGTH, size):
        changed = tokens.clone()
        changed[:, first : first + size] = (changed[:, first : first + size] + 1) % BINS
        after = made.logits(changed, hidden, mask)
        assert after[:, :first].equal(before[:, :first])
        assert not after[:, first : first + size].equal(before[:, first : first + size])


def test_without_blocks_every_logit_depends_on_every_token() -> None:
    made, (hidden, mask) = head(0), observation(1)
    tokens = torch.full((1, LENGTH), BINS)
    before, changed = made.logits(tokens, hidden, mask), tokens.clone()
    changed[0, -1] = 0
    assert (made.logits(changed, hidden, mask) != before).any(dim=2).all()


DECODERS: dict[str, tuple[int, Callable[..., Tensor], int]] = {
    "easy first": (0, easy_first, 12),
    "pipeline": (1, pipelined, LENGTH),
    "in sequence": (1, partial(pipelined, thresholds=IN_SEQUENCE), LENGTH),
    "no blocks": (0, pipelined, LENGTH),
    "stale keys": (0, partial(pipelined, block=1, cached=True), LENGTH),
}


@pytest.mark.parametrize("name", DECODERS)
@pytest.mark.parametrize("sharpness", [0.0, 5.0, 40.0, math.nan])  # the last one as in a diverged policy
def test_every_decoder_ends_within_its_bound_and_leaves_no_mask(name: str, sharpness: float) -> None:
    block, decode, bound = DECODERS[name]
    made, forwards = head(block, sharpness), 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def count(*args: Any) -> Any:
            nonlocal forwards
            forwards += 1
            return function(*args)

        return count

    made.logits, made.go_on = counted(made.logits), counted(made.go_on)  # type: ignore[method-assign]
    tokens = decode(made, *observation(1))
    assert tokens.shape == (1, LENGTH)
    assert ((tokens >= 0) & (tokens < BINS)).all()
    assert 1 <= forwards <= bound


def test_a_decoder_that_is_never_sure_takes_one_token_of_one_block_per_forward() -> None:
    work, told = Work(), Thresholds(confidence=1.1, part=LENGTH + 1)
    pipelined(head(0), *observation(1), told, work=work)
    assert len(work.spans) == LENGTH
    assert work.tokens == LENGTH * LENGTH


def test_a_block_that_begins_after_a_complete_one_is_fully_activated_at_once() -> None:
    work, told = Work(), Thresholds(confidence=1.1, add=0.9, activate=0.9)
    pipelined(head(2), *observation(1), told, cached=True, work=work)
    # an unsure head takes 3, 1, 1 and 1 of the 6 tokens of a block
    assert len(work.spans) == 4 * (CHUNK // 2)


@EVERY_BLOCK
def test_a_decoder_that_is_always_sure_takes_one_block_per_forward(block: int) -> None:
    work, size = Work(), block * ACTION
    pipelined(head(block), *observation(1), Thresholds(confidence=0.0), cached=True, work=work)
    assert len(work.spans) == LENGTH // size
    # after the first, each forward has its own block and the last one, whose keys it keeps
    assert work.spans == [(max(0, end - 2 * size), end) for end in range(size, LENGTH + 1, size)]


def test_one_forward_takes_the_likeliest_token_everywhere() -> None:
    made, (hidden, mask) = head(0), observation(3)
    likeliest = made.logits(torch.full((3, LENGTH), BINS), hidden, mask).argmax(dim=2)
    assert easy_first(made, hidden, mask, steps=1).equal(likeliest)


def test_easy_first_masks_as_many_tokens_as_the_cosine_says() -> None:
    made, seen = head(0), []
    original = made.logits

    def watched(tokens: Tensor, hidden: list[Tensor], mask: Tensor) -> Tensor:
        seen.append(int((tokens == BINS).sum()))
        return original(tokens, hidden, mask)

    made.logits = watched  # type: ignore[method-assign]
    easy_first(made, *observation(1))
    assert seen == [math.floor(LENGTH * math.cos(math.pi / 2 * step / 12)) for step in range(12)]


def test_kept_keys_of_a_head_without_blocks_are_stale() -> None:
    made, (hidden, mask) = head(0), observation(1)
    tokens = torch.randint(0, BINS, (1, LENGTH), generator=torch.Generator().manual_seed(3))
    kept = Kept(made, hidden, mask, 1)
    kept(tokens[:, :ACTION], 1)
    later = kept(tokens[:, ACTION:], CHUNK)
    assert not torch.allclose(later, made.logits(tokens, hidden, mask)[:, ACTION:], atol=1e-3)


@pytest.mark.parametrize(
    ("block", "steps", "cached"), [(0, 3, True), (0, 1, False), (2, 1, False), (0, 0, True)]
)
def test_blocks_that_do_not_fit_are_refused(block: int, steps: int, cached: bool) -> None:
    with pytest.raises(InputError, match="locks of"):
        pipelined(head(block), *observation(1), block=steps, cached=cached)


def test_a_threshold_that_a_complete_block_cannot_exceed_is_refused() -> None:
    with pytest.raises(InputError, match="below 1"):
        Thresholds(activate=1.0)
    with pytest.raises(InputError, match=r"Thresholds\.add must be from 0 to 1"):
        Thresholds(add=2.0)
    with pytest.raises(InputError, match=r"Thresholds\.part must be .* not 0"):
        Thresholds(part=0)
    with pytest.raises(InputError, match="cannot be cut into blocks of 3"):
        head(3)
