"""Experience replay: what each batch consists of."""

import pytest
import torch
from helpers import build_method

from clbench.learning.prior import Nothing, Prior, Source
from clbench.policy.batch import Batch
from clbench.testing import TOY
from clbench.testing.small import toy_source

RIGHT, LEFT, UP = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)
"""Actions of the toy's demonstrations: each task has one of its own."""


def _actions(batch: Batch) -> list[tuple[float, ...]]:
    return [tuple(action) for action in batch.action[:, 0].tolist()]


@pytest.mark.parametrize(("replay", "count"), [(0.0, 0), (0.25, 4), (0.5, 8), (0.9, 14), (1.0, 16)])
def test_replayed_samples_of_all_skills_take_the_place_of_samples_of_the_target(
    replay: float, count: int
) -> None:
    method = build_method("experience_replay", {"replay": replay})
    target, prior = toy_source("right"), Prior({"demonstrations": toy_source("left", "up")})
    replayed: set[tuple[float, ...]] = set()
    for _ in range(10):
        actions = _actions(method.batch(target, prior))
        assert len(actions) == TOY.budget.batch_size == 16
        assert actions[: 16 - count] == [RIGHT] * (16 - count)
        replayed |= set(actions[16 - count :])
    assert replayed == ({LEFT, UP} if count else set())


def test_the_batch_holds_the_target_alone_where_there_is_no_earlier_task() -> None:
    nothing = Prior({"demonstrations": Source(Nothing(), torch.Generator(), TOY.budget.batch_size)})
    batch = build_method("experience_replay", {"replay": 0.9}).batch(toy_source("right"), nothing)
    assert _actions(batch) == [RIGHT] * 16
