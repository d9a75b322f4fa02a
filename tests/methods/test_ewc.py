"""EWC and L2-SP: the pull on the weights, its anchor and its strength."""

from typing import Any

import pytest
import torch
from helpers import build_method, weights_of
from torch import Tensor

from clbench.learning.adaptation import adapt
from clbench.learning.method import Progress, Stage
from clbench.learning.prior import Nothing, Prior, Source
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.budget import Budget
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")
Weights = dict[str, Tensor]


def _stage(seed: int = 0) -> Stage:
    return Stage(1, TOY.task("right"), 0, 3, toy_source("right", seed=seed), Prior({}))


def _prepared(spec: str, policy: Policy, **changes: Any) -> Any:
    method = build_method(spec, changes)
    method.prepare(policy, Prior({"demonstrations": toy_source("left")}))
    return method


def _moved(policy: Policy) -> None:
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(torch.randn(weight.shape, generator=generator), alpha=0.1)


def _fisher(policy: Policy, source: Source[Batch], samples: int) -> Weights:
    """Return the mean squared gradient of the samples' losses, from one graph of all of them."""
    names, weights = zip(*policy.named_parameters(), strict=True)
    losses = policy.action_loss(Batch.cat([source.sample(1) for _ in range(samples)]))
    each = [torch.autograd.grad(loss, weights, retain_graph=True, materialize_grads=True) for loss in losses]
    return {
        name: torch.stack([gradients[index] for gradients in each]).square().mean(dim=0)
        for index, name in enumerate(names)
    }


def _check_close(found: Weights, expected: Weights) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-6)


def _set(method: Any, policy: Policy, batch: Batch) -> list[Tensor | None]:
    """Return the gradients that the method's hooks set."""
    policy.zero_grad()
    method.gradients(policy, method.loss(policy, batch, Progress(0, 10)))
    return [weight.grad for weight in policy.parameters()]


def test_importance_is_the_mean_squared_gradient_of_single_samples() -> None:
    policy = TransformerPolicy(SMALL)
    before = weights_of(policy)
    method = _prepared("ewc", policy, samples=12)
    _check_close(method.importance, _fisher(policy, toy_source("left"), 12))
    # not the square of the mean gradient, which is near 0 where training has ended
    batch = Batch.cat([source.sample(1) for source in [toy_source("left")] for _ in range(12)])
    (mean,) = torch.autograd.grad(
        policy.action_loss(batch).mean(), [policy.get_parameter("head.embed.weight")]
    )
    assert (method.importance["head.embed.weight"] > 1.2 * mean.square()).float().mean() > 0.5
    assert all(method.anchor[name].equal(weight) for name, weight in before.items())
    assert all(weight.grad is None for weight in policy.parameters())


def test_where_no_skill_is_retained_no_weight_is_important_during_the_first_target() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    method: Any = build_method("ewc", {"samples": 4})
    nothing = Source(Nothing(), torch.Generator(), TOY.budget.batch_size)
    method.prepare(policy, Prior({"demonstrations": nothing}))
    assert not any(value.any() for value in method.importance.values())
    _moved(policy)
    plain = torch.autograd.grad(policy.action_loss(batch).mean(), list(policy.head.parameters()))
    _set(method, policy, batch)
    assert all(
        one.grad is not None and one.grad.equal(value)
        for one, value in zip(policy.head.parameters(), plain, strict=True)
    )
    method.end_task(policy, _stage())
    assert any(value.any() for value in method.importance.values())


@pytest.mark.parametrize(
    ("spec", "changes"), [("ewc", {"samples": 4, "strength": 50.0}), ("l2_sp", {"strength": 0.7})]
)
def test_the_pull_is_the_gradient_of_the_penalty(spec: str, changes: dict[str, Any]) -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    method = _prepared(spec, policy, **changes)
    _moved(policy)
    found = _set(method, policy, batch)
    names, weights = zip(*policy.named_parameters(), strict=True)
    importance = method.importance if spec == "ewc" else dict.fromkeys(names, torch.tensor(1.0))
    penalty = torch.stack(
        [
            (importance[name] * (weight - method.anchor[name]).square()).sum()
            for name, weight in zip(names, weights, strict=True)
        ]
    ).sum()
    plain = torch.autograd.grad(policy.action_loss(batch).mean(), weights, allow_unused=True)
    pull = torch.autograd.grad(changes["strength"] / 2 * penalty, weights)
    for value, before, extra in zip(found, plain, pull, strict=True):
        if before is None:
            assert value is None  # the part that answers questions is not trained: nothing moves it
        else:
            assert value is not None
            torch.testing.assert_close(value, before + extra, rtol=1e-4, atol=1e-6)
    assert max(float(extra.norm()) for extra in pull) > 0.1


@pytest.mark.parametrize(("spec", "changes"), [("ewc", {"samples": 4}), ("l2_sp", {})])
def test_at_the_anchor_nothing_pulls(spec: str, changes: dict[str, Any]) -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    found = _set(_prepared(spec, policy, **changes), policy, batch)
    plain = torch.autograd.grad(
        policy.action_loss(batch).mean(), list(policy.parameters()), allow_unused=True
    )
    for value, expected in zip(found, plain, strict=True):
        assert (value is None) == (expected is None)
        assert value is None or expected is None or value.equal(expected)


def test_after_a_target_its_importance_is_added_and_the_anchor_moves_there() -> None:
    policy = TransformerPolicy(SMALL)
    method = _prepared("ewc", policy, samples=6)
    retained = {name: value.clone() for name, value in method.importance.items()}
    _moved(policy)
    method.end_task(policy, _stage(5))
    target = _fisher(policy, toy_source("right", seed=5), 6)
    _check_close(method.importance, {name: value + target[name] for name, value in retained.items()})
    assert all(method.anchor[name].equal(weight) for name, weight in policy.named_parameters())


def test_the_anchor_of_l2_sp_stays_where_pretraining_left_it() -> None:
    policy = TransformerPolicy(SMALL)
    before = weights_of(policy)
    method = _prepared("l2_sp", policy)
    adapt(policy, method, _stage(), Budget(learning_rate=1e-3))
    assert not any(weight.equal(before[name]) for name, weight in policy.head.named_parameters(prefix="head"))
    assert all(method.anchor[name].equal(weight) for name, weight in before.items())


@pytest.mark.parametrize(("spec", "changes"), [("ewc", {"samples": 4}), ("l2_sp", {})])
def test_anchor_and_importance_survive_the_state(spec: str, changes: dict[str, Any]) -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    method, other = _prepared(spec, policy, **changes), build_method(spec, changes)
    other.load_state(policy, method.state())
    _moved(policy)
    first, second = (_set(each, policy, batch) for each in (method, other))
    for one, two in zip(first, second, strict=True):
        assert (one is None) == (two is None)
        assert one is None or two is None or one.equal(two)


def test_a_stronger_penalty_leaves_the_weights_nearer_to_where_they_were() -> None:
    distances = []
    for strength in (0.0, 100.0):
        policy = TransformerPolicy(SMALL)
        before = weights_of(policy)
        stage = Stage(1, TOY.task("right"), 0, 30, toy_source("right"), Prior({}))
        adapt(policy, _prepared("l2_sp", policy, strength=strength), stage, Budget(learning_rate=1e-3))
        moved = [(weight - before[name]).square().sum() for name, weight in weights_of(policy).items()]
        distances.append(float(torch.stack(moved).sum()))
    assert distances[1] < 0.5 * distances[0]
