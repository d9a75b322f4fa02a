"""AEGIS: the anchor, and the projection of gradients that lead away from it."""

import dataclasses
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers import build_method
from numpy.typing import NDArray
from torch import Tensor, nn

from clbench.base.errors import InputError
from clbench.learning.adaptation import adapt
from clbench.learning.method import Progress, Stage
from clbench.learning.prior import Prior
from clbench.policy.activations import Gaussian
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.budget import Budget
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_questions, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = dataclasses.replace(SMALL, layers=4)
NOW = Progress(0, 100)


def _stage(steps: int) -> Stage:
    return Stage(1, TOY.task("right"), 0, steps, toy_source("right"), Prior({}))


def _moved(config: PolicyConfig = CONFIG, seed: int = 0, **changes: Any) -> tuple[Any, Policy]:
    """Return a method that has begun a stage, and its policy, which has moved away from the anchor."""
    method, policy = build_method("aegis", {"samples": 64, **changes}), TransformerPolicy(config, seed=1)
    method.prepare(policy, Prior({"questions": toy_questions()}))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in policy.parameters():
            weight.add_(torch.randn(weight.shape, generator=generator), alpha=0.02)
    method.start_task(policy, _stage(100))
    return method, policy


def _distance(policy: Policy, batch: Batch, anchor: Gaussian) -> Tensor:
    """Return ||mean - mean*||^2 + ||deviation - deviation*||^2 over channels, its mean over layers."""
    read = policy.token_mask(batch.words)[:, 0, 0]
    parts = []
    for layer, states in enumerate(policy.hidden_states(batch.state, batch.words)):
        rows = states[read]
        deviation = (rows.var(dim=0, correction=0) + 1e-6).sqrt()
        away = rows.mean(dim=0) - anchor.mean[layer], deviation - anchor.deviation[layer]
        parts.append(sum(part.square().sum() for part in away))
    return torch.stack([torch.as_tensor(part) for part in parts]).mean()


def _gradients(policy: Policy, loss: Tensor) -> dict[str, NDArray[np.float64]]:
    """Return the gradient of `loss` by all weights, by name."""
    names, weights = zip(*policy.named_parameters(), strict=True)
    found = torch.autograd.grad(loss, weights, materialize_grads=True)
    return {name: value.double().numpy() for name, value in zip(names, found, strict=True)}


def _block(gradients: Mapping[str, NDArray[np.float64]], layer: int) -> NDArray[np.float64]:
    """Return the gradient of all weights of one backbone layer as a vector."""
    start = f"backbone.layers.{layer}."
    return np.concatenate([value.ravel() for name, value in gradients.items() if name.startswith(start)])


def _set(policy: Policy) -> dict[str, NDArray[np.float64]]:
    """Return the gradients, zeros where there is none."""
    return {
        name: (torch.zeros_like(weight) if weight.grad is None else weight.grad).double().numpy()
        for name, weight in policy.named_parameters()
    }


def test_a_policy_with_a_frozen_backbone_is_refused() -> None:
    policy, method = TransformerPolicy(CONFIG), build_method("aegis", {"samples": 3})
    for layer in policy.backbone_layers:
        layer.requires_grad_(False)
    with pytest.raises(InputError, match="TransformerPolicy freezes all of its layers"):
        method.prepare(policy, Prior({"questions": toy_questions(3)}))


def test_the_anchor_is_the_gaussian_of_the_questions_that_prepare_draws() -> None:
    method: Any = build_method("aegis", {"samples": 50})
    policy, source = TransformerPolicy(CONFIG), toy_questions(3)
    prior = Prior({"questions": source})
    method.prepare(policy, prior)
    questions = toy_questions(3).sample(50)
    with torch.no_grad():
        hidden = policy.hidden_states(questions.state, questions.words)
    expected = Gaussian.of(hidden, policy.token_mask(questions.words))
    assert method.anchor.mean.equal(expected.mean)
    assert method.anchor.deviation.equal(expected.deviation)
    assert not method.anchor.mean.requires_grad


def test_training_needs_no_question_and_does_not_move_the_anchor() -> None:
    method: Any = build_method("aegis", {"samples": 50})
    policy, prior = TransformerPolicy(CONFIG), Prior({"questions": toy_questions(3)})
    method.prepare(policy, prior)
    prior.close()
    mean, deviation = method.anchor.mean.clone(), method.anchor.deviation.clone()
    adapt(policy, method, _stage(5), Budget(learning_rate=1e-3))
    assert method.anchor.mean.equal(mean)
    assert method.anchor.deviation.equal(deviation)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_sets_the_gradients_of_two_separate_passes_projected_layer_by_layer(seed: int) -> None:
    method, policy = _moved(seed=seed)
    batch = toy_source("right", seed=seed).sample(16)
    loss = method.loss(policy, batch, NOW)
    assert loss.item() == pytest.approx(policy.action_loss(batch).mean().item())
    method.gradients(policy, loss)
    found = _set(policy)
    plain = _gradients(policy, policy.action_loss(batch).mean())
    away = _gradients(policy, _distance(policy, batch, method.anchor))
    projected, energy, removed = 0, 0.0, 0.0
    for layer in range(CONFIG.layers):
        gradient, against = _block(plain, layer), _block(away, layer)
        product, norm = float(gradient @ against), float(against @ against)
        expected = gradient - min(product, 0.0) / norm * against
        np.testing.assert_allclose(_block(found, layer), expected, rtol=1e-3, atol=1e-5)
        projected += int(product < 0)
        energy, removed = energy + float(gradient @ gradient), removed + min(product, 0.0) ** 2 / norm
    diagnostics = method.diagnostics()
    assert diagnostics["layers_projected_mean"] == projected / CONFIG.layers
    assert diagnostics["energy_shed_mean"] == pytest.approx(removed / energy, rel=1e-3)
    assert diagnostics["anchor_distance"] == pytest.approx(
        [_distance(policy, batch, method.anchor).item()] * 11
    )


def test_the_steps_above_project_some_layers_and_leave_others() -> None:
    shares = []
    for seed in range(3):
        method, policy = _moved(seed=seed)
        method.gradients(policy, method.loss(policy, toy_source("right", seed=seed).sample(16), NOW))
        shares.append(method.diagnostics()["layers_projected_mean"])
    assert 0.0 < np.mean(shares) < 1.0


def test_a_projected_layer_is_orthogonal_to_the_anchor_and_the_others_keep_every_bit() -> None:
    kinds = set()
    for seed in range(3):
        method, policy = _moved(seed=seed)
        batch = toy_source("right", seed=seed).sample(16)
        policy.action_loss(batch).mean().backward()  # type: ignore[no-untyped-call]
        plain = _set(policy)
        policy.zero_grad()
        method.gradients(policy, method.loss(policy, batch, NOW))
        found, away = _set(policy), _gradients(policy, _distance(policy, batch, method.anchor))
        for layer in range(CONFIG.layers):
            before, after, against = (_block(each, layer) for each in (plain, found, away))
            kinds.add(bool(before @ against > 0))
            if before @ against > 0:
                assert np.array_equal(before, after)
            else:
                norms = np.linalg.norm(after) * np.linalg.norm(against)
                assert abs(after @ against) < 1e-5 * norms < 1e-3 * abs(before @ against)
    assert kinds == {True, False}


def test_parameters_outside_the_backbones_layers_keep_the_plain_gradient() -> None:
    method, policy = _moved()
    batch = toy_source("right").sample(16)
    policy.action_loss(batch).mean().backward()  # type: ignore[no-untyped-call]
    plain = _set(policy)
    policy.zero_grad()
    method.gradients(policy, method.loss(policy, batch, NOW))
    found = _set(policy)
    outside = [name for name in plain if not name.startswith("backbone.layers.")]
    assert {"backbone.words.weight", "backbone.position", "head.embed.weight"} <= set(outside)
    assert all(np.array_equal(plain[name], found[name]) for name in outside)
    assert policy.get_parameter("backbone.answer.1.weight").grad is None


def _by_hand(
    gradients: list[list[float]], against: list[list[float]], of: Any = None, **changes: Any
) -> tuple[Any, list[list[float]]]:
    """Return a method, and the gradients that it sets if loss and distance have these, layer by layer.

    It is the method `of` after a further step, or a new one.
    """
    layers = [nn.Linear(len(values), 1, bias=False) for values in gradients]
    policy: Any = SimpleNamespace(backbone_layers=layers)

    def linear(slopes: list[list[float]]) -> Tensor:
        parts = zip(layers, slopes, strict=True)
        return torch.stack([(layer.weight[0] * torch.tensor(slope)).sum() for layer, slope in parts]).sum()

    method: Any = of or build_method("aegis", changes)
    if of is None:
        method.start_task(TransformerPolicy(CONFIG), _stage(1))
    method.distances.append(linear(against))
    method.gradients(policy, linear(gradients))
    return method, [layer.weight.grad[0].tolist() for layer in layers if layer.weight.grad is not None]


def test_two_layers_worked_by_hand() -> None:
    # first: d = (1, 2)(-3, 1) = -1, ||a||^2 = 10: (1, 2) + (-3, 1) / 10; second: d = (2, 1)(1, 1) = 3, kept
    method, found = _by_hand([[1.0, 2.0], [2.0, 1.0]], [[-3.0, 1.0], [1.0, 1.0]])
    assert found[0] == pytest.approx([0.7, 2.1])
    assert found[1] == [2.0, 1.0]
    diagnostics = method.diagnostics()
    assert diagnostics["layers_projected_mean"] == 0.5
    assert diagnostics["energy_shed_mean"] == pytest.approx(0.01)  # 1 / 10 of 5 + 5
    assert diagnostics["energy_shed_highest"] == pytest.approx(0.01)


def test_the_diagnostics_are_means_over_the_steps_of_the_stage_and_the_highest_of_them() -> None:
    method, _ = _by_hand([[1.0, 2.0], [2.0, 1.0]], [[-3.0, 1.0], [1.0, 1.0]])  # sheds 0.01, one of two layers
    for gradients, against in (([[2.0], [0.0]], [[-1.0], [1.0]]), ([[1.0], [1.0]], [[1.0], [1.0]])):
        _by_hand(gradients, against, of=method)  # sheds everything, one of two layers; sheds nothing
    diagnostics = method.diagnostics()
    assert diagnostics["energy_shed_mean"] == pytest.approx((0.01 + 1 + 0) / 3)
    assert diagnostics["energy_shed_highest"] == pytest.approx(1)
    assert diagnostics["layers_projected_mean"] == pytest.approx((0.5 + 0.5 + 0) / 3)


def test_opposite_gradients_leave_nothing_and_orthogonal_or_absent_ones_everything() -> None:
    method, found = _by_hand([[1.0, 2.0], [2.0, 1.0], [3.0, 4.0]], [[-2.0, -4.0], [1.0, -2.0], [0.0, 0.0]])
    assert found[0] == pytest.approx([0.0, 0.0])
    assert found[1:] == [[2.0, 1.0], [3.0, 4.0]]
    assert method.diagnostics()["layers_projected_mean"] == pytest.approx(1 / 3)


def test_the_random_control_has_no_direction_either_where_the_anchor_gives_none() -> None:
    for _ in range(5):
        _, found = _by_hand([[1.0, 2.0]], [[0.0, 0.0]], direction="random")
        assert found == [[1.0, 2.0]]


@pytest.mark.parametrize("seed", range(4))
def test_the_energy_shed_by_one_layer_is_the_squared_cosine(seed: int) -> None:
    one_layer = PolicyConfig(state_size=4, action_size=2, width=32, layers=1)
    method, policy = _moved(one_layer, seed=seed)
    batch = toy_source("right", seed=seed).sample(16)
    method.gradients(policy, method.loss(policy, batch, NOW))
    gradient = _block(_gradients(policy, policy.action_loss(batch).mean()), 0)
    against = _block(_gradients(policy, _distance(policy, batch, method.anchor)), 0)
    cosine = gradient @ against / (np.linalg.norm(gradient) * np.linalg.norm(against))
    expected = cosine**2 if cosine < 0 else 0.0
    assert method.diagnostics()["energy_shed_mean"] == pytest.approx(expected, rel=1e-3, abs=1e-9)


def test_the_random_control_projects_against_directions_of_the_same_norm() -> None:
    method, policy = _moved(direction="random")
    batch = toy_source("right").sample(16)
    with torch.random.fork_rng():
        torch.manual_seed(5)
        method.gradients(policy, method.loss(policy, batch, NOW))
        torch.manual_seed(5)
        drawn = [
            np.concatenate(
                [torch.randn_like(weight).double().numpy().ravel() for weight in layer.parameters()]
            )
            for layer in policy.backbone_layers
        ]
    found, plain = _set(policy), _gradients(policy, policy.action_loss(batch).mean())
    away, projected = _gradients(policy, _distance(policy, batch, method.anchor)), 0
    for layer, direction in enumerate(drawn):
        gradient, norm = _block(plain, layer), np.linalg.norm(_block(away, layer))
        against = direction * norm / np.linalg.norm(direction)
        expected = gradient - min(float(gradient @ against), 0.0) / norm**2 * against
        np.testing.assert_allclose(_block(found, layer), expected, rtol=1e-3, atol=1e-5)
        projected += int(gradient @ against < 0)
    assert 0 < projected == method.diagnostics()["layers_projected_mean"] * CONFIG.layers


def test_the_anchor_survives_its_state() -> None:
    method, policy = _moved()
    other: Any = build_method("aegis", {})
    other.load_state(policy, method.state())
    other.start_task(policy, _stage(1))
    batch, found = toy_source("right").sample(16), []
    for each in (method, other):
        policy.zero_grad()
        each.gradients(policy, each.loss(policy, batch, NOW))
        found.append(_set(policy))
    assert all(np.array_equal(found[0][name], found[1][name]) for name in found[0])


@pytest.mark.long
def test_the_diagnostics_have_the_distance_at_eleven_steps_from_the_first_to_the_last() -> None:
    method, policy = build_method("aegis", {"samples": 50}), TransformerPolicy(CONFIG)
    method.prepare(policy, Prior({"questions": toy_questions(3)}))
    assert method.diagnostics() == {}
    adapt(policy, method, _stage(31), Budget(learning_rate=1e-3))
    diagnostics, distances = method.diagnostics(), method.distances  # type: ignore[attr-defined]
    assert diagnostics["anchor_distance"] == [float(distances[step]) for step in range(0, 31, 3)]
    assert 0.0 <= diagnostics["energy_shed_mean"] <= diagnostics["energy_shed_highest"] < 1.0
    adapt(policy, method, _stage(2), Budget(learning_rate=1e-3))
    again = method.diagnostics()["anchor_distance"]
    assert len(set(again)) == 2
    assert not set(again) & {float(distance) for distance in distances}  # of this stage alone
