"""ConSFT and its controls: the weights of the samples, and the gradient that they make."""

import dataclasses
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from helpers import build_method
from torch import Tensor

from clbench.base.seeding import seeded
from clbench.learning.adaptation import adapt
from clbench.learning.method import Progress, Stage
from clbench.learning.optimise import MethodError, optimise
from clbench.learning.prior import Prior
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.budget import Budget
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")
UNEVEN = {"kappa": 1.0, "tau_start": 1.0, "omega_min": 0.2}
"""Settings at which samples of an untrained policy have weights from the floor to above a half."""

# (t/T, omega at LOSSES) with the published constants, worked out by hand to three places
LOSSES = (0.001, 0.005, 0.01, 0.02, 0.05, 0.1)
TABLE = (
    (0.00, (0.001, 0.001, 0.001, 0.001, 0.001, 0.001)),
    (0.50, (0.001, 0.001, 0.001, 0.001, 0.001, 0.001)),
    (0.75, (0.011, 0.001, 0.001, 0.001, 0.001, 0.001)),
    (0.90, (0.149, 0.001, 0.001, 0.001, 0.001, 0.001)),
    (0.95, (0.385, 0.008, 0.001, 0.001, 0.001, 0.001)),
    (0.98, (0.683, 0.148, 0.022, 0.001, 0.001, 0.001)),
    (0.99, (0.826, 0.385, 0.149, 0.022, 0.001, 0.001)),
    (0.995, (0.909, 0.621, 0.386, 0.149, 0.009, 0.001)),
    (1.00, (0.995, 0.975, 0.951, 0.905, 0.779, 0.607)),
)


def _stage(steps: int) -> Stage:
    return Stage(1, TOY.task("right"), 0, steps, toy_source("right"), Prior({}))


def _started(spec: str, **changes: Any) -> Any:
    """Return a method that has begun its first stage."""
    method = build_method(spec, changes)
    method.start_task(TransformerPolicy(SMALL), _stage(10))
    return method


def _omega(loss: float, done: float, **changes: float) -> float:
    """Return the weight of a loss at the share `done` of the schedule, by Eq. 5, 11 and 12 of the paper."""
    constants = {"tau_start": 0.003, "tau_end": 5.0, "kappa": 25.0, "omega_min": 0.001, **changes}
    least = math.exp(-0.8)
    rho = (math.exp(-0.8 * min(done, 1.0) ** 3.5) - least) / (1 - least)
    tau = constants["tau_end"]
    if rho > 0:
        tau = min(constants["tau_start"] / rho, tau)
    return max(constants["omega_min"], math.exp(-constants["kappa"] * loss / tau))


def _flat(gradients: Any) -> Tensor:
    """Return gradients as one vector, zeros where there is none."""
    return torch.cat([gradient.flatten() for gradient in gradients])


def _gradient(policy: Policy, loss: Tensor) -> Tensor:
    """Return the gradient of `loss` by all weights, computed by itself."""
    return _flat(torch.autograd.grad(loss, list(policy.parameters()), materialize_grads=True))


def _set_gradient(method: Any, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
    """Return the gradient that the method's hooks set."""
    policy.zero_grad()
    method.gradients(policy, method.loss(policy, batch, progress))
    weights = policy.parameters()
    return _flat(torch.zeros_like(one) if one.grad is None else one.grad for one in weights)


@pytest.mark.parametrize(("done", "omegas"), TABLE)
def test_published_constants_give_the_weights_of_the_table(done: float, omegas: tuple[float, ...]) -> None:
    method: Any = build_method("consft", {})
    weights = method.weights(torch.tensor(LOSSES), Progress(round(2000 * done), 2000))
    assert weights.tolist() == pytest.approx(omegas, abs=5.1e-4)
    assert weights.tolist() == pytest.approx([_omega(loss, done) for loss in LOSSES], rel=1e-4)


@pytest.mark.parametrize("changes", [{}, {"tau_start": 1.0}, {"kappa": 3.0, "tau_end": 2.0}])
def test_temperature_follows_the_formula_and_never_falls(changes: dict[str, float]) -> None:
    method: Any = build_method("consft", changes)
    found = [method.temperature(Progress(step, 80)) for step in range(81)]
    # the temperature follows from the weight of one sample: tau = -kappa L / log omega
    kappa = changes.get("kappa", 25.0)
    weights = [_omega(1e-4, step / 80, omega_min=0.0, **changes) for step in range(81)]
    assert found == pytest.approx([-kappa * 1e-4 / math.log(weight) for weight in weights], rel=1e-4)
    assert found == sorted(found)


def test_beyond_the_schedule_the_temperature_stays_at_its_end() -> None:
    method: Any = build_method("consft", {"schedule": 0.5})
    assert [method.temperature(Progress(step, 100)) for step in (50, 51, 75, 100)] == [5.0] * 4
    assert method.temperature(Progress(49, 100)) < 5.0
    assert method.temperature(Progress(0, 100)) == pytest.approx(0.003)


@pytest.mark.parametrize(
    ("factor", "schedule", "length"), [(1.0, 1.0, 11.5), (0.1, 1.0, 47.5), (1.0, 3.25, 3.25 * 11.5)]
)
def test_of_a_stage_to_a_criterion_the_schedule_is_as_long_as_plain_fine_tuning_learns(
    factor: float, schedule: float, length: float
) -> None:
    method: Any = build_method("consft", {"step_factor": factor, "schedule": schedule})
    for step in (0, 5, 11, 47, 60):
        # of the 15 steps of the warm-up about half are lost, and the step factors then add up to about 4
        weight = _omega(1e-4, step / length, omega_min=0.0)
        tau = -25.0 * 1e-4 / math.log(weight)
        assert method.temperature(Progress(step, 1000, True)) == pytest.approx(tau, rel=1e-4)


def test_the_scale_of_the_loss_has_the_effect_of_scaled_losses() -> None:
    losses = torch.tensor(LOSSES)
    scaled: Any = build_method("consft", {"loss_scale": 0.1})
    published: Any = build_method("consft", {})
    for step in (0, 90, 99):
        expected = published.weights(0.1 * losses, Progress(step, 100))
        torch.testing.assert_close(scaled.weights(losses, Progress(step, 100)), expected)


@pytest.mark.parametrize(("scale", "first", "until"), [(0.01, 0.3, 97), (0.003, 1.0, 91), (0.001, 3.0, 71)])
def test_a_scale_is_a_first_temperature_until_that_one_reaches_its_end(
    scale: float, first: float, until: int
) -> None:
    losses = torch.tensor(LOSSES)
    scaled: Any = build_method("consft_calibrated", {"loss_scale": scale})
    started: Any = build_method("consft", {"tau_start": first})
    for step in range(until + 1):
        expected = started.weights(losses, Progress(step, 100))
        torch.testing.assert_close(scaled.weights(losses, Progress(step, 100)), expected)
    later = [method.weights(losses, Progress(until + 2, 100)) for method in (scaled, started)]
    assert bool((later[0] > later[1]).all())


def test_the_published_constants_give_only_losses_below_a_bound_a_weight_before_the_last_tenth() -> None:
    method: Any = build_method("consft", {})
    weights = method.weights(torch.tensor([0.0023, 0.0025]), Progress(1800, 2000)).tolist()
    assert weights[0] > 0.01 > weights[1]


def test_a_perfect_sample_weighs_1_and_a_hopeless_one_the_floor() -> None:
    method: Any = build_method("consft", {})
    losses = torch.tensor([0.0, math.inf])
    for step in (0, 50, 100):
        assert method.weights(losses, Progress(step, 100)).tolist() == pytest.approx([1.0, 0.001])


def test_an_infinite_loss_stops_the_run_although_its_weight_is_the_floor() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right").sample(2)
    # at flow time 1 the head reads noise alone: its velocity is finite, its target action is not
    batch = dataclasses.replace(
        batch, action=torch.full_like(batch.action, 1e25), draw=torch.ones(2), valid=torch.ones(2, 8)
    )
    assert policy.action_loss(batch).tolist() == [math.inf] * 2
    method = _started("consft")
    with pytest.raises(MethodError, match="step 0: loss is inf, not finite"):
        optimise(policy.parameters(), 1e-3, 1, lambda step: method.loss(policy, batch, Progress(step, 1)))
    assert method.diagnostics()["omega_counts"][0] == [2, 0, 0, 0, 0]


@pytest.mark.parametrize("step", [0, 60])
def test_the_gradient_is_the_mean_of_the_weighted_gradients_of_the_samples(step: int) -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    method = _started("consft", **UNEVEN)
    found = _set_gradient(method, policy, batch, Progress(step, 100))
    rows = [Batch(**{name: value[row : row + 1] for name, value in vars(batch).items()}) for row in range(8)]
    losses = [policy.action_loss(row).sum() for row in rows]
    omegas = [_omega(loss.item(), step / 100, **UNEVEN) for loss in losses]
    assert max(omegas) > 1.5 * min(omegas)
    parts = [omega * _gradient(policy, loss) for omega, loss in zip(omegas, losses, strict=True)]
    expected = torch.stack(parts).sum(dim=0) / 8
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-6)
    # the usual way with weights, which would cancel most of the method
    normalised = torch.stack(parts).sum(dim=0) / sum(omegas)
    assert (found - normalised).norm() > 0.5 * found.norm()


def test_no_gradient_flows_through_the_weights() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(8)
    method = _started("consft", **UNEVEN)
    assert not method.weights(policy.action_loss(batch), Progress(0, 100)).requires_grad
    found = _set_gradient(method, policy, batch, Progress(0, 100))
    losses = policy.action_loss(batch)
    through = _gradient(policy, (torch.exp(-losses).clamp(min=0.2) * losses).mean())
    assert (found - through).norm() > 0.5 * found.norm()


@pytest.mark.parametrize("seed", range(3))
def test_one_sample_disrupts_old_knowledge_by_the_square_of_its_weight(seed: int) -> None:
    """The paper's claim (Eq. 7): g'Fg of the weighted gradient is omega^2 times g'Fg of the plain one."""
    policy, batch = TransformerPolicy(SMALL, seed=seed), toy_source("right", seed=seed).sample(1)
    method = _started("consft", kappa=1.0, tau_start=1.0)
    weighted = _set_gradient(method, policy, batch, Progress(0, 100)).double()
    loss = policy.action_loss(batch).sum()
    omega = _omega(loss.item(), 0.0, kappa=1.0, tau_start=1.0)
    plain = _gradient(policy, loss).double()
    # F = A A' of rank 3, and g'Fg = |A'g|^2
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(len(plain), 3, generator=generator, dtype=torch.float64)
    risks = [float((root.T @ gradient).square().sum()) for gradient in (weighted, plain)]
    assert 0.001 < omega < 0.9
    assert risks[0] == pytest.approx(omega**2 * risks[1], rel=1e-3)


def test_the_histogram_counts_each_sample_of_each_step_in_its_part_of_the_schedule() -> None:
    method, policy = build_method("consft", {}), TransformerPolicy(SMALL)
    assert method.diagnostics() == {}
    adapt(policy, method, _stage(25), Budget(learning_rate=1e-3))
    diagnostics = method.diagnostics()
    assert diagnostics["omega_edges"] == [0.0, 0.01, 0.1, 0.5, 0.9, 1.0]
    steps = np.bincount([10 * step // 25 for step in range(25)])
    assert [sum(counts) for counts in diagnostics["omega_counts"]] == (16 * steps).tolist()
    method.start_task(policy, _stage(25))
    assert not np.any(method.diagnostics()["omega_counts"])  # a new stage counts anew


def test_the_last_part_of_the_histogram_also_counts_the_steps_after_the_schedule() -> None:
    method, policy = build_method("consft", {}), TransformerPolicy(SMALL)
    budget = Budget(learning_rate=1e-3, criterion=0.9)
    adapt(policy, method, _stage(30), budget, lambda step: step.done == 30)
    counts = [sum(part) for part in method.diagnostics()["omega_counts"]]
    # a schedule of 11.5 steps: the parts begin at 0, 1.15, 2.3, ...; the last at 10.35
    steps = np.bincount([min(9, math.floor(step / 1.15)) for step in range(30)])
    assert counts == (16 * steps).tolist()


def test_the_histogram_counts_the_weights() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=1).sample(64)
    method = _started("consft", kappa=2.0, tau_start=1.0)
    method.loss(policy, batch, Progress(7, 10))
    omegas = [_omega(loss, 0.7, kappa=2.0, tau_start=1.0) for loss in policy.action_loss(batch).tolist()]
    diagnostics = method.diagnostics()
    expected = np.histogram(omegas, diagnostics["omega_edges"])[0].tolist()
    assert len([count for count in expected if count]) > 1
    assert diagnostics["omega_counts"][7] == expected
    assert not np.any(np.delete(diagnostics["omega_counts"], 7, axis=0))


class Rounded(TransformerPolicy):
    """Has a loss of another type than the bins."""

    def action_loss(self, batch: Batch, hidden: list[Tensor] | None = None) -> Tensor:
        return super().action_loss(batch, hidden).bfloat16()


def test_the_histogram_counts_the_weights_of_a_policy_with_half_precision() -> None:
    method = _started("consft")
    method.loss(Rounded(SMALL), toy_source("right").sample(8), Progress(0, 10))
    assert np.sum(method.diagnostics()["omega_counts"]) == 8


@pytest.mark.parametrize("spec", ["consft", "constant_weight"])
def test_adam_takes_shorter_steps_after_all_weights_have_risen_together(spec: str) -> None:
    method, place = _started(spec, loss_scale=1.0), torch.zeros(1, requires_grad=True)
    losses, places = torch.full((4,), 0.05), [0.0]  # at the floor until the schedule ends after 11.5 steps

    def loss_at(step: int) -> Tensor:
        weights: Tensor = method.weights(losses, Progress(step, 1000, to_criterion=True))
        return (weights * place).mean()

    def keep(_: int) -> None:
        places.append(place.item())

    optimise([{"params": [place]}], 1.0, 22, loss_at, after=keep, schedule=lambda _: 1.0)
    lengths = -np.diff(places)
    assert lengths[:12] == pytest.approx([1.0] * 12, rel=1e-3)
    assert lengths[[12, 21]] == pytest.approx([0.42, 0.94], abs=0.01)


def test_the_calibrated_variant_and_the_controls_change_only_the_unit_of_the_loss() -> None:
    published, *others = (
        dataclasses.asdict(build_method(name, {}))
        for name in ("consft", "consft_calibrated", "constant_weight", "shuffled_weights")
    )
    assert others == [{**published, "loss_scale": 0.003}] * 3
    assert published == {
        "step_factor": 1.0,
        "tau_start": 0.003,
        "tau_end": 5.0,
        "kappa": 25.0,
        "decay": 0.8,
        "curvature": 3.5,
        "omega_min": 0.001,
        "loss_scale": 1.0,
        "schedule": 1.0,
    }


def test_a_constant_weight_is_the_mean_weight_of_consft_for_every_sample() -> None:
    losses = TransformerPolicy(SMALL).action_loss(toy_source("right", seed=2).sample(16))
    consft: Any = build_method("consft", UNEVEN)
    constant: Any = build_method("constant_weight", {**UNEVEN, "loss_scale": 1.0})
    for step in (0, 60, 99):
        uneven, even = (method.weights(losses, Progress(step, 100)) for method in (consft, constant))
        assert uneven.std() > 0.01
        assert even.tolist() == pytest.approx([float(uneven.mean())] * 16, rel=1e-5)


def test_the_gradient_of_a_constant_weight_is_a_multiple_of_sfts() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right", seed=2).sample(16)
    found = _set_gradient(
        _started("constant_weight", **UNEVEN, loss_scale=1.0), policy, batch, Progress(0, 100)
    )
    losses = policy.action_loss(batch)
    omega = np.mean([_omega(loss, 0.0, **UNEVEN) for loss in losses.tolist()])
    torch.testing.assert_close(found, float(omega) * _gradient(policy, losses.mean()), rtol=1e-3, atol=1e-6)


def test_shuffled_weights_are_consfts_in_another_order() -> None:
    losses = TransformerPolicy(SMALL).action_loss(toy_source("right", seed=2).sample(64))
    consft: Any = build_method("consft", UNEVEN)
    shuffled: Any = build_method("shuffled_weights", {**UNEVEN, "loss_scale": 1.0})
    with seeded("shuffle"):
        theirs = shuffled.weights(losses, Progress(0, 100))
    ours = consft.weights(losses, Progress(0, 100))
    assert theirs.tolist() != ours.tolist()
    assert theirs.sort().values.tolist() == ours.sort().values.tolist()


def test_at_every_step_the_shuffled_weights_are_consfts_of_that_step() -> None:
    losses = TransformerPolicy(SMALL).action_loss(toy_source("right", seed=2).sample(16))
    consft: Any = build_method("consft", UNEVEN)
    shuffled: Any = build_method("shuffled_weights", {**UNEVEN, "loss_scale": 1.0})
    for step in (0, 60, 99):
        found, expected = (one.weights(losses, Progress(step, 100)) for one in (shuffled, consft))
        assert found.sort().values.tolist() == expected.sort().values.tolist()


def test_every_order_of_the_weights_is_equally_likely_at_every_step() -> None:
    losses = torch.tensor([0.1, 0.4, 0.9, 1.5])
    shuffled: Any = build_method("shuffled_weights", {**UNEVEN, "loss_scale": 1.0})
    orders: Counter[tuple[float, ...]] = Counter()
    with seeded("orders"):
        for _ in range(2400):
            orders[tuple(shuffled.weights(losses, Progress(0, 100)).tolist())] += 1
    assert len(orders) == 24
    # 100 of each are expected, and 5 standard deviations are 49
    assert all(51 <= count <= 149 for count in orders.values())
