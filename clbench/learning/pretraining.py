"""Pretraining: makes the policy that every method starts from, once per seed, and keeps it in the cache."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from clbench.base.cache import cache_folder, cached, fault_of, hash_of, hash_of_tensors, is_cached
from clbench.base.dependencies import versions
from clbench.base.entry_points import resolve
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import derive_seed, torch_generator
from clbench.base.source import TRAINING_SOURCES, package_of, source_hash
from clbench.data.demonstrations import Demonstrations, load_demonstrations, simulator_versions
from clbench.data.questions import Questions, load_questions
from clbench.learning.optimise import deterministic, optimise
from clbench.learning.vision_pretraining import STEPS_SHARE, pictures_of, pretrain_vision
from clbench.policy.checkpoint import load_policy, save_policy
from clbench.policy.kinds import new_policy, policy_class
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.vision import Vision
from clbench.spec.identifiers import folder_name
from clbench.spec.policies import DEFAULT_POLICY, kind_of, policy_packages, size_of
from clbench.spec.scenario import Scenario
from clbench.spec.task import packages_of
from clbench.worlds.camera import load_camera
from clbench.worlds.observation import Observer, frame_hash

LOG = logging.getLogger("clbench")

SHIPPED = Path(__file__).parents[1] / "pretrained"
"""Folder of the policies that ship with the package."""

AFTER_PRETRAINING = (
    "adaptation_steps",
    "criterion",
    "learning_rate",
    "evaluation_points",
    "validation_episodes",
    "test_episodes",
    "curve_episodes",
    "test_questions",
)
"""Fields of the budget that do not affect a pretrained policy."""


def pretraining_inputs(scenario: Scenario, seed: int) -> dict[str, Any]:
    """Return everything that a pretrained policy depends on; weights that it brings replace its seed."""
    tasks = scenario.pretrained + scenario.scenes
    suites = {
        *packages_of(tasks, "world", "expert", "camera"),
        package_of(scenario.questions),
        *policy_packages(scenario.policy),
    }
    budget = dataclasses.asdict(scenario.budget)
    own = _own_weights(scenario, seed)
    installed = {**simulator_versions(tasks), **versions(("torch", "tokenizers"))}
    return {
        "retained": [dataclasses.asdict(task) for task in scenario.pretrained],
        "scenes": [dataclasses.asdict(task) for task in scenario.scenes],
        "budget": {name: value for name, value in budget.items() if name not in AFTER_PRETRAINING},
        **(own or {"seed": seed}),
        "text_length": scenario.text_length,
        "questions": scenario.questions,  # one package may have several
        "policy": scenario.policy,
        "frame": frame_hash(scenario.scene_tasks[0]),
        "source": source_hash(*TRAINING_SOURCES, *suites),
        # a label such as torch's +cpu names other abilities of a build; pretraining does not use them
        "versions": {name: version.partition("+")[0] for name, version in installed.items()},
    }


def _own_weights(scenario: Scenario, seed: int) -> dict[str, str]:
    """Return the hash of the weights that a class of policies brings, nothing if clbench trains them.

    The weights may lie in a file that no source names, and that somebody may replace.
    """
    cls = policy_class(kind_of(scenario.policy))
    return {"weights": _weights_hash(cls, policy_config(scenario), seed)} if cls.pretrained else {}


@functools.cache  # each look at the records asks for every seed, and a large policy takes seconds to load
def _weights_hash(cls: type[Policy], config: PolicyConfig, seed: int) -> str:
    return hash_of_tensors(cls(config, derive_seed("weights", seed)).state_dict())


def shipped_folder(scenario: Scenario, seed: int) -> Path:
    """Return the folder in which the pretrained policy lies if it ships with the package."""
    kind = "" if scenario.policy == DEFAULT_POLICY else f"-{folder_name(scenario.policy)}"
    return SHIPPED / f"{scenario.id.replace('/', '--')}{kind}-seed-{seed}"


def pretrained_folder(scenario: Scenario, seed: int) -> Path:
    """Return the folder of the pretrained policy, made or not: in the cache, unless the same policy ships."""
    return _folder(scenario, seed, pretraining_inputs(scenario, seed))


def is_pretrained(scenario: Scenario, seed: int) -> bool:
    """Return whether the pretrained policy ships or is in the cache."""
    inputs = pretraining_inputs(scenario, seed)
    return is_cached(_folder(scenario, seed, inputs), inputs)


def _folder(scenario: Scenario, seed: int, inputs: Mapping[str, Any]) -> Path:
    shipped = shipped_folder(scenario, seed)
    if is_cached(shipped, inputs):
        return shipped
    # weights that a class brings may be the same for all seeds, and a large policy needs no copy for each
    name = shipped.name if "seed" in inputs else shipped.name.removesuffix(f"-seed-{seed}")
    return cache_folder() / "pretrained" / f"{name}-{hash_of(inputs)}"


def pretrained_policy(
    scenario: Scenario, seed: int, progress: ProgressCallback = no_progress
) -> tuple[Policy, Path]:
    """Return the policy pretrained on the retained tasks, the background and the questions, and its folder.

    A scenario without such tasks pretrains on the questions alone: the states of the questions set the
    normalisation of states, actions are not normalised, and the action head keeps its initial weights.

    The policy is trained on first use, and all methods share it.

    Args:
        scenario: Scenario of the retained tasks and the questions.
        seed: Seed of the weights and of every draw.
        progress: Called with the number of steps done since its last call.
    """
    inputs = pretraining_inputs(scenario, seed)
    shipped = shipped_folder(scenario, seed)

    def make(partial: Path) -> None:
        if shipped.exists():
            LOG.warning("%s %s: pretraining the policy again.", shipped, fault_of(shipped, inputs))
        save_policy(pretrain(scenario, seed, progress), partial)

    folder = cached(_folder(scenario, seed, inputs), inputs, make)
    return load_policy(folder, name=scenario.policy), folder


def vision_steps(scenario: Scenario) -> int:
    """Return the number of optimiser steps that pretrain the vision before the policy; 0 without a camera."""
    seen = scenario.scene_tasks[0].camera is not None
    return round(STEPS_SHARE * scenario.budget.pretraining_steps) if seen else 0


def policy_config(scenario: Scenario) -> PolicyConfig:
    """Return the sizes of a policy for the scenario's worlds."""
    first = scenario.tasks[0]
    observer = Observer(first.world, first.camera)
    width, layers = size_of(scenario.policy) or (scenario.budget.policy_width, scenario.budget.policy_layers)
    with contextlib.closing(resolve(first.world)()) as world:
        return PolicyConfig(
            state_size=observer.spaces(world.observation_space)["state"].shape[0],
            action_size=world.action_space.shape[0],
            text_length=scenario.text_length,
            image_size=observer.image_size,
            width=width,
            layers=layers,
            kind=kind_of(scenario.policy),
        )


@deterministic()  # the means and deviations of the data depend on the number of threads, too
def pretrain(
    scenario: Scenario,
    seed: int,
    progress: ProgressCallback = no_progress,
    watch: Callable[[Policy, int], None] = lambda _, __: None,
) -> Policy:
    """Return the policy of `pretrained_policy`, trained now even if it is in the cache or ships.

    A class of policies with pretrained weights of its own is not trained.

    Args:
        scenario: Scenario of the retained tasks and the questions.
        seed: Seed of the weights and of every draw.
        progress: Called with the number of steps done since its last call.
        watch: Called with the policy and the number of steps done, before the first step and after each.
    """
    config, budget = policy_config(scenario), scenario.budget
    questions, _ = load_questions(scenario)
    policy = new_policy(config, seed=derive_seed("weights", seed))
    if policy.pretrained:
        progress(budget.pretraining_steps)
        return policy
    parts = [load_demonstrations(task, scenario, config) for task in scenario.pretrained]
    demonstrations = Demonstrations.cat(parts) if parts else None
    if demonstrations is not None:
        policy.normalise_like(demonstrations.state, demonstrations.action[:, 0])
    else:
        policy.normalise_like(questions.state)
        if "answers" not in policy.abilities:  # there is nothing to learn from
            watch(policy, 0)
            progress(budget.pretraining_steps)
            return policy
    vision = policy.vision_to_pretrain()
    if vision is not None:
        _pretrain_vision(
            vision,
            scenario,
            seed,
            [questions, demonstrations] if demonstrations else [questions],
            progress,
        )
    generator = torch_generator("pretraining", seed)

    def loss_at(step: int) -> Tensor:
        if demonstrations is None:
            return policy.answer_loss(questions.sample(budget.batch_size // 2, generator)).mean()
        loss = policy.action_loss(demonstrations.sample(budget.batch_size, generator)).mean()
        if "answers" not in policy.abilities:
            return loss
        return loss + policy.answer_loss(questions.sample(budget.batch_size // 2, generator)).mean()

    def after(step: int) -> None:
        watch(policy, step)
        progress(1)

    watch(policy, 0)
    optimise(
        policy.parameters(),
        budget.pretraining_learning_rate,
        budget.pretraining_steps,
        loss_at,
        after=after,
    )
    return policy


def _pretrain_vision(
    vision: Vision,
    scenario: Scenario,
    seed: int,
    data: Sequence[Questions | Demonstrations],
    progress: ProgressCallback,
) -> None:
    """Pretrain the vision on the pictures of all data."""
    entry_point = scenario.scene_tasks[0].camera
    assert entry_point is not None
    kinds = resolve(scenario.questions)
    pretrain_vision(
        vision,
        pictures_of([(part.scenes, part.image) for part in data], load_camera(entry_point), kinds),
        kinds,
        vision_steps(scenario),
        torch_generator("vision", seed),
        lambda _: progress(1),
    )
