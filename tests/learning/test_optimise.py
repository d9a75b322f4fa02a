import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from clbench.base.errors import InputError
from clbench.learning.optimise import (
    MethodError,
    deterministic,
    learning_rate_factor,
    optimise,
    steps_counted,
    warm_up,
)


def test_the_learning_rate_warms_up_and_then_follows_a_cosine_down_to_a_tenth() -> None:
    factors = [learning_rate_factor(step, 400) for step in range(400)]
    assert factors[:20] == pytest.approx(np.arange(1, 21) / 20)
    assert max(factors) == 1.0
    # by hand at three quarters of the way down
    assert factors[20 + 285] == pytest.approx(0.1 + 0.45 * (1 + math.cos(0.75 * math.pi)))
    assert factors[-1] == pytest.approx(0.1, abs=1e-3)


def test_the_first_step_of_adamw_moves_every_weight_by_the_learning_rate() -> None:
    weight = nn.Parameter(torch.tensor([1.0, -2.0]))
    steps = optimise([weight], 0.1, 1, lambda _: (weight * torch.tensor([3.0, -0.5])).sum(), Tensor.backward)
    assert steps == 1
    # Adam's first step is the sign of the gradient; one step is all warm-up, so the factor is 1
    assert weight.tolist() == pytest.approx([0.9, -1.9])


def test_steps_are_those_of_adamw_by_its_equations_under_one_norm_for_all_groups() -> None:
    """Loshchilov, Hutter 2019, Algorithm 2, with betas .9 and .95 and a weight decay of 1e-10."""
    start = np.array([1.0, -2.0, 3.0, 0.5])
    weights = [
        nn.Parameter(torch.tensor(start[part], dtype=torch.float64)) for part in (slice(2), slice(2, 4))
    ]
    steps = 12

    def loss_at(step: int) -> Tensor:
        return ((step + 1) * torch.cat([*weights]).square() + torch.cat([*weights])).sum()

    optimise([{"params": [one]} for one in weights], 0.1, steps, loss_at)
    value, mean, square = start, np.zeros(4), np.zeros(4)
    for step in range(steps):
        gradient = 2 * (step + 1) * value + 1
        gradient = gradient / max(1.0, float(np.linalg.norm(gradient)))
        rate = 0.1 * (0.1 + 0.45 * (1 + math.cos(math.pi * max(0, step - 1) / (steps - 1))))
        mean, square = 0.9 * mean + 0.1 * gradient, 0.95 * square + 0.05 * gradient**2
        move = (mean / (1 - 0.9 ** (step + 1))) / (np.sqrt(square / (1 - 0.95 ** (step + 1))) + 1e-8)
        value = value * (1 - rate * 1e-10) - rate * move
    np.testing.assert_allclose(torch.cat([*weights]).detach(), value, rtol=1e-5)


def test_stages_to_a_criterion_warm_up_in_fifteen_steps_and_then_keep_their_rate() -> None:
    assert [warm_up(step) for step in range(20)] == pytest.approx([*np.arange(1, 16) / 15, *[1.0] * 5])


def test_memory_that_runs_out_while_gradients_are_clipped_is_no_gradient_that_is_not_finite(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def run_out(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("the GPU is full")

    monkeypatch.setattr(nn.utils, "clip_grad_norm_", run_out)
    weight = nn.Parameter(torch.zeros(4))
    with pytest.raises(torch.OutOfMemoryError, match="the GPU is full"):
        optimise([weight], 0.1, 1, lambda _: weight.sum())


def test_gradients_are_clipped_after_the_method_has_set_them() -> None:
    weight = nn.Parameter(torch.zeros(4))
    seen: list[float] = []

    def after(_: int) -> None:
        assert weight.grad is not None
        seen.append(float(weight.grad.norm()))

    def gradients(loss: Tensor) -> None:
        loss.backward()  # type: ignore[no-untyped-call]
        assert weight.grad is not None
        weight.grad.mul_(1000)

    optimise([weight], 0.1, 1, lambda _: (weight + 1).square().sum(), gradients, after)
    assert seen == pytest.approx([1.0])


def test_a_group_may_have_its_own_learning_rate() -> None:
    slow, fast = nn.Parameter(torch.zeros(1)), nn.Parameter(torch.zeros(1))
    groups: list[dict[str, Any]] = [{"params": [slow], "lr": 0.01}, {"params": [fast]}]
    optimise(groups, 0.1, 1, lambda _: (slow + fast - 1).square().sum(), Tensor.backward)
    assert slow.item() == pytest.approx(0.01)
    assert fast.item() == pytest.approx(0.1)


def test_without_parameters_no_step_is_done_but_the_callback_is_called_for_each() -> None:
    seen: list[int] = []
    assert optimise([], 0.1, 3, lambda _: torch.tensor(float("nan")), Tensor.backward, seen.append) == 0
    assert seen == [1, 2, 3]


@pytest.mark.parametrize("trains", [True, False])
def test_training_ends_after_the_step_whose_callback_says_so(trains: bool) -> None:
    weight = nn.Parameter(torch.ones(2))
    seen: list[int] = []

    def after(step: int) -> bool:
        seen.append(step)
        return step == 2

    steps = optimise([weight] if trains else [], 0.1, 5, lambda _: weight.square().sum(), after=after)
    assert (steps, seen) == (2 if trains else 0, [1, 2])


def test_a_weight_that_the_loss_does_not_reach_stays_as_it_is() -> None:
    reached, other = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
    assert optimise([reached, other], 0.1, 2, lambda _: reached.square().sum()) == 2
    assert other.tolist() == [1.0, 1.0]
    assert reached.max() < 1.0


def test_steps_are_counted_until_the_block_ends() -> None:
    weight = nn.Parameter(torch.ones(2))
    with steps_counted() as taken:
        optimise([weight], 0.1, 3, lambda _: weight.square().sum())
        assert taken() == 3
    optimise([weight], 0.1, 2, lambda _: weight.square().sum())
    assert taken() == 3


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda weight: weight.sum() * float("nan"), "step 0: loss is nan, not finite"),
        (lambda weight: weight.sum() * float("inf") + 1, "step 0: loss is (inf|nan), not finite"),
        (lambda weight: weight * 2, r"step 0: loss must be a scalar, shape \(\), not \(2,\)"),
        (lambda weight: 0.5, "step 0: loss must be a tensor, not float"),
        (lambda weight: weight.sum().detach(), "step 0: loss has no gradient"),
    ],
)
def test_a_loss_that_cannot_be_minimised_stops_with_the_step_in_the_error(loss: object, message: str) -> None:
    weight = nn.Parameter(torch.ones(2))
    with pytest.raises(MethodError, match=message):
        optimise([weight], 0.1, 1, lambda _: loss(weight), Tensor.backward)  # type: ignore[operator]
    assert weight.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("gradients", [lambda loss: None, Tensor.backward])
def test_a_step_that_sets_no_gradient_of_the_trained_parameters_is_refused(gradients: object) -> None:
    trained, other = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
    with pytest.raises(MethodError, match="step 0: no parameter in training has a gradient"):
        optimise([trained], 0.1, 1, lambda _: other.sum(), gradients)  # type: ignore[arg-type]
    assert trained.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("warn_only", [False, True])
def test_the_deterministic_block_restores_what_was_set(warn_only: bool) -> None:
    def state() -> tuple[int, bool, bool]:
        warns = torch.is_deterministic_algorithms_warn_only_enabled()
        return torch.get_num_threads(), torch.are_deterministic_algorithms_enabled(), warns

    torch.use_deterministic_algorithms(warn_only, warn_only=warn_only)
    try:
        before = state()
        with deterministic():
            assert state() == (1, True, False)
        assert state() == before
    finally:
        torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("place", [torch, torch.backends.cuda.matmul], ids=["everywhere", "on cuda"])
def test_the_deterministic_block_multiplies_in_float32_although_the_program_allows_less(place: Any) -> None:
    matmul = torch.backends.cuda.matmul
    before = matmul.fp32_precision
    try:
        if place is torch:
            torch.set_float32_matmul_precision("high")
        else:
            matmul.fp32_precision = "tf32"
        with deterministic():
            assert (torch.get_float32_matmul_precision(), matmul.fp32_precision) == ("highest", "ieee")
        assert matmul.fp32_precision == "tf32"
        assert place is not torch or torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision("highest")
        matmul.fp32_precision = before
    assert torch.get_float32_matmul_precision() == "highest"


@contextmanager
def _without_flash_attention() -> Iterator[None]:
    torch.backends.cuda.enable_flash_sdp(False)
    try:
        yield
    finally:
        assert not torch.backends.cuda.flash_sdp_enabled()  # type: ignore[no-untyped-call]
        torch.backends.cuda.enable_flash_sdp(True)


@pytest.mark.parametrize(
    "mode",
    [partial(torch.autocast, "cpu", dtype=torch.bfloat16), _without_flash_attention, torch.inference_mode],
    ids=["autocast", "other attention", "inference"],
)
def test_modes_of_the_program_do_not_change_what_the_deterministic_block_computes(mode: Any) -> None:
    def gradient() -> Tensor:
        weight = torch.linspace(-1, 1, 4 * 16).reshape(1, 1, 4, 16).requires_grad_()
        attended = nn.functional.scaled_dot_product_attention(weight, weight @ weight.mT @ weight, weight)
        return torch.autograd.grad(attended.square().sum(), weight)[0]

    with deterministic():
        expected = gradient()
    with mode(), deterministic():
        found = gradient()
    assert found.dtype == torch.float32
    assert not found.is_inference()
    assert torch.equal(found, expected)


def test_a_default_device_other_than_the_cpu_is_refused() -> None:
    torch.set_default_device("meta")
    try:
        with pytest.raises(InputError, match=r"default device is meta.*set_default_device"), deterministic():
            pass
    finally:
        torch.set_default_device(None)


def test_the_deterministic_block_has_gradients_although_the_program_turned_them_off() -> None:
    with torch.no_grad():
        with deterministic():
            assert torch.is_grad_enabled()
        assert not torch.is_grad_enabled()


def test_the_learning_rate_can_change_at_every_step_once_the_gradient_is_known() -> None:
    weight = nn.Parameter(torch.zeros(1))
    seen: list[tuple[float, int, bool]] = []

    def rate(scheduled: float, step: int) -> float:
        seen.append((scheduled, step, weight.grad is not None))
        return 0.5 * scheduled

    optimise([weight], 0.1, 2, lambda _: (weight - 1).square().sum(), rate=rate)
    assert seen == [(0.1, 0, True), (pytest.approx(0.1), 1, True)]
    assert weight.item() == pytest.approx(0.1, rel=1e-2)  # two Adam steps of half of 0.1


def test_a_learning_rate_of_0_is_a_step_that_changes_nothing() -> None:
    weight = nn.Parameter(torch.zeros(1))
    assert optimise([weight], 0.1, 1, lambda _: (weight - 1).square().sum(), rate=lambda *_: 0.0) == 1
    assert weight.item() == 0.0


@pytest.mark.parametrize("rate", [-0.1, float("nan"), float("inf"), "0.1"])
def test_an_invalid_learning_rate_is_refused(rate: Any) -> None:
    weight = nn.Parameter(torch.zeros(1))
    with pytest.raises(
        MethodError, match="step 0: the learning rate must be a finite float of at least 0, not"
    ):
        optimise([weight], 0.1, 1, lambda _: (weight - 1).square().sum(), rate=lambda *_: rate)
