"""A run of a method on the toy, without evaluation, that watches every hook."""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import itertools
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from clbench.base.seeding import seeded, torch_generator
from clbench.base.text import counted, did_you_mean
from clbench.data.access import LeakError
from clbench.data.demonstrations import Demonstrations
from clbench.data.training_data import TrainingData
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.adaptation import Step
from clbench.learning.hooks import HOOKS
from clbench.learning.method import Method, Stage
from clbench.learning.method_state import StateError, check_state
from clbench.learning.optimise import MethodError, deterministic, steps_counted
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.prior import Prior, Source, UndeclaredAccessError
from clbench.learning.trainer import Trainer
from clbench.learning.watching import watches
from clbench.policy.batch import Batch
from clbench.policy.checkpoint import CheckpointError
from clbench.policy.policy import Policy
from clbench.runs.fingerprint import arithmetic_hash
from clbench.spec.policies import DEFAULT_POLICY
from clbench.testing.clauses import ContractError, actions_of, moved
from clbench.testing.global_state import GENERATORS, forgetting, read, same, watched
from clbench.testing.toy import TOY

UNSEEDED = ("state", "diagnostics")
"""Hooks that may not draw at random."""

SOUND = {
    "watch_pretraining": "watch_pretraining() to change nothing",
    "start_task": "an iterable of the policy's parameters, or of optimiser groups of them",
    "loss": "a finite scalar tensor that has a gradient",
    "gradients": "finite gradients of the trained parameters",
    "learning_rate": "a finite float of at least 0",
    "end_task": "a policy of finite weights",
}
"""Result that the loop needs from a hook."""

GROUP_KEYS = {"name", *inspect.signature(torch.optim.AdamW).parameters}
"""Keys that a group of parameters may have: those that AdamW reads, and a name, which nothing reads."""

_numbers = itertools.count()


@functools.cache
def toy_data(policy: str) -> tuple[TrainingData, Policy]:
    """Return the data and a pretrained policy of the toy; reading them takes a second."""
    arithmetic_hash()  # its optimiser steps, once in a process, must not count as those of a method
    pretrained, _ = pretrained_policy(TOY.with_policy(policy), 0)
    return TrainingData.open(TOY, pretrained.config), pretrained


@functools.cache
def some_samples(policy: str) -> Batch:
    """Return a batch of the toy's targets, on which policies act; no run draws it."""
    data, _ = toy_data(policy)
    known = Demonstrations.cat([data.demonstrations(task) for task in TOY.target])
    return Source(known, torch_generator("some samples"), TOY.budget.batch_size).sample(16)


@functools.cache
def frozen_return(policy: str) -> float:
    """Return the mean return of a pretrained policy, as defined by `mean_return`."""
    _, pretrained = toy_data(policy)
    return mean_return(pretrained)


def mean_return(policy: Policy) -> float:
    """Return the mean return of the policy on the toy's first target, over its validation episodes."""
    with closing(Evaluator(TOY, 0)) as evaluator, deterministic():
        episodes = evaluator.evaluate(policy, TOY.target[:1])
    return sum(episode.total_reward for episode in episodes) / len(episodes)


class ToyRun:
    """A run of a method on the toy, with the observed behaviour of its hooks.

    Args:
        build: Returns a new object of the method.
        targets: Number of targets to learn.
        steps: Number of optimiser steps on each target.
        seed: Seed of every draw.
        resumed: Whether each stage begins with a new object that loads the state of the last one, as in every
            run, or continues with the old object.
        policy: Name of the policy.
        to_criterion: Whether the stages have a criterion. The first one then meets it at its first check
            after a step, each later one at the check before its first step.

    Raises:
        ContractError: A hook does something after which the loop cannot continue.
    """

    def __init__(
        self,
        build: Callable[[], Method],
        targets: int,
        steps: int,
        seed: int = 0,
        resumed: bool = True,
        policy: str = DEFAULT_POLICY,
        to_criterion: bool = False,
    ) -> None:
        self.draws: set[tuple[str, str]] = set()
        """Source and hook of all draws."""
        self.changes: dict[tuple[str, str], None] = {}
        """Hooks with descriptions of their side effects."""
        self.outcomes: dict[tuple[str, str], Any] = {}
        """Weights, state and diagnostics, by stage and name."""
        self.generators: dict[str, dict[str, Any]] = {}
        """Global random generators after the first call of each hook for which a run seeds them."""
        self.merges = False
        """Whether a call of `end_task` changed the actions of the policy."""
        self.steps_of_merges = 0
        """Most optimiser steps in a call of `end_task` that changed the actions of the policy."""
        self.samples = some_samples(policy)
        """Samples on which the policy acts before and after each `end_task`."""
        self._build, self._hook, self._running = build, "prepare", False
        self._earlier: list[Method | Policy] = []
        """Objects of the method, and policies, that the run has had."""
        criterion = 1.0 if to_criterion else None
        budget = dataclasses.replace(TOY.budget, adaptation_steps=steps, criterion=criterion)
        scenario = dataclasses.replace(TOY.with_policy(policy), target=TOY.target[:targets], budget=budget)
        data, pretrained = toy_data(policy)
        # no two runs begin with the same global generators: results that depend on them differ
        with deterministic(), seeded("toy run", next(_numbers)), tempfile.TemporaryDirectory() as folder:
            self.trainer = Trainer(scenario, data, pretrained, self._watched_method, seed, pretraining_seed=0)
            self._go(Path(folder), resumed)

    def _go(self, folder: Path, resumed: bool) -> None:
        with forgetting(type(self.trainer.method)) as forget:
            for number in range(len(self.trainer.scenario.target) + 1):
                with self._named_faults():
                    if number:
                        self.trainer.learn(number, functools.partial(self._is_learned, number))
                    else:
                        self.outcomes["prepare", "steps"] = self.trainer.prepare()
                    stage = self.trainer.where
                    self._keep(stage, "diagnostics", self.trainer.diagnostics(number))
                    self.trainer.save(folder, self.trainer.state(number))
                    for name, value in self.trainer.policy.state_dict().items():
                        self._keep(stage, name, value)
                    if resumed:
                        self._earlier.append(self.trainer.policy)
                        forget()
                        self.trainer.load(folder, number)

    def _is_learned(self, number: int, step: Step) -> bool:
        """Return whether a stage ends after a step; checks ask for the policy that it would leave."""
        if step.done not in self.trainer.scenario.budget.check_steps:
            return False
        try:
            self.trainer.finished()
        except ContractError:
            raise
        except Exception as error:
            expected = "a method that copy.deepcopy() can copy: detach the tensors that it keeps"
            found = f"{type(error).__name__}: {error}"
            raise ContractError("criterion", expected, found, "whole_stages") from error
        return number > 1 or step.done > 0

    def __deepcopy__(self, memo: dict[int, Any]) -> ToyRun:
        """Return the run itself: it watches the copies of its method too."""
        return self

    def difference(self, other: ToyRun) -> str | None:
        """Return a description of the first outcome that differs in another run, or None."""
        for stage, name in {**self.outcomes, **other.outcomes}:
            first, second = (run.outcomes.get((stage, name)) for run in (self, other))
            if same(first, second):
                continue
            words = f"{name} differs in {stage}"
            if isinstance(first, Tensor) and isinstance(second, Tensor) and first.shape == second.shape:
                words += f" by up to {float((1.0 * first - 1.0 * second).abs().max()):.2g}"
            return words
        return None

    def weights(self, number: int) -> dict[str, Tensor]:
        """Return all tensors of the policy after stage `number`."""
        stage = f"stage {number} ({self.trainer.scenario.target[number - 1].name})"
        names = self.trainer.policy.state_dict()
        return {name: value for (one, name), value in self.outcomes.items() if one == stage and name in names}

    def hooks_that_draw(self, source: str) -> set[str]:
        """Return the hooks that draw samples from a source."""
        return {hook for one, hook in self.draws if one == source}

    def _keep(self, stage: str, name: str, value: Any) -> None:
        value = value.detach().clone() if isinstance(value, Tensor) else copy.deepcopy(value)
        self.outcomes[stage, name] = value

    @contextmanager
    def _named_faults(self) -> Iterator[None]:
        """Turn an error inside, but outside all hooks, into a fault of the last hook."""
        try:
            yield
        except ContractError:
            raise
        except Exception as error:
            found = str(error) if isinstance(error, MethodError) else f"{type(error).__name__}: {error}"
            if isinstance(error.__cause__ or error, CheckpointError):
                expected = "load_state() to add to a plain policy what prepare() added"
                raise ContractError("state", expected, found, "load_state()") from error
            expected = SOUND.get(self._hook, f"{self._hook}() to run without an error")
            raise ContractError("sound hooks", expected, found, f"{self._hook}()") from error

    # ---- the hooks ---------------------------------------------------------------------------------

    def _watched_method(self) -> Method:
        method = self._build()
        self._earlier.append(method)
        self.uses = method.uses
        if watches(type(method)):  # in the cache after the first run
            if method.uses.demonstrations == "never":
                expected = (
                    'a method with watch_pretraining() to declare `uses = Uses(demonstrations="prepare")`'
                )
                raise ContractError("declared data", expected, 'demonstrations="never"', "uses")
            self.draws.add(("demonstrations", "prepare"))
        for hook in HOOKS:
            # an attribute of the object takes precedence over the hook of its class, even if it is frozen
            object.__setattr__(method, hook, functools.partial(self._call, hook, getattr(method, hook)))
        return method

    def _call(self, hook: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        if self._running:  # the method calls one of its own hooks
            return function(*arguments, **named)
        self._hook, self._running = hook, True
        acted = actions_of(arguments[0], self.samples) if hook == "end_task" else None
        changes: list[str] = []
        try:
            with watched(changes, generators=hook in UNSEEDED), steps_counted() as taken:
                result = function(*map(self._watched_data, arguments), **named)
                if inspect.isgenerator(result):  # nothing of it has run yet
                    result = list(result)
        except Exception as error:
            raise self._fault(hook, error) from error
        finally:
            self._running = False
            self.changes.update(dict.fromkeys((hook, change) for change in changes))
        if hook == "start_task" and taken():  # runs refuse it where a criterion ends the stage
            expected = "no optimiser steps: a target is learned in the steps that follow"
            raise _unsound("start_task", expected, counted(taken(), "step"))
        if acted is not None and moved(acted, actions_of(arguments[0], self.samples)):
            self.merges, self.steps_of_merges = True, max(self.steps_of_merges, taken())
        if hook not in (*UNSEEDED, "load_state"):
            self.generators.setdefault(hook, read(GENERATORS))
        check = getattr(self, f"_checked_{hook}", None)
        return check(result) if check else result

    def _fault(self, hook: str, error: Exception) -> ContractError:
        """Return the breach of the contract for an error in a hook."""
        clause, look = "sound hooks", f"{hook}()"
        expected, found = f"{hook}() to run without an error", f"{type(error).__name__}: {error}"
        if isinstance(error, UndeclaredAccessError):
            clause, found = "declared data", str(error)
            expected = (
                f"{hook}() to draw from its arguments: at most a batch of the target in a step, and only the "
                "prior data that `uses` declares"
            )
        elif isinstance(error, LeakError):
            clause, found = "declared data", str(error)
            expected = (
                f"{hook}() to read, and play validation episodes of, only its own target and the tasks whose "
                "demonstrations `uses` declares"
            )
        elif isinstance(error, AttributeError) and error.name and isinstance(error.obj, Method | nn.Module):
            found = f"{hook}() finds no attribute {error.name!r} in the {type(error.obj).__name__}"
            if self._had(type(error.obj), error.name):
                clause, look = "state", "state() and load_state()"
                expected = "every stage to begin with a new object that has only what load_state() sets"
            else:
                hint = did_you_mean(error.name, dir(error.obj))
                found += f".{hint}" if hint else ""
        elif hook in ("state", "load_state"):
            clause = "state"
        return ContractError(clause, expected, found, look)

    def _had(self, kind: type, name: str) -> bool:
        """Return whether an earlier object of this type had an attribute: a method, or a part of a policy."""
        earlier = (one.modules() if isinstance(one, nn.Module) else [one] for one in self._earlier)
        return any(type(one) is kind and hasattr(one, name) for one in itertools.chain(*earlier))

    def _checked_prepare(self, steps: Any) -> Any:
        if steps is not None and not (type(steps) is int and steps >= 0):
            raise _unsound("prepare", "the number of optimiser steps that it took, or None", repr(steps))
        return steps

    def _checked_start_task(self, parameters: Any) -> list[Any]:
        try:
            groups = [_listed(one) for one in parameters]
            # copies, since an optimiser writes to its groups
            copies = [dict(one) if isinstance(one, dict) else one for one in groups]
            made = torch.optim.AdamW(copies).param_groups if copies else []
        except (TypeError, ValueError, KeyError) as error:
            found = type(parameters).__name__ if parameters is None else str(error)
            raise _unsound("start_task", SOUND["start_task"], found) from error
        unknown = sorted({key for one in groups if isinstance(one, dict) for key in one} - GROUP_KEYS)
        if unknown:
            expected = "groups with keys that AdamW reads, such as `lr`, a group's learning rate, or `name`"
            raise _unsound("start_task", expected, f"{', '.join(map(repr, unknown))}, which no step reads")
        trained = [parameter for group in made for parameter in group["params"]]
        if not trained and not self.uses.reference:
            expected = "parameters to train; only a reference, `uses = Uses(reference=True)`, may train none"
            raise _unsound("start_task", expected, "none")
        if not all(one.requires_grad for one in trained):
            raise _unsound("start_task", "parameters that require a gradient", "one that does not")
        return groups

    def _checked_state(self, state: Any) -> Any:
        try:
            check_state(state)
        except StateError as error:
            expected = f"state() to return {error.expected}"
            raise ContractError("state", expected, error.found, "state()") from error
        if self.trainer.where != "watch_pretraining":  # a later run has it from the cache
            for name, value in state.items():
                self._keep(self.trainer.where, f"state {name!r}", value)
        return state

    def _checked_diagnostics(self, diagnostics: Any) -> Any:
        try:
            text = json.dumps(diagnostics, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise _unsound("diagnostics", "values that JSON can hold", str(error)) from error
        if not isinstance(diagnostics, dict):
            raise _unsound("diagnostics", "a dictionary", text)
        return diagnostics

    # ---- arguments of the hooks --------------------------------------------------------------------

    def _watched_data(self, argument: Any) -> Any:
        """Return an argument of a hook with watched sources."""
        if isinstance(argument, Stage):
            return dataclasses.replace(
                argument,
                target=self._watched_data(argument.target),
                prior=self._watched_data(argument.prior),
            )
        if isinstance(argument, Prior):
            return Prior(
                {name: WatchedSource(one, self._recorder(name)) for name, one in argument.sources.items()}
            )
        if isinstance(argument, Source):
            return WatchedSource(argument, self._recorder("target"))
        return argument

    def _recorder(self, source: str) -> Callable[[], None]:
        return lambda: self.draws.add((source, self._hook))


class WatchedSource(Source[Any]):
    """A source that reports each draw.

    Args:
        source: Source of the samples.
        drew: Called after each draw.
    """

    def __init__(self, source: Source[Any], drew: Callable[[], None]) -> None:
        self.batch_size = source.batch_size
        self._source, self._drew = source, drew

    def __len__(self) -> int:
        return len(self._source)

    @property
    def bytes(self) -> int:
        """Memory that the data takes."""
        return self._source.bytes

    def sample(self, count: int) -> Any:
        """Return `count` samples."""
        rows = self._source.sample(count)
        self._drew()
        return rows

    def close(self) -> None:
        """End the access."""
        self._source.close()


def _listed(group: Any) -> Any:
    """Return a parameter group with a list of parameters: the optimiser must find them again."""
    if not isinstance(group, dict) or isinstance(group["params"], Tensor):
        return group
    return {**group, "params": list(group["params"])}


def _unsound(hook: str, expected: str, found: str) -> ContractError:
    return ContractError("sound hooks", f"{hook}() to return {expected}", found, f"{hook}()")
