"""Optimisation: the only module that steps an optimiser."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.optim.optimizer import register_optimizer_step_post_hook

from clbench.base.errors import ClbenchError, InputError

GRADIENT_NORM = 1.0
"""Maximum norm of the gradients; they are clipped after the method has set them."""

BETAS = (0.9, 0.95)
"""Betas of AdamW, as in ConSFT (arXiv 2605.08879) and openpi; notes on AEGIS and CapVector name none."""

WEIGHT_DECAY = 1e-10
"""Weight decay of AdamW, from the same two sources."""


class MethodError(ClbenchError, RuntimeError):
    """A method did something after which the loop cannot continue."""


class GradientError(MethodError):
    """A gradient is not finite."""


WARM_UP = 15
"""Steps of linear warm-up before a constant learning rate."""

Schedule = Callable[[int], float]
"""Maps the number of steps done to the learning rate, as a share of its peak."""


def warm_up(step: int) -> float:
    """Return the learning rate at `step` as a share of its peak: linear over `WARM_UP` steps, then constant.

    A stage that ends early has then taken the same steps as one that goes on.
    """
    return min(1.0, (step + 1) / WARM_UP)


def learning_rate_factor(step: int, steps: int) -> float:
    """Return the learning rate at `step` as a share of its peak: 5 % warm-up, then a cosine toward 0.1."""
    rising = max(1, round(0.05 * steps))
    if step < rising:
        return (step + 1) / rising
    fraction = (step - rising) / max(1, steps - rising)
    return 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * fraction))


@contextmanager
def deterministic(device: str = "cpu") -> Iterator[None]:
    """Use one thread and deterministic kernels in the block, so that a computation repeats bit for bit.

    The block also undoes what a program may have set for itself: gradients are on, nothing is cast
    automatically, all kernels of attention are allowed, and matrices of float32 are multiplied in float32
    rather than in TF32 or bfloat16.

    Raises:
        InputError: PyTorch's default dtype is not float32, or its default device is not the CPU.
    """
    _check_defaults()
    if device != "cpu":
        # with another workspace cuBLAS may choose another kernel each time
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    threads, algorithms = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        with _usual_modes(torch.device(device).type), _full_precision():
            yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(algorithms, warn_only=warn_only)


def _check_defaults() -> None:
    """Refuse defaults with which the cached policies and evaluations, which serve all later runs, differ."""
    dtype, device = torch.get_default_dtype(), torch.get_default_device()
    if dtype != torch.float32:
        raise InputError(
            f"PyTorch's default dtype is {dtype}, and clbench computes in torch.float32: call "
            "torch.set_default_dtype(torch.float32) first."
        )
    if device.type != "cpu":
        raise InputError(
            f"PyTorch's default device is {device}, and clbench places its tensors itself: call "
            'torch.set_default_device("cpu") first. `device` of a run says where its policy computes.'
        )


@contextmanager
def _usual_modes(kind: str) -> Iterator[None]:
    """Undo the modes of PyTorch that change results: inference, gradients off, autocast, fewer kernels."""
    kernels = set(SDPBackend.__members__.values()) - {SDPBackend.ERROR}
    with ExitStack() as modes:
        modes.enter_context(torch.inference_mode(False))
        modes.enter_context(torch.enable_grad())
        for one in {"cpu", kind}:
            modes.enter_context(torch.autocast(one, enabled=False))
        modes.enter_context(sdpa_kernel([*kernels]))
        yield


@contextmanager
def _full_precision() -> Iterator[None]:
    products = (torch.backends.cuda.matmul, torch.backends.mkldnn.matmul)  # type: ignore[attr-defined]
    precisions = [product.fp32_precision for product in products]
    overall = None
    with suppress(RuntimeError):  # cannot be read once a program has set one of the two
        overall = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        if overall is not None:
            torch.set_float32_matmul_precision(overall)
        for product, precision in zip(products, precisions, strict=True):
            product.fp32_precision = precision


@contextmanager
def steps_counted() -> Iterator[Callable[[], int]]:
    """Count the steps of all optimisers of PyTorch; yield a function that returns their number so far."""
    taken = 0

    def add(*_: Any) -> None:
        nonlocal taken
        taken += 1

    handle = register_optimizer_step_post_hook(add)
    try:
        yield lambda: taken
    finally:
        handle.remove()


def optimise(
    parameters: Iterable[nn.Parameter] | list[dict[str, Any]],
    learning_rate: float,
    steps: int,
    loss_at: Callable[[int], Tensor],
    gradients: Callable[[Tensor], None] = Tensor.backward,
    after: Callable[[int], bool | None] = lambda _: None,
    rate: Callable[[float, int], float] = lambda scheduled, _: scheduled,
    schedule: Schedule | None = None,
) -> int:
    """Minimise a loss with AdamW and return the number of steps done, 0 if there are no parameters.

    Args:
        parameters: Parameters to train, or optimiser groups of them.
        learning_rate: Peak learning rate, for groups without their own.
        steps: Maximum number of steps.
        loss_at: Returns the scalar loss of a step.
        gradients: Sets the gradients from the loss.
        after: Called after each step with the number of steps done. Training ends if it returns True.
        rate: Maps the scheduled learning rate of a group, and the number of steps done, to the actual one.
        schedule: Schedule of the learning rate; `learning_rate_factor` if None.

    Raises:
        GradientError: A gradient is not finite.
        MethodError: The loss is not a finite scalar with a gradient, no parameter in training has a gradient,
            or a learning rate is not a finite float of at least 0.
    """
    groups: list[Any] = list(parameters)
    if not groups:
        for step in range(steps):
            if after(step + 1):
                break
        return 0
    factor = schedule or (lambda step: learning_rate_factor(step, steps))
    optimiser = torch.optim.AdamW(
        groups, lr=learning_rate, betas=BETAS, weight_decay=WEIGHT_DECAY, fused=True
    )
    peaks = [group["lr"] for group in optimiser.param_groups]
    trained = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for step in range(steps):
        loss = loss_at(step)
        _check_loss(loss, step)
        optimiser.zero_grad()
        gradients(loss)
        if all(parameter.grad is None for parameter in trained):
            raise MethodError(
                f"step {step}: no parameter in training has a gradient: gradients() sets none, or the loss "
                "depends on other parameters."
            )
        _clip(trained, step)
        for group, peak in zip(optimiser.param_groups, peaks, strict=True):
            group["lr"] = _checked_rate(rate(peak * factor(step), step), step)
        optimiser.step()
        if after(step + 1):
            return step + 1
    return steps


def _checked_rate(rate: float, step: int) -> float:
    if not (isinstance(rate, float) and 0.0 <= rate < math.inf):
        raise MethodError(
            f"step {step}: the learning rate must be a finite float of at least 0, not {rate!r}."
        )
    return rate


def _clip(trained: list[nn.Parameter], step: int) -> None:
    try:
        nn.utils.clip_grad_norm_(trained, GRADIENT_NORM, error_if_nonfinite=True)
    except RuntimeError as error:
        if type(error) is not RuntimeError:  # the GPU, or its memory: this line is the first to wait for it
            raise
        raise GradientError(f"step {step}: a gradient is not finite.") from error


def _check_loss(loss: Any, step: int) -> None:
    if not isinstance(loss, Tensor):
        raise MethodError(f"step {step}: loss must be a tensor, not {type(loss).__name__}.")
    if loss.shape != ():
        raise MethodError(
            f"step {step}: loss must be a scalar, shape (), not {tuple(loss.shape)}; take its mean."
        )
    if not torch.isfinite(loss):
        raise MethodError(f"step {step}: loss is {loss.item()}, not finite.")
    if not loss.requires_grad:
        raise MethodError(f"step {step}: loss has no gradient; was it detached?")
