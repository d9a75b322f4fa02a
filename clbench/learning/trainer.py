"""The trainer: takes the policy and the method of a run through the stages, without evaluation."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from clbench.base.dependencies import versions
from clbench.base.progress import ProgressCallback, announce, no_progress
from clbench.base.seeding import derive_seed, draws_restored, seeded, torch_generator
from clbench.base.source import RUN_SOURCES, source_hash
from clbench.data.access import check_policy, hooks, outside
from clbench.data.demonstrations import Demonstrations
from clbench.data.training_data import TrainingData
from clbench.learning.adaptation import Step, adapt, check_finite
from clbench.learning.method import Method, MethodState, Stage
from clbench.learning.method_state import check_state, read_state, write_state
from clbench.learning.optimise import MethodError, steps_counted
from clbench.learning.pretraining import pretrained_policy, pretraining_inputs
from clbench.learning.prior import Access, Nothing, Prior, Source, twin_of
from clbench.learning.watching import watch, watches
from clbench.policy.checkpoint import CheckpointError, MisfitError, load_policy, save_policy
from clbench.policy.policy import Policy
from clbench.spec.policies import policy_packages
from clbench.spec.scenario import Scenario
from clbench.spec.task import packages_of

STAGE_FILES = ("policy.safetensors", "policy.json", "method.safetensors", "method.json")
"""Files of a finished stage: the policy, and the state of the method with which the next stage begins."""


class Trainer:
    """Takes the policy and the method of a run from stage to stage.

    Each stage begins with what the last one saved: a policy from its checkpoint, and a new object of the
    method that receives its saved state. An interrupted run therefore continues as if nothing had happened.

    Args:
        scenario: Scenario with the targets that are learned.
        data: Demonstrations and questions of the scenario.
        pretrained: The pretrained policy, on the device where the run computes; it is not changed.
        new_method: Returns a new object of the method.
        seed: Seed of the run.
        pretraining_seed: Seed of the pretrained policy, if it differs from `seed`.
    """

    def __init__(
        self,
        scenario: Scenario,
        data: TrainingData,
        pretrained: Policy,
        new_method: Callable[[], Method],
        seed: int,
        pretraining_seed: int | None = None,
    ) -> None:
        self.scenario, self.data, self.seed = scenario, data, seed
        self._pretraining_seed = seed if pretraining_seed is None else pretraining_seed
        self.pretrained, self.new_method = pretrained, new_method
        self.policy, self.method = copy.deepcopy(pretrained), new_method()
        self.where = "start"
        self.extra_steps = 0
        """Optimiser steps that the method took in the hooks of the last stage, besides those of the loop."""

    @property
    def where(self) -> str:
        """Hook or stage that is running; a failed run records it."""
        return self._where

    @where.setter
    def where(self, place: str) -> None:
        self._where = place
        announce(place)

    @classmethod
    def open(cls, scenario: Scenario, new_method: Callable[[], Method], seed: int, device: str) -> Trainer:
        """Return the trainer of a run; its policy is pretrained, and its data collected, on first use.

        Args:
            scenario: Scenario with the targets that are learned.
            new_method: Returns a new object of the method.
            seed: Seed of the run.
            device: Device on which the policy computes.
        """
        pretrained, _ = pretrained_policy(scenario, seed)
        data = TrainingData.open(scenario, pretrained.config)
        return cls(scenario, data, pretrained.to(device), new_method, seed)

    @property
    def device(self) -> torch.device:
        """Device on which the policy computes."""
        return self.pretrained.device

    def prepare(self, progress: ProgressCallback = no_progress) -> int:
        """Let the method prepare for the sequence, and return the number of optimiser steps that it took.

        Args:
            progress: Called with the number of steps of the pretraining that the method has watched.
        """
        watched = self._watch(progress) if watches(type(self.method)) else 0
        self.where = "prepare"
        prior = self.prior(0, ("prepare", "throughout"))
        with seeded("method", self.seed, 0), self._hooks(0), steps_counted() as taken:
            declared = self.method.prepare(self.policy, prior) or 0
            steps = max(declared, taken())  # a result from the cache took its steps earlier
        prior.close()
        check_policy(self.policy, self.pretrained)
        check_finite(self.policy, "prepare()")
        return watched + steps

    def _watch(self, progress: ProgressCallback) -> int:
        """Let the method watch the pretraining, and return its number of steps."""
        self.where = "watch_pretraining"
        with seeded("method", self.seed, 0):
            state = watch(
                self.method,
                self.pretrained,
                self.scenario,
                self._pretraining_seed,
                lambda: self._hooks(0),
                progress,
            )
        self.method = self.new_method()
        self.where = "load_state() after watch_pretraining"
        with seeded("method", self.seed, 0), self._hooks(0):
            self.method.load_state(self.policy, state)
        return self.scenario.budget.pretraining_steps

    def learn(self, number: int, after: Callable[[Step], bool | None]) -> int:
        """Adapt to a target, and return the number of optimiser steps done.

        `extra_steps` is then the number of other optimiser steps that the method took in its hooks.

        Args:
            number: Number of the target, from 1.
            after: Called after each step, as by `adapt`; the stage ends if it returns True.
        """
        budget, task = self.scenario.budget, self.scenario.target[number - 1]
        self.where = f"stage {number} ({task.name})"
        target = self._source("target", number, self.data.demonstrations(task))
        prior = self.prior(number, ("throughout",))
        method_seed = derive_seed("method", self.seed, number)
        stage = Stage(number, task, method_seed, budget.adaptation_steps, target, prior)
        self._stage = stage

        aside = 0

        def report(step: Step) -> bool | None:
            nonlocal aside
            before = taken()
            with outside():
                ends = after(step)
            aside += taken() - before  # a check lets a method of `whole_stages` end the stage on copies
            return ends

        with seeded("method", self.seed, number), self._hooks(number), steps_counted() as taken:
            steps = adapt(self.policy, self.method, stage, budget, report)
            self.extra_steps = max(0, taken() - aside - steps)
        target.close()
        prior.close()
        check_policy(self.policy, self.pretrained)
        return steps

    def finished(self) -> Policy:
        """Return the policy that the running stage would leave if it ended now; the stage goes on as it was.

        This is the policy in training, unless the method declares `whole_stages`: then its `end_task` works
        on copies of the policy and of the method, with the next random draws.
        """
        if not self.method.whole_stages:
            return self.policy
        prior = Prior({name: twin_of(source) for name, source in self._stage.prior.sources.items()})
        stage = dataclasses.replace(self._stage, target=twin_of(self._stage.target), prior=prior)
        policy, method = copy.deepcopy((self.policy, self.method))
        with draws_restored(), self._hooks(stage.number):
            method.end_task(policy, stage)
        return policy

    def _hooks(self, number: int) -> AbstractContextManager[None]:
        """Restrict the code inside to what the hooks of stage `number` may know, and may read."""
        earlier = [task.name for task in self.scenario.retained + self.scenario.target[: max(0, number - 1)]]
        own = [task.name for task in self.scenario.target[number - 1 : number]] if number else []
        allowed = ("throughout",) if number else ("prepare", "throughout")
        declared = earlier if self.method.uses.demonstrations in allowed else []
        return hooks(earlier + own, declared + own)

    def prior(self, number: int, when: tuple[Access, ...]) -> Prior:
        """Return the prior data that the method declares for the hooks of stage `number`."""
        sources = {}
        if self.method.uses.demonstrations in when:
            before = self.scenario.retained + self.scenario.target[: max(0, number - 1)]
            parts = [self.data.demonstrations(task) for task in before]
            demonstrations = Demonstrations.cat(parts) if parts else Nothing()
            sources["demonstrations"] = self._source("prior demonstrations", number, demonstrations)
        if self.method.uses.questions in when:
            sources["questions"] = self._source("prior questions", number, self.data.questions)
        return Prior(sources)

    def _source(self, name: str, number: int, data: Any) -> Source[Any]:
        """Return data with its own random stream: draws from one source do not affect another source."""
        generator = torch_generator(name, self.seed, number)
        return Source(data, generator, self.scenario.budget.batch_size, self.device)

    def state(self, number: int) -> MethodState:
        """Return what the method keeps after stage `number`.

        Raises:
            StateError: The files of a state cannot hold it.
        """
        self.where = f"state() after stage {number}"
        with self._hooks(number):
            state = self.method.state()
        check_state(state)
        return state

    def diagnostics(self, number: int) -> Any:
        """Return what the method reports on stage `number`."""
        self.where = f"diagnostics() after stage {number}"
        with self._hooks(number):
            return self.method.diagnostics()

    def save(self, folder: Path, state: MethodState) -> None:
        """Write the policy and the state of the method to the `STAGE_FILES` of `folder`."""
        save_policy(self.policy, folder)
        write_state(folder, state)

    def load(self, folder: Path, number: int) -> None:
        """Load the policy and the method that stage `number` left in `folder`."""
        self.where = f"load_state() after stage {number}"
        self.method = self.new_method()
        # adapters draw random values before the file fills them
        with seeded("method", self.seed, number), self._hooks(number):
            try:
                self.policy = load_stage(folder, self.method, self.device, self.scenario.policy)
            except MisfitError as error:
                raise MethodError(
                    f"load_state() must give a new policy the parameters and buffers that the method had "
                    f"added: {', '.join(error.names)} differ."
                ) from error
        check_policy(self.policy, self.pretrained)


def load_stage(folder: Path, method: Method, device: torch.device | str, policy: str) -> Policy:
    """Return the policy that a stage left in `folder`, and load the state in the same folder into `method`.

    Args:
        folder: Folder of the stage.
        method: New object of the method.
        device: Device on which the policy computes.
        policy: Name of the policy.

    Raises:
        CheckpointError: A file is missing or torn, or is not a file of a stage.
    """
    try:
        state = read_state(folder, device)
    except (OSError, ValueError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: cannot be read as the state of a method ({error}).") from error
    return load_policy(folder, lambda made: method.load_state(made, state), policy).to(device)


def training_inputs(scenario: Scenario, seed: int) -> dict[str, Any]:
    """Return the code and the data that any result of a run depends on, besides its method, as JSON."""
    suites = {*packages_of(scenario.tasks, "world", "expert", "camera"), *policy_packages(scenario.policy)}
    return {
        "pretraining": pretraining_inputs(scenario, seed),
        "tasks": [dataclasses.asdict(task) for task in scenario.tasks],
        "source": source_hash(*RUN_SOURCES, *suites),
        "versions": versions(("peft",)),  # of the packages that only methods use
    }
