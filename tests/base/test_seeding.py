import random

import numpy as np
import torch

from clbench.base.seeding import derive_seed, draws_restored, numpy_generator, seeded, torch_generator


def test_the_same_name_gives_the_same_stream_and_another_name_another() -> None:
    assert numpy_generator("a", 1).random() == numpy_generator("a", 1).random()
    first, second = (torch.rand(2, generator=torch_generator("a", seed)) for seed in (1, 2))
    assert not first.equal(second)
    assert len({derive_seed("episode", seed, number) for seed in range(30) for number in range(30)}) == 900
    assert derive_seed("a", "bc") != derive_seed("ab", "c")


def _draws() -> tuple[float, float, float]:
    return random.random(), float(np.random.rand()), float(torch.rand(()))  # noqa: NPY002


def test_a_seeded_block_repeats_its_draws_and_leaves_the_global_generators_as_they_were() -> None:
    with seeded("block", 3):
        inside = _draws()
    random.seed(0), np.random.seed(0), torch.manual_seed(0)  # noqa: NPY002
    expected = _draws()
    random.seed(0), np.random.seed(0), torch.manual_seed(0)  # noqa: NPY002
    with seeded("block", 3):
        assert _draws() == inside
    assert _draws() == expected


def test_draws_inside_a_block_that_restores_them_come_again() -> None:
    with seeded("block", 3):
        with draws_restored():
            first = _draws()
        assert _draws() == first
