"""Batches: they can be indexed, joined and shown."""

from typing import Any

import pytest
import torch

from clbench.policy.batch import Batch


def _sample(count: int) -> Batch:
    size = (count, 8, 2)
    words = torch.randint(9, (count, 12))
    return Batch(
        torch.randn(count, 4),
        words,
        torch.randn(size),
        torch.ones(size[:2]),
        torch.rand(count),
        torch.randn(size),
    )


@pytest.mark.parametrize(
    "rows", [slice(1, 3), [2, 0], torch.tensor([False, True, True, False]), torch.tensor([3])]
)
def test_batches_can_be_indexed_and_joined_so_that_a_buffer_takes_few_lines(rows: Any) -> None:
    batch = _sample(4)
    chosen = batch[rows]
    assert torch.equal(chosen.state, batch.state[rows])
    assert torch.equal(chosen.noise, batch.noise[rows])
    joined = Batch.cat([chosen, batch])
    assert len(joined) == len(chosen) + 4
    assert torch.equal(joined.words[len(chosen) :], batch.words)


def test_a_batch_is_shown_in_one_line() -> None:
    shapes = "state (2, 4), words (2, 12), action (2, 8, 2), valid (2, 8), draw (2,), noise (2, 8, 2)"
    assert repr(_sample(4)[:2]) == f"<Batch of 2 samples: {shapes}>"
