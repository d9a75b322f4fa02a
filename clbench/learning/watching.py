"""Pretraining, repeated for methods that watch it: they need to know how the skills were learned."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import torch

from clbench.base.cache import cache_folder, cached, hash_of, hash_of_tensors, is_cached
from clbench.base.progress import ProgressCallback
from clbench.learning.method import Method, MethodState, Progress
from clbench.learning.method_state import check_state, read_state, write_state
from clbench.learning.optimise import MethodError
from clbench.learning.pretraining import pretrain, pretraining_inputs
from clbench.learning.registry import describe_method
from clbench.policy.policy import Policy
from clbench.spec.scenario import Scenario


def watches(method: type[Method]) -> bool:
    """Return whether a method watches the pretraining."""
    return method.watch_pretraining is not Method.watch_pretraining


def watch(
    method: Method,
    pretrained: Policy,
    scenario: Scenario,
    seed: int,
    hooks: Callable[[], AbstractContextManager[None]],
    progress: ProgressCallback,
) -> MethodState:
    """Let a method watch the pretraining, and return its state afterwards, from the cache if it is there.

    Args:
        method: The method.
        pretrained: The pretrained policy, which the repeated pretraining must reproduce.
        scenario: Scenario of the pretraining.
        seed: Seed of the pretraining.
        hooks: Returns the context in which hooks run.
        progress: Called with the number of steps done since its last call.

    Raises:
        MethodError: The method does not declare prior demonstrations, or it changed the pretraining, or there
            was no pretraining, because the policy has pretrained weights of its own.
    """
    if pretrained.pretrained:
        policy = type(pretrained).__name__
        raise MethodError(
            f"watch_pretraining() has nothing to watch: {policy} has pretrained weights of its own."
        )
    if method.uses.demonstrations == "never":
        raise MethodError(
            "watch_pretraining() learns from the demonstrations of the skills: "
            'declare `uses = Uses(demonstrations="prepare")`.'
        )
    inputs = {
        **pretraining_inputs(scenario, seed),
        "pretrained": hash_of_tensors(pretrained.state_dict()),  # other processors end at other weights
        "method": describe_method(type(method))["source"],
        "class": f"{type(method).__module__}:{type(method).__qualname__}",
        "settings": {name: repr(value) for name, value in dataclasses.asdict(method).items()},
    }

    def make(partial: Path) -> None:
        steps = scenario.budget.pretraining_steps

        def look(policy: Policy, step: int) -> None:
            with hooks():
                method.watch_pretraining(policy, Progress(step, steps))

        again = pretrain(scenario, seed, progress, look)
        for name, value in pretrained.state_dict().items():
            if not torch.equal(value.cpu(), again.state_dict()[name]):
                raise MethodError(
                    f"watch_pretraining() must change nothing, but {name} differs from the pretraining "
                    "without it: draw no random number and write to no tensor in it."
                )
        with hooks():
            state = method.state()
        check_state(state)
        write_state(partial, state)

    folder = cache_folder() / "watched" / hash_of(inputs)
    if is_cached(folder, inputs):
        progress(scenario.budget.pretraining_steps)  # the bar of a run counts them
    return read_state(cached(folder, inputs, make), pretrained.device)
