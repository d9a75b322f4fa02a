"""FastDVLA: the capability vector, the merge, and the regulariser that keeps it."""

import importlib
from copy import deepcopy
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
from helpers import build_method, weights_of
from torch import Tensor

from clbench.learning.method import Progress, Stage
from clbench.learning.optimise import optimise
from clbench.learning.prior import Prior
from clbench.learning.registry import load_method
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_questions, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")
FEW = {"steps": 6, "step_size": 1e-3}


def _prior(seed: int = 0) -> Prior:
    return Prior({"demonstrations": toy_source("left", "up", seed=seed), "questions": toy_questions(seed)})


def _prepared(policy: Policy, **changes: Any) -> Any:
    """Return a method that has prepared the policy and begun a stage."""
    method = build_method("fast_dvla", {**FEW, **changes})
    assert method.prepare(policy, _prior()) == 2 * FEW["steps"]
    method.start_task(policy, Stage(1, TOY.task("right"), 0, 10, toy_source("left", "up", seed=1), Prior({})))
    return method


def _regulariser_gradient(method: Any, policy: Policy) -> dict[str, Tensor]:
    """Return the term that the method adds to the gradient of a flat loss."""
    policy.zero_grad()
    flat = torch.stack([(0.0 * weight).sum() for weight in policy.parameters()]).sum()
    method.gradients(policy, flat)
    return {name: weight.grad for name, weight in policy.named_parameters() if weight.grad is not None}


def _moved(policy: Policy, seed: int = 0) -> None:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(torch.randn(weight.shape, generator=generator), alpha=0.01)


def _fine_tuned(policy: Policy, auxiliary: bool) -> dict[str, Tensor]:
    """Return the weights of a copy of the policy after six steps, questions weighing a half if asked."""
    copy, demonstrations, questions = deepcopy(policy), toy_source("left", "up"), toy_questions()

    def loss_at(_: int) -> Tensor:
        loss, asked = copy.action_loss(demonstrations.sample(16)).mean(), questions.sample(8)
        return loss + 0.5 * copy.answer_loss(asked).mean() if auxiliary else loss

    optimise(copy.parameters(), 1e-3, 6, loss_at)
    return weights_of(copy)


def test_the_vector_is_the_difference_of_two_fine_tunings_and_alpha_of_it_is_merged() -> None:
    policy = TransformerPolicy(SMALL, seed=3)
    before = weights_of(policy)
    plain, with_auxiliary = _fine_tuned(policy, False), _fine_tuned(policy, True)
    method = _prepared(policy, auxiliary=0.5, alpha=0.7)
    assert method.vector.keys() == before.keys()
    after = weights_of(policy)
    for name, value in before.items():
        expected = with_auxiliary[name] - plain[name]
        assert expected.abs().max() > 0, name
        torch.testing.assert_close(method.vector[name], expected, rtol=0, atol=1e-7)
        torch.testing.assert_close(after[name], value + 0.7 * expected, rtol=0, atol=1e-6)
        assert method.merged[name].equal(after[name])


def test_without_an_auxiliary_objective_there_is_no_vector() -> None:
    method = _prepared(TransformerPolicy(SMALL), auxiliary=0.0)
    assert not any(value.any() for value in method.vector.values())


def test_with_alpha_0_the_policy_stays_as_it_was_bit_for_bit() -> None:
    policy = TransformerPolicy(SMALL)
    before = weights_of(policy)
    method = _prepared(policy, alpha=0.0)
    assert any(value.any() for value in method.vector.values())
    assert all(weight.equal(before[name]) for name, weight in policy.named_parameters())


def test_the_regularisers_gradient_is_that_of_its_formula() -> None:
    policy = TransformerPolicy(SMALL)
    method = _prepared(policy, orthogonal=0.3)
    assert not any(value.any() for value in _regulariser_gradient(method, policy).values())  # sign(0) = 0
    _moved(policy)
    found = _regulariser_gradient(method, policy)
    names, weights = zip(*policy.named_parameters(), strict=True)
    parts = [
        (method.vector[name] * (weight - method.merged[name])).abs().sum()
        for name, weight in zip(names, weights, strict=True)
    ]
    expected = torch.autograd.grad(0.3 * torch.stack(parts).sum(), weights)
    assert found.keys() == set(names)
    for name, value in zip(names, expected, strict=True):
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-9)


def test_the_regularisers_gradient_agrees_with_finite_differences() -> None:
    policy = TransformerPolicy(SMALL)
    method = _prepared(policy, orthogonal=0.3)
    _moved(policy)
    found = _regulariser_gradient(method, policy)
    name = "backbone.layers.1.attention.key_value.weight"
    vector, merged, weight = (
        values[name].detach().double().numpy().ravel()
        for values in (method.vector, method.merged, dict(policy.named_parameters()))
    )

    def penalty(index: int, shift: float) -> float:
        shifted = weight.copy()
        shifted[index] += shift
        return float(0.3 * np.abs(vector * (shifted - merged)).sum())

    away = np.abs(weight - merged)
    indices = [index for index in range(len(weight)) if away[index] > 1e-3][:50]
    slopes = [(penalty(index, 1e-5) - penalty(index, -1e-5)) / 2e-5 for index in indices]
    assert max(np.abs(slopes)) > 1e-6
    np.testing.assert_allclose(found[name].numpy().ravel()[indices], slopes, rtol=1e-3, atol=1e-9)


def test_the_regulariser_is_added_to_the_gradient_of_the_loss() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("left", "up", seed=4).sample(8)
    method = _prepared(policy, orthogonal=0.3)
    _moved(policy)
    penalty = _regulariser_gradient(method, policy)
    policy.zero_grad()
    method.gradients(policy, method.loss(policy, batch, Progress(0, 10)))
    names, weights = zip(*policy.named_parameters(), strict=True)
    plain = torch.autograd.grad(policy.action_loss(batch).mean(), weights, allow_unused=True)
    for name, weight, value in zip(names, weights, plain, strict=True):
        if value is None:
            assert weight.grad is None
        else:
            assert weight.grad is not None
            torch.testing.assert_close(weight.grad, value + penalty[name], rtol=1e-5, atol=1e-7)


def test_the_random_control_has_the_norm_of_the_vector_in_each_matrix() -> None:
    first, second = TransformerPolicy(SMALL), TransformerPolicy(SMALL)
    vector, random = (_prepared(first).vector, _prepared(second, direction="random").vector)
    for name, value in vector.items():
        assert float(random[name].norm()) == pytest.approx(float(value.norm()), rel=1e-4), name
    large = [name for name, value in vector.items() if value.numel() > 1000]
    cosines = [
        float(torch.cosine_similarity(vector[name].flatten(), random[name].flatten(), dim=0))
        for name in large
    ]
    assert max(np.abs(cosines)) < 0.2
    for name, weight in second.named_parameters():
        start = dict(TransformerPolicy(SMALL).named_parameters())[name]
        torch.testing.assert_close(weight, start + 1.1 * random[name], rtol=0, atol=1e-6)


@pytest.mark.usefixtures("empty_caches")
def test_the_vector_is_made_once_and_its_steps_count_every_time(monkeypatch: pytest.MonkeyPatch) -> None:
    policies = [TransformerPolicy(SMALL, seed=5) for _ in range(3)]
    first = _prepared(policies[0])

    def explode(*_: Any) -> NoReturn:
        raise AssertionError("the vector is made a second time")

    monkeypatch.setattr(importlib.import_module(load_method("fast_dvla").__module__), "optimise", explode)
    second = _prepared(policies[1])
    assert all(second.vector[name].equal(value) for name, value in first.vector.items())
    # merging and regularising need no other vector; another objective, or another policy, does
    _prepared(policies[2], alpha=0.5, orthogonal=1.0, direction="random")
    for policy, changes in (
        (TransformerPolicy(SMALL, seed=5), {"auxiliary": 0.5}),
        (TransformerPolicy(SMALL, seed=5), {"step_size": 2e-3}),
        (TransformerPolicy(SMALL, seed=6), {}),
    ):
        with pytest.raises(AssertionError, match="made a second time"):
            _prepared(policy, **changes)


def test_other_demonstrations_make_another_vector() -> None:
    vectors = []
    for seed in (0, 1):
        method: Any = build_method("fast_dvla", FEW)
        method.prepare(TransformerPolicy(SMALL), _prior(seed))
        vectors.append(method.vector)
    assert not any(vectors[0][name].equal(vectors[1][name]) for name in vectors[0])


def test_vector_and_merged_weights_survive_the_state() -> None:
    policy = TransformerPolicy(SMALL)
    method = _prepared(policy, orthogonal=0.3)
    other: Any = build_method("fast_dvla", {"orthogonal": 0.3})
    other.load_state(policy, method.state())
    other.start_task(policy, Stage(2, TOY.task("down"), 0, 10, toy_source("left", "up", seed=1), Prior({})))
    _moved(policy)
    first, second = (_regulariser_gradient(each, policy) for each in (method, other))
    assert first.keys() == second.keys()
    assert all(value.equal(second[name]) for name, value in first.items())


@pytest.mark.usefixtures("empty_caches")
@pytest.mark.parametrize(
    ("name", "other"),
    [("arithmetic", lambda _: {"maker": "another"}), ("source_hash", lambda *_: "newer")],
)
def test_the_vector_is_made_anew_for_other_arithmetic_and_other_code(
    name: str, other: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module(load_method("fast_dvla").__module__)

    def prepare() -> None:
        prior = Prior({"demonstrations": toy_source("left", "up"), "questions": toy_questions()})
        build_method("fast_dvla", {"steps": 2}).prepare(TransformerPolicy(SMALL, seed=5), prior)

    def fail(*_: object) -> NoReturn:
        raise AssertionError("made a second time")

    prepare()
    monkeypatch.setattr(module, "optimise", fail)
    prepare()
    monkeypatch.setattr(module, name, other)
    with pytest.raises(AssertionError, match="made a second time"):
        prepare()
