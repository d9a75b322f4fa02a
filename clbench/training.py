"""Training: pretraining and adaptation, the only place that steps an optimiser."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from clbench.cache import cache_folder, cached, hash_of, is_cached, package_of, source_hash
from clbench.demonstrations import SIMULATORS, Demonstrations, load_demonstrations
from clbench.method import Method, Progress, Stage
from clbench.policy import Policy, PolicyConfig, load_policy, save_policy
from clbench.questions import load_questions
from clbench.seeding import derive_seed, torch_generator
from clbench.task import Budget, Scenario, resolve

GRADIENT_NORM = 1.0
"""Gradients are clipped at this norm, after the method has set them."""

BETAS = (0.9, 0.95)
"""Of AdamW, as the three seed papers and openpi have them; weight decay 1e-10 likewise."""


AFTER_PRETRAINING = (
    "adaptation_steps",
    "learning_rate",
    "evaluation_points",
    "selection_episodes",
    "report_episodes",
    "report_questions",
)
"""Fields of the budget that a pretrained policy does not depend on."""


class MethodError(RuntimeError):
    """A method did something that the loop cannot go on with."""


def learning_rate_factor(step: int, steps: int) -> float:
    """Return the share of the peak step size at `step`: 5 % linear warm-up, then a cosine down to a tenth."""
    warm_up = max(1, round(0.05 * steps))
    if step < warm_up:
        return (step + 1) / warm_up
    fraction = (step - warm_up) / max(1, steps - warm_up)
    return 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * fraction))


@contextmanager
def deterministic() -> Iterator[None]:
    """One thread and deterministic kernels, so that a computation repeats itself bit for bit."""
    threads, algorithms = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(algorithms)


def optimise(
    parameters: Iterable[nn.Parameter] | list[dict[str, Any]],
    learning_rate: float,
    steps: int,
    loss_at: Callable[[int], Tensor],
    gradients: Callable[[Tensor], None],
    after: Callable[[int], None] = lambda _: None,
) -> int:
    """Descend a loss with AdamW and return the number of steps done; without parameters none is.

    Args:
        parameters: What is trained, or optimiser groups of it.
        learning_rate: Peak step size, for groups that have none of their own.
        steps: How often.
        loss_at: Returns the scalar loss of a step.
        gradients: Sets the gradients from the loss.
        after: Called after each step with the number of steps done.

    Raises:
        MethodError: The loss is not a finite scalar with a gradient.
    """
    groups: list[Any] = list(parameters)
    if not groups:
        for step in range(steps):
            after(step + 1)
        return 0
    optimiser = torch.optim.AdamW(groups, lr=learning_rate, betas=BETAS, weight_decay=1e-10, fused=True)
    peaks = [group["lr"] for group in optimiser.param_groups]
    trained = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for step in range(steps):
        for group, peak in zip(optimiser.param_groups, peaks, strict=True):
            group["lr"] = peak * learning_rate_factor(step, steps)
        loss = loss_at(step)
        _check_loss(loss, step)
        optimiser.zero_grad()
        gradients(loss)
        _clip(trained, step)
        optimiser.step()
        after(step + 1)
    return steps


def _clip(trained: list[nn.Parameter], step: int) -> None:
    try:
        nn.utils.clip_grad_norm_(trained, GRADIENT_NORM, error_if_nonfinite=True)
    except RuntimeError as error:
        raise MethodError(f"step {step}: a gradient is not finite.") from error


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


def pretraining_inputs(scenario: Scenario, seed: int) -> dict[str, Any]:
    """Return all that a pretrained policy depends on."""
    suites = {package_of(name) for task in scenario.retained for name in (task.world, task.expert)}
    suites.add(package_of(scenario.questions))
    budget = dataclasses.asdict(scenario.budget)
    core = ("clbench.policy", "clbench.demonstrations", "clbench.questions", "clbench.seeding", __name__)
    return {
        "retained": [dataclasses.asdict(task) for task in scenario.retained],
        "budget": {name: value for name, value in budget.items() if name not in AFTER_PRETRAINING},
        "seed": seed,
        "source": source_hash(*core, *sorted(suites)),
        "versions": {package: version(package) for package in (*SIMULATORS, "torch", "tokenizers")},
    }


def pretrained_folder(scenario: Scenario, seed: int) -> Path:
    """Return where the pretrained policy lies, or will lie."""
    name = f"{scenario.id.replace('/', '--')}-seed-{seed}-{hash_of(pretraining_inputs(scenario, seed))}"
    return cache_folder() / "pretrained" / name


def is_pretrained(scenario: Scenario, seed: int) -> bool:
    """Return whether the pretrained policy is in the cache."""
    return is_cached(pretrained_folder(scenario, seed), pretraining_inputs(scenario, seed))


def pretrained_policy(
    scenario: Scenario, seed: int, progress: Callable[[float], None] = lambda _: None
) -> tuple[Policy, Path]:
    """Return the policy pretrained on the retained tasks and the questions, and the folder it lies in.

    It is trained on first use, and shared by all methods.

    Args:
        scenario: What to learn.
        seed: Of the weights and of every draw.
        progress: Called with the number of steps done since its last call.
    """
    inputs = pretraining_inputs(scenario, seed)
    folder = cached(
        pretrained_folder(scenario, seed),
        inputs,
        lambda partial: save_policy(_pretrain(scenario, seed, progress), partial),
    )
    return load_policy(folder), folder


def policy_config(scenario: Scenario) -> PolicyConfig:
    """Return the sizes of a policy for the scenario's worlds."""
    world = resolve(scenario.retained[0].world)()
    config = PolicyConfig(
        state_size=world.observation_space.shape[0],
        action_size=world.action_space.shape[0],
        width=scenario.budget.policy_width,
        layers=scenario.budget.policy_layers,
    )
    world.close()
    return config


def _pretrain(scenario: Scenario, seed: int, progress: Callable[[float], None]) -> Policy:
    config, budget = policy_config(scenario), scenario.budget
    demonstrations = Demonstrations.cat(
        [load_demonstrations(task, scenario, config) for task in scenario.retained]
    )
    questions, _ = load_questions(scenario)
    policy = Policy(config, seed=derive_seed("weights", seed))
    policy.normalise_like(demonstrations.state, demonstrations.action[:, 0])
    generator = torch_generator("pretraining", seed)

    def loss_at(step: int) -> Tensor:
        batch = demonstrations.sample(budget.batch_size, generator)
        asked = questions.sample(budget.batch_size // 2, generator)
        return policy.action_loss(batch).mean() + policy.answer_loss(asked).mean()

    with deterministic():
        optimise(
            policy.parameters(),
            budget.pretraining_learning_rate,
            budget.pretraining_steps,
            loss_at,
            Tensor.backward,
            lambda _: progress(1),
        )
    return policy


def adapt(
    policy: Policy,
    method: Method,
    stage: Stage,
    budget: Budget,
    after: Callable[[int], None] = lambda _: None,
) -> int:
    """Let `method` fine-tune the policy on one target, in place, and return the optimiser steps done.

    Args:
        policy: What is trained.
        method: How.
        stage: Which target, with the data that the method may touch.
        budget: Step size.
        after: Called after each step with the number of steps done.
    """
    parameters = method.start_task(policy, stage)

    def loss_at(step: int) -> Tensor:
        batch = method.batch(stage.target, stage.prior)
        return method.loss(policy, batch, Progress(step, stage.steps))

    steps = optimise(
        parameters,
        budget.learning_rate,
        stage.steps,
        loss_at,
        lambda loss: method.gradients(policy, loss),
        after,
    )
    method.end_task(policy, stage)
    for name, parameter in policy.named_parameters():
        if not torch.isfinite(parameter).all():
            raise MethodError(f"The parameter {name} is not finite after {stage.task.name!r}.")
    return steps


def evaluation_steps(budget: Budget) -> list[int]:
    """Return after how many optimiser steps of a stage the target is evaluated; the last is its end."""
    points = min(budget.evaluation_points, budget.adaptation_steps)
    return [round((point + 1) * budget.adaptation_steps / points) for point in range(points)]
