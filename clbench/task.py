"""Tasks, scenarios and budgets: what there is to learn, as data."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

from clbench.limits import Limits

Group = Literal["retained", "target", "held_out"]
Split = Literal["selection", "report"]

SPLITS: tuple[Split, ...] = ("selection", "report")


def resolve(name: str) -> Any:
    """Return the object that `name`, "module:attribute", names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def unknown(kind: str, name: str, known: Iterable[str]) -> LookupError:
    """Return the error for a name that is not among the `known` ones, with the nearest of them."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return LookupError(f"No {kind} is called {name!r}.{hint} Known: {', '.join(known)}.")


@dataclass(frozen=True)
class Task:
    """One thing to do in one simulated world."""

    name: str
    """Name inside its suite, as "push"."""
    suite: str
    """Family of worlds that it belongs to, as "fetch"."""
    instructions: tuple[str, ...]
    """The instruction in words; paraphrases follow the canonical one."""
    horizon: int
    """Steps after which an episode ends without success."""
    world: str
    """Entry point "module:callable" that makes the Gymnasium environment. One environment serves every
    task of its world: `reset(options={"task": name})` chooses. Its observation is the state, a float32
    vector; `terminated` means success, and `info["success"]` says so."""
    expert: str
    """Entry point of a callable that takes the task's name and returns a callable (S,) -> (A,): the
    expert's action in a state. It must not remember earlier states: it also labels perturbed episodes."""
    camera: str | None = None
    """Entry point of the `clbench.camera.Camera` that a policy sees the world through, as the states hold
    more than it may know; if None, it is shown the states."""
    version: int = 0
    """Raised whenever the task, its expert or its demonstrations change."""

    @property
    def dataset_id(self) -> str:
        """Id of the Minari dataset that holds the demonstrations."""
        return f"clbench/{self.suite}/{self.name.replace('_', '-')}-v{self.version}"


@dataclass(frozen=True)
class Budget:
    """What every method gets: data, steps, a policy of one size, and evaluation episodes."""

    demonstrations: int = 200
    """Expert episodes per task."""
    perturbation: float = 0.5
    """Share of the demonstrations in which disturbed actions are executed and the expert's are recorded."""
    question_episodes: int = 200
    """Episodes whose states the training questions ask about; a quarter as many more are for the report."""
    report_questions: int = 1000
    """Questions asked at the end of each stage."""
    pretraining_steps: int = 3000
    """Optimiser steps on the retained tasks and the training questions."""
    pretraining_learning_rate: float = 1.5e-3
    """Peak step size of pretraining."""
    adaptation_steps: int = 300
    """Optimiser steps on each target task."""
    learning_rate: float = 3e-4
    """Peak step size of adaptation."""
    batch_size: int = 64
    """Samples per step."""
    policy_width: int = 96
    """Channels of the policy's tokens."""
    policy_layers: int = 3
    """Layers of the policy's backbone, and as many of its action head."""
    evaluation_points: int = 4
    """How often the policy is evaluated while a target is learned, the end included."""
    selection_episodes: int = 10
    """Episodes per task that choices may look at."""
    report_episodes: int = 20
    """Episodes per task that scores are made of, and nothing else."""
    curve_episodes: int = 5
    """How many of the report episodes are run at the points before a stage's end."""

    def __post_init__(self) -> None:
        if self.curve_episodes > self.report_episodes:
            raise ValueError(
                f"curve_episodes are the first of the {self.report_episodes} report episodes: "
                f"{self.curve_episodes} are too many."
            )

    def episodes(self, split: Split) -> int:
        """Return how many episodes per task `split` has."""
        return self.report_episodes if split == "report" else self.selection_episodes

    @property
    def evaluation_steps(self) -> tuple[int, ...]:
        """After how many optimiser steps of a stage the policy is evaluated; the last is its end.

        Each point lies at half the steps of the next: a policy learns and forgets most at the beginning.
        """
        points = (self.adaptation_steps >> halvings for halvings in range(self.evaluation_points))
        return tuple(sorted({point for point in points if point}))


@dataclass(frozen=True)
class Scenario:
    """A named, versioned sequence of tasks with its budget: skills to keep, then tasks to learn in order."""

    id: str
    """Gymnasium id, as "clbench/Fetch-v0"."""
    description: str
    """One sentence for lists."""
    retained: tuple[Task, ...]
    """Skills that the policy is pretrained on and that are never trained again."""
    target: tuple[Task, ...]
    """Tasks that are learned, in this order."""
    held_out: tuple[Task, ...]
    """Tasks that are never trained."""
    questions: str
    """Entry point of a tuple of `QuestionKind`: what can be asked about a state."""
    budget: Budget = Budget()
    """What every method gets."""
    limits: Limits = field(default_factory=Limits)
    """What the process of a submitted run may take."""

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks: retained, then target, then held out. Columns of every score table follow this order."""
        return self.retained + self.target + self.held_out

    def group(self, task: str) -> Group:
        """Return which part of the scenario the task belongs to."""
        for group in ("retained", "target", "held_out"):
            if any(task == member.name for member in getattr(self, group)):
                return group
        raise self._unknown(task)

    def task(self, name: str) -> Task:
        """Return the task called `name`.

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        for task in self.tasks:
            if task.name == name:
                return task
        raise self._unknown(name)

    def _unknown(self, name: str) -> LookupError:
        return unknown(f"task of {self.id}", name, (task.name for task in self.tasks))


def scenario_ids() -> list[str]:
    """Return the Gymnasium ids of all registered scenarios, sorted."""
    import gymnasium

    return sorted(name for name, spec in gymnasium.registry.items() if "scenario" in (spec.kwargs or {}))


def load_scenario(scenario_id: str) -> Scenario:
    """Return the scenario registered with Gymnasium under this id; "module:id" imports `module` first.

    Raises:
        LookupError: Nothing is registered under this id, or what is registered is no scenario.
    """
    import gymnasium

    module, _, name = scenario_id.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise LookupError(f"No module {error.name!r} can be imported for {scenario_id!r}.") from error
    if name not in gymnasium.registry or "scenario" not in (gymnasium.registry[name].kwargs or {}):
        raise unknown("scenario", name, scenario_ids())
    scenario = resolve(gymnasium.registry[name].kwargs["scenario"])
    assert isinstance(scenario, Scenario)
    return scenario
