"""Buffered replay: the contents of the buffer, the replayed share, and the cost."""

import dataclasses
from typing import Any

import pytest
import torch
from helpers import build_method
from torch import Tensor

from clbench.data.demonstrations import Demonstrations, collect
from clbench.learning.method import Stage
from clbench.learning.prior import Nothing, Prior, Source
from clbench.policy.batch import Batch
from clbench.policy.transformer import TransformerPolicy
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")


def _prepared(**changes: Any) -> tuple[Any, Prior]:
    """Return a method that has filled its buffer, and the prior data, closed as in a run."""
    method = build_method("buffered_replay", changes)
    prior = Prior({"demonstrations": toy_source("left", "up")})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        method.prepare(TransformerPolicy(SMALL), prior)
    prior.close()
    return method, prior


def _stage(seed: int = 0) -> Stage:
    return Stage(1, TOY.task("right"), 0, 10, toy_source("right", seed=seed), Prior({}))


def _moments(batch: Batch) -> list[tuple[float, ...]]:
    """Return the samples of a demonstration: state, words and actions."""
    shown = [batch.state, batch.words, batch.action.flatten(1), batch.valid]
    return [tuple(row) for row in torch.cat([part.float() for part in shown], dim=1).tolist()]


def _ways(batch: Batch) -> set[tuple[float, ...]]:
    """Return the actions that a batch shows: each toy task has one of its own."""
    return {tuple(action) for action in batch.action[:, 0].tolist()}


@pytest.mark.parametrize("share", [0.001, 0.02, 0.1, 1.0])
def test_the_buffer_holds_its_share_of_the_prior_demonstrations_at_least_one(share: float) -> None:
    method, _ = _prepared(share=share)
    assert len(method.buffer) == max(1, round(share * len(toy_source("left", "up"))))


def test_both_skills_are_kept() -> None:
    method, _ = _prepared(share=0.2)
    assert _ways(method.buffer) == {(-1.0, 0.0), (0.0, 1.0)}


def test_the_buffer_counts_in_bytes() -> None:
    method, _ = _prepared(share=0.1)
    kept = [value.nbytes for value in method.state().values()]
    # for each moment 4 numbers of the state, 8 actions of 2, their flags; 12 words
    assert sum(kept) == len(method.buffer) * (4 * (4 + 16 + 8) + 8 * 12)


def test_half_of_each_batch_comes_from_the_buffer_alone_and_half_from_the_target() -> None:
    method, prior = _prepared(share=0.1)
    kept, target = set(_moments(method.buffer)), toy_source("right")
    replayed = set()
    for _ in range(10):
        batch = method.batch(target, prior)
        assert len(batch) == 16
        moments = _moments(batch)
        assert not kept & set(moments[:8])
        assert set(moments[8:]) <= kept
        replayed |= set(moments[8:])
    assert replayed == kept


@pytest.mark.parametrize(("replay", "count"), [(0.0, 0), (0.25, 4), (1.0, 16)])
def test_the_share_of_replay_is_taken_out_of_the_batch(replay: float, count: int) -> None:
    method, prior = _prepared(replay=replay, share=0.1)
    kept = set(_moments(method.buffer))
    found = [moment in kept for moment in _moments(method.batch(toy_source("right"), prior))]
    assert found == [False] * (16 - count) + [True] * count


def test_flow_time_and_noise_of_replayed_samples_are_drawn_anew() -> None:
    method, prior = _prepared(share=0.02)
    first, second = (method.batch(toy_source("right"), prior) for _ in range(2))
    draws = torch.cat([first.draw[8:], second.draw[8:], method.buffer.draw])
    assert len(set(draws.tolist())) == len(draws)
    noise = torch.cat([first.noise[8:], second.noise[8:], method.buffer.noise])
    assert len(set(noise.flatten().tolist())) == noise.numel()


def test_after_a_target_the_same_share_of_it_is_added() -> None:
    method, prior = _prepared(share=0.1)
    before, count = _moments(method.buffer), round(0.1 * len(toy_source("right")))
    method.end_task(TransformerPolicy(SMALL), _stage(seed=3))
    assert _moments(method.buffer) == before + _moments(toy_source("right", seed=3).sample(count))
    replayed = set()
    for _ in range(20):
        replayed |= set(_moments(method.batch(toy_source("down"), prior))[8:])
    assert replayed == set(_moments(method.buffer))


def test_the_buffer_begins_with_the_first_target_where_no_skill_is_retained_also_with_long_texts() -> None:
    method: Any = build_method("buffered_replay", {"share": 0.1})
    policy = TransformerPolicy(dataclasses.replace(SMALL, text_length=24))
    target = Source(
        Demonstrations.of_task(TOY.task("right"), collect(TOY.task("right"), TOY.budget), SMALL.chunk, 24),
        torch.Generator().manual_seed(0),
        TOY.budget.batch_size,
    )
    prior = Prior({"demonstrations": Source(Nothing(), torch.Generator(), TOY.budget.batch_size)})
    method.prepare(policy, prior)
    other: Any = build_method("buffered_replay", {"share": 0.1})
    other.load_state(policy, method.state())
    assert _ways(other.batch(target, prior)) == {(1.0, 0.0)}
    other.end_task(policy, Stage(1, TOY.task("right"), 0, 10, target, prior))
    assert other.buffer.words.shape == (round(0.1 * len(target)), 24)
    assert len(other.batch(target, prior)) == TOY.budget.batch_size


def test_the_buffer_survives_its_state() -> None:
    method, _ = _prepared(share=0.1)
    method.end_task(TransformerPolicy(SMALL), _stage())
    other: Any = build_method("buffered_replay", {"share": 0.1})
    other.load_state(TransformerPolicy(SMALL), method.state())
    for name, value in vars(method.buffer).items():
        again = getattr(other.buffer, name)
        assert isinstance(again, Tensor)
        assert again.shape == value.shape
        assert again.equal(value) or name in ("draw", "noise")  # which each batch draws anew
    batches = []
    for one in (method, other):
        with torch.random.fork_rng():
            torch.manual_seed(1)
            batches.append(one.batch(toy_source("down"), Prior({})))
    for name, value in vars(batches[0]).items():
        assert getattr(batches[1], name).equal(value), name
