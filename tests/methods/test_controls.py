"""Methods that differ from fine-tuning by a line or two: rivals and controls."""

import dataclasses
import math
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from helpers import build_method, weights_of
from numpy.typing import NDArray
from torch import Tensor

from clbench.learning.adaptation import adapt
from clbench.learning.method import Method, Progress, Stage
from clbench.learning.prior import Prior
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.budget import Budget
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_questions, toy_source

pytestmark = pytest.mark.usefixtures("one_thread")
NOW = Progress(0, 100)


def _prior() -> Prior:
    return Prior({"demonstrations": toy_source("left"), "questions": toy_questions()})


def _stage(steps: int = 5) -> Stage:
    return Stage(1, TOY.task("right"), 0, steps, toy_source("right"), _prior())


def _adapt(policy: Policy, method: Method, steps: int = 5) -> None:
    method.prepare(policy, _prior())
    adapt(policy, method, _stage(steps), Budget(learning_rate=1e-3))


def _gradients(policy: Policy, loss: Tensor) -> dict[str, Tensor]:
    """Return the gradient of `loss` by all weights, computed by itself."""
    names, weights = zip(*policy.named_parameters(), strict=True)
    return dict(zip(names, torch.autograd.grad(loss, weights, materialize_grads=True), strict=True))


def _set_by(method: Method, policy: Policy, batch: Any) -> dict[str, Tensor]:
    """Return the gradients that the method's hooks set, zeros where there is none."""
    policy.zero_grad()
    method.gradients(policy, method.loss(policy, batch, NOW))
    return {
        name: torch.zeros_like(weight) if weight.grad is None else weight.grad
        for name, weight in policy.named_parameters()
    }


def _check_close(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-6)


# ---- LwF ---------------------------------------------------------------------------------------------------


def _distilled(policy: Policy, teacher: Policy, batch: Batch) -> float:
    """Return the mean over samples of the squared difference of the velocities at valid steps."""
    with torch.no_grad():
        away = (policy.predict(batch) - teacher.predict(batch)).double().numpy() ** 2
    counts = batch.valid.numpy() > 0
    return float(np.mean([away[row][counts[row]].mean() for row in range(len(batch))]))


def test_lwf_distils_the_policy_that_the_target_began_with() -> None:
    method, policy = build_method("lwf", {"strength": 0.7}), TransformerPolicy(SMALL)
    method.prepare(policy, Prior({}))
    method.start_task(policy, _stage())  # of the target before
    _adapt(policy, build_method("sft", {}))
    method.start_task(policy, _stage())
    teacher = deepcopy(policy)
    _adapt(policy, build_method("sft", {}), steps=10)
    batch = toy_source("right", seed=3).sample(16)
    distilled = _distilled(policy, teacher, batch)
    assert distilled > 1e-3
    loss = method.loss(policy, batch, NOW)
    expected = policy.action_loss(batch).mean().item() + 0.7 * distilled
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_at_the_first_step_of_lwf_there_is_nothing_to_distil() -> None:
    method, policy, batch = build_method("lwf", {}), TransformerPolicy(SMALL), toy_source("right").sample(16)
    method.start_task(policy, _stage())
    plain = policy.action_loss(batch).mean()
    assert method.loss(policy, batch, NOW).item() == plain.item()
    _check_close(_set_by(method, policy, batch), _gradients(policy, plain))


def test_the_teacher_of_lwf_does_not_learn() -> None:
    method: Any = build_method("lwf", {})
    policy = TransformerPolicy(SMALL)
    before = weights_of(policy)
    _adapt(policy, method)
    assert not policy.get_parameter("head.embed.weight").equal(before["head.embed.weight"])
    assert all(weight.equal(before[name]) for name, weight in method.teacher.named_parameters())
    assert not method.teacher.training  # or its dropout would draw, and its batch norm would learn


def test_the_gradient_of_lwf_sums_both_terms() -> None:
    method, policy, batch = (
        build_method("lwf", {"strength": 0.7}),
        TransformerPolicy(SMALL),
        toy_source("up").sample(8),
    )
    method.start_task(policy, _stage())
    teacher = deepcopy(policy)
    _adapt(policy, build_method("sft", {}), steps=10)
    errors = (policy.predict(batch) - teacher.predict(batch).detach()).square().mean(dim=2)
    parts = [errors[row][batch.valid[row] > 0].mean() for row in range(8)]
    expected = _gradients(policy, policy.action_loss(batch).mean() + 0.7 * torch.stack(parts).mean())
    _check_close(_set_by(method, policy, batch), expected)


# ---- A-GEM -------------------------------------------------------------------------------------------------


def _vector(gradients: dict[str, Tensor]) -> NDArray[np.float64]:
    return np.concatenate([value.double().numpy().ravel() for value in gradients.values()])


def test_a_gem_projects_the_gradient_off_directions_that_raise_the_prior_loss() -> None:
    policy, method = TransformerPolicy(SMALL), build_method("a_gem", {})
    # at flow time 1 the head reads the noise alone; its prediction there is too low for one, too high for
    # the other
    batch = dataclasses.replace(toy_source("right").sample(16), draw=torch.ones(16))
    with torch.no_grad():
        predicted = batch.noise - policy.predict(batch)
    target = dataclasses.replace(batch, action=predicted + 0.5 + 0.5 * batch.noise)
    prior = dataclasses.replace(batch, action=predicted - 0.5)
    found = _vector(_set_by(method, policy, (target, prior)))
    gradient = _vector(_gradients(policy, policy.action_loss(target).mean()))
    against = _vector(_gradients(policy, policy.action_loss(prior).mean()))
    product = float(gradient @ against)
    assert product < 0
    expected = gradient - product / float(against @ against) * against
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)
    assert abs(float(found @ against)) < 1e-4 * abs(product)
    assert np.linalg.norm(found - gradient) > 1e-3 * np.linalg.norm(gradient)


def test_a_gem_leaves_every_bit_of_a_gradient_that_does_not_raise_the_prior_loss() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right").sample(16)
    found = _set_by(build_method("a_gem", {}), policy, (batch, batch))
    plain = _set_by(build_method("sft", {}), policy, batch)
    assert all(value.equal(plain[name]) for name, value in found.items())


def test_a_gem_draws_a_full_batch_of_the_target_and_one_of_prior_demonstrations() -> None:
    target, prior = build_method("a_gem", {}).batch(toy_source("right"), _prior())
    assert (len(target), len(prior)) == (16, 16)
    assert target.state.equal(toy_source("right").sample(16).state)
    assert prior.state.equal(toy_source("left").sample(16).state)


# ---- weight interpolation ----------------------------------------------------------------------------------


@pytest.mark.parametrize("coefficient", [0.0, 0.25, 0.5, 1.0])
def test_weight_interpolation_goes_its_share_of_the_way(coefficient: float) -> None:
    method = build_method("weight_interpolation", {"coefficient": coefficient})
    policy, plain = TransformerPolicy(SMALL), TransformerPolicy(SMALL)
    before = weights_of(policy)
    _adapt(policy, method)
    _adapt(plain, build_method("sft", {}))
    after = weights_of(plain)
    assert not after["head.embed.weight"].equal(before["head.embed.weight"])
    for name, weight in weights_of(policy).items():
        expected = (1 - coefficient) * before[name].double() + coefficient * after[name].double()
        tolerance = 0.0 if coefficient in (0.0, 1.0) else 1e-7
        torch.testing.assert_close(weight.double(), expected, rtol=0, atol=tolerance)
    assert method.whole_stages


def test_weight_interpolation_goes_back_to_where_the_stage_began() -> None:
    policy, method = TransformerPolicy(SMALL), build_method("weight_interpolation", {"coefficient": 0.0})
    _adapt(policy, build_method("sft", {}))
    before = weights_of(policy)
    _adapt(policy, method)
    assert all(weight.equal(before[name]) for name, weight in policy.named_parameters())


# ---- learning rates ----------------------------------------------------------------------------------------


def test_the_learning_rates_of_finch_follow_the_average_of_the_losses() -> None:
    method, policy, source = (
        build_method("finch", {"kappa": 0.9}),
        TransformerPolicy(SMALL),
        toy_source("right"),
    )
    method.start_task(policy, _stage())
    average, found, expected = 0.0, [], []
    for step in range(20):
        batch = source.sample(2)
        loss = method.loss(policy, batch, Progress(step, 20))
        assert loss.item() == policy.action_loss(batch).mean().item()
        found.append(method.learning_rate(0.01, Progress(step, 20)))
        average = 0.9 * average + 0.1 * loss.item() if step else loss.item()
        expected.append(0.01 * min(1.0, 0.9 / math.sqrt(average + 1e-8)))
    assert found == pytest.approx(expected, rel=1e-6)
    assert len({round(rate, 6) for rate in found}) > 5


def test_finch_never_exceeds_the_schedule_and_reaches_it_where_the_loss_is_low() -> None:
    policy, batch = TransformerPolicy(SMALL), toy_source("right").sample(16)
    rates = []
    for kappa in (1e-3, 1e-2, 1e3):
        method = build_method("finch", {"kappa": kappa})
        method.start_task(policy, _stage())
        method.loss(policy, batch, NOW)
        rates.append(method.learning_rate(0.01, NOW))
    assert rates[0] < rates[1] < rates[2] == 0.01


def test_finch_forgets_the_losses_of_the_last_target() -> None:
    method, policy, rates = build_method("finch", {}), TransformerPolicy(SMALL), []
    for batches in (0, 3):
        method.start_task(policy, _stage())
        for seed in range(batches):
            method.loss(policy, toy_source("up", seed=seed).sample(2), NOW)
        method.start_task(policy, _stage())
        method.loss(policy, toy_source("right").sample(16), NOW)
        rates.append(method.learning_rate(0.01, NOW))
    assert rates[0] == rates[1]


@pytest.mark.parametrize("factor", [0.2, 0.5])
def test_the_step_factor_moves_every_weight_by_its_share_of_a_step(factor: float) -> None:
    start = weights_of(TransformerPolicy(SMALL))
    moves = []
    for changes in ({}, {"step_factor": factor}):
        policy = TransformerPolicy(SMALL)
        _adapt(policy, build_method("sft", changes), steps=1)
        moves.append({name: weight - start[name] for name, weight in weights_of(policy).items()})
    plain, slow = moves
    # the first step of Adam is the learning rate, up or down
    assert plain["head.embed.weight"].abs().max() == pytest.approx(1e-3, rel=1e-3)
    for name, move in plain.items():
        torch.testing.assert_close(slow[name], factor * move, rtol=0, atol=1e-6)


# ---- sources of the backbone's gradient --------------------------------------------------------------------


def test_stop_gradient_keeps_the_backbone_and_its_answers_to_the_last_bit() -> None:
    policy, questions = TransformerPolicy(SMALL), toy_questions(3).sample(32)
    before = weights_of(policy)
    answers = policy.answer_logits(questions.state, questions.words)
    _adapt(policy, build_method("stop_gradient", {}), steps=10)
    moved = {name for name, weight in policy.named_parameters() if not weight.equal(before[name])}
    assert moved == {name for name in before if name.startswith("head.")}
    assert policy.answer_logits(questions.state, questions.words).equal(answers)


def test_stop_gradient_gives_the_optimiser_the_head_alone() -> None:
    policy = TransformerPolicy(SMALL)
    given: Any = build_method("stop_gradient", {}).start_task(policy, _stage())
    assert {id(weight) for weight in given} == {id(weight) for weight in policy.head.parameters()}


def test_the_head_of_stop_gradient_learns_from_the_plain_action_loss() -> None:
    policy, batch, method = (
        TransformerPolicy(SMALL),
        toy_source("right").sample(16),
        build_method("stop_gradient", {}),
    )
    plain = policy.action_loss(batch).mean()
    assert method.loss(policy, batch, NOW).item() == pytest.approx(plain.item(), rel=1e-6)
    gradients = _gradients(policy, plain)
    found = _set_by(method, policy, batch)
    head = [name for name in gradients if name.startswith("head.")]
    _check_close({name: found[name] for name in head}, {name: gradients[name] for name in head})
    assert not any(value.any() for name, value in found.items() if name not in head)


def test_knowledge_insulation_trains_the_backbone_on_questions_and_the_head_on_actions() -> None:
    policy, method = TransformerPolicy(SMALL), build_method("knowledge_insulation", {"alpha": 0.5})
    batch, questions = toy_source("right").sample(16), toy_questions().sample(8)
    acting = _gradients(policy, 0.5 * policy.action_loss(batch).mean())
    answering = _gradients(policy, policy.answer_loss(questions).mean())
    found = _set_by(method, policy, (batch, questions))
    expected = {
        name: acting[name] if name.startswith("head.") else value for name, value in answering.items()
    }
    _check_close(found, expected)
    assert acting["backbone.readout"].any()  # insulation stops this gradient
    loss = method.loss(policy, (batch, questions), NOW).item()
    assert loss == pytest.approx(
        0.5 * policy.action_loss(batch).mean().item() + policy.answer_loss(questions).mean().item(), rel=1e-5
    )


def test_co_training_descends_the_sum_of_both_losses() -> None:
    policy, method = TransformerPolicy(SMALL), build_method("co_training", {"auxiliary": 0.3})
    batch, questions = toy_source("right").sample(16), toy_questions().sample(8)
    loss = policy.action_loss(batch).mean() + 0.3 * policy.answer_loss(questions).mean()
    assert method.loss(policy, (batch, questions), NOW).item() == pytest.approx(loss.item(), rel=1e-6)
    _check_close(_set_by(method, policy, (batch, questions)), _gradients(policy, loss))


@pytest.mark.parametrize("progress", [Progress(0, 1000), Progress(999, 1000), Progress(40, 50, True)])
def test_co_training_weighs_both_losses_the_same_at_every_step(progress: Progress) -> None:
    policy, method = TransformerPolicy(SMALL), build_method("co_training", {"auxiliary": 0.3})
    batch, questions = toy_source("right").sample(8), toy_questions().sample(8)
    expected = policy.action_loss(batch).mean() + 0.3 * policy.answer_loss(questions).mean()
    assert method.loss(policy, (batch, questions), progress).item() == pytest.approx(expected.item())


@pytest.mark.parametrize("spec", ["co_training", "knowledge_insulation"])
def test_half_as_many_questions_as_demonstrations_are_asked(spec: str) -> None:
    batch, questions = build_method(spec, {}).batch(toy_source("right"), _prior())
    assert (len(batch), len(questions)) == (16, 8)
    assert batch.state.equal(toy_source("right").sample(16).state)
    assert questions.answer.equal(toy_questions().sample(8).answer)


# ---- adaptation --------------------------------------------------------------------------------------------


def test_gradients_of_weights_that_are_not_trained_do_not_add_up_over_a_stage() -> None:
    found: list[Tensor] = []

    @dataclasses.dataclass
    class HeadOnly(Method):
        def start_task(self, policy: Policy, stage: Stage) -> Any:
            return [parameter for name, parameter in policy.named_parameters() if name.startswith("head.")]

        def batch(self, target: Any, prior: Prior) -> Batch:
            return batch

        def gradients(self, policy: Policy, loss: Tensor) -> None:
            super().gradients(policy, loss)
            gradient = next(policy.get_submodule("backbone").parameters()).grad
            assert gradient is not None
            found.append(gradient.clone())

        def learning_rate(self, scheduled: float, progress: Progress) -> float:
            return 0.0

    batch = toy_source("right").sample(8)
    _adapt(TransformerPolicy(SMALL), HeadOnly(), steps=3)
    assert len(found) == 3
    assert found[0].abs().max() > 0
    assert found[0].equal(found[1])
    assert found[1].equal(found[2])
