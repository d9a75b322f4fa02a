"""Tasks, scenarios and budgets: what there is to learn, as data."""

from __future__ import annotations

import difflib
import importlib
import math
import random
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

from clbench.extras import require_packages
from clbench.limits import Limits

Group = Literal["retained", "target", "held_out"]
Split = Literal["selection", "report", "perturbed"]
"""What episodes are for. The perturbed ones are those of the report in disturbed worlds, see
`clbench.perturbation`."""

SPLITS: tuple[Split, ...] = ("selection", "report", "perturbed")

MOST_ORDERS = 99
"""Orders of the targets besides the published one, where there are as many: a number in a stranger's record
must not keep a reader busy."""


def resolve(name: str) -> Any:
    """Return the object that `name`, "module:attribute", names.

    Raises:
        LookupError: There is no such module, or it has no such attribute; the nearest one is named.
    """
    module, _, attribute = name.partition(":")
    found = import_module(module, name)
    if not hasattr(found, attribute):
        near = difflib.get_close_matches(attribute, dir(found), n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise LookupError(f"No entry point {name!r}: module {module!r} has no {attribute!r}.{hint}")
    return getattr(found, attribute)


def import_module(module: str, needed_for: str) -> Any:
    """Return a module.

    Raises:
        LookupError: It, or one that it imports, is not there.
    """
    try:
        return importlib.import_module(module)
    except (ModuleNotFoundError, ValueError) as error:  # ValueError: the name is empty
        missing = getattr(error, "name", None) or module
        raise LookupError(f"No module {missing!r} can be imported for {needed_for!r}.") from error


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
    disturbance: float = 0.1
    """Chance, at each step of a disturbed demonstration, that a disturbance of 3 to 6 steps begins."""
    packages: tuple[str, ...] = ()
    """Distributions whose version can change a trajectory, beside those that all worlds have in common: the
    simulator of its suite, as ("gymnasium-robotics",)."""

    def __post_init__(self) -> None:
        from clbench.names import check_plain  # it knows the scenarios

        check_plain("task", self.name)
        if isinstance(self.instructions, str):
            raise TypeError(f"instructions of the task {self.name} must be a tuple of texts, not one text.")
        if not self.instructions or not all(words.strip() for words in self.instructions):
            raise ValueError(f"The task {self.name} needs an instruction, and none of them may be empty.")
        if self.horizon < 1:
            raise ValueError(f"horizon of the task {self.name} must be at least 1 step, not {self.horizon}.")

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
        return self.selection_episodes if split == "selection" else self.report_episodes

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
    """Skills that the policy is pretrained on and that are never trained again; there may be none."""
    target: tuple[Task, ...]
    """Tasks that are learned, in this order."""
    held_out: tuple[Task, ...]
    """Tasks that are never trained."""
    questions: str
    """Entry point of a tuple of `QuestionKind`: what can be asked about a state."""
    scenes: tuple[Task, ...] = ()
    """Tasks whose expert episodes' states the questions ask about, where these are not the retained ones."""
    budget: Budget = Budget()
    """What every method gets."""
    limits: Limits = field(default_factory=Limits)
    """What the process of a submitted run may take."""

    def __post_init__(self) -> None:
        names = [task.name for task in self.tasks]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{self.id}: two tasks are called {name!r}.")
        cameras = {task.camera or "none" for task in self.tasks + self.scenes}
        if len(cameras) > 1:
            raise ValueError(f"{self.id}: all tasks must have the same camera, not {sorted(cameras)}.")

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks: retained, then target, then held out. Columns of every score table follow this order."""
        return self.retained + self.target + self.held_out

    @property
    def scene_tasks(self) -> tuple[Task, ...]:
        """The tasks whose expert episodes' states the questions ask about."""
        return self.scenes or self.retained

    def require_packages(self) -> None:
        """Refuse to go on without the packages of its tasks.

        Raises:
            LookupError: One is not installed; the message says how to get it.
        """
        require_packages({package for task in self.tasks for package in task.packages}, self.id)

    def in_order(self, order: int) -> Scenario:
        """Return the scenario with its targets in another order, see `target_order`; 0 is the published one.

        All else is the same: pretrained policy, demonstrations, questions and the episodes' initial states.

        Raises:
            ValueError: There is no such order.
        """
        try:
            places = target_order(len(self.target), order)
        except ValueError as error:
            raise ValueError(f"{self.id}: {error}") from error
        return replace(self, target=tuple(self.target[place] for place in places)) if order else self

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


def target_order(count: int, order: int) -> tuple[int, ...]:
    """Return which of `count` targets, by their published places from 0, is learned in each stage.

    Order 0 is the published one. The others are different permutations, drawn at random once and for all.

    Raises:
        ValueError: There is no such order.
    """
    # the factorial of a stranger's list of targets may have millions of digits; that of 5 exceeds the limit
    last = min(math.factorial(min(count, 5)) - 1, MOST_ORDERS)
    if not 0 <= order <= last:
        orders = f"orders 0 to {last}" if last else "order 0 alone"
        raise ValueError(f"{count} targets have {orders}, not {order}.")
    generator = random.Random(0)  # of all generators, its random() is the one that may never change
    found = {tuple(range(count)): None}
    while len(found) <= order:
        draws = [generator.random() for _ in range(count)]
        found[tuple(sorted(range(count), key=draws.__getitem__))] = None
    return list(found)[order]


def scenario_ids() -> list[str]:
    """Return the Gymnasium ids of all registered scenarios, sorted."""
    import gymnasium

    return sorted(name for name, spec in gymnasium.registry.items() if "scenario" in (spec.kwargs or {}))


def load_scenario(scenario_id: str) -> Scenario:
    """Return the scenario registered with Gymnasium under this id, ready to be used.

    Raises:
        LookupError: Nothing is registered under this id, what is registered is no scenario, or a package that
            its tasks need is not installed; the message says how to get it.
    """
    scenario = registered_scenario(scenario_id)
    scenario.require_packages()
    return scenario


def registered_scenario(scenario_id: str) -> Scenario:
    """Return the scenario registered with Gymnasium under this id, as data: its packages may be missing.

    Args:
        scenario_id: Gymnasium id; "module:id" imports `module` first.

    Raises:
        LookupError: Nothing is registered under this id, or what is registered is no scenario.
    """
    import gymnasium

    module, _, name = scenario_id.rpartition(":")
    if module:
        import_module(module, scenario_id)
    if name not in gymnasium.registry or "scenario" not in (gymnasium.registry[name].kwargs or {}):
        raise unknown("scenario", name, scenario_ids())
    entry_point = gymnasium.registry[name].kwargs["scenario"]
    scenario = scenario_at(entry_point)
    if scenario.id != name:
        raise LookupError(f"{entry_point!r} is registered as {name!r}, but its id is {scenario.id!r}.")
    return scenario


def opened_scenario(scenario: Scenario | str, order: int = 0) -> Scenario:
    """Return a scenario, or the one at an entry point, in an order of its targets and ready to be used.

    Raises:
        LookupError: There is none, or a package that its tasks need is not installed.
        ValueError: There is no such order, or a word of the instructions is not in the vocabulary.
    """
    published = scenario_at(scenario) if isinstance(scenario, str) else scenario
    published.require_packages()
    return published.in_order(order)


def scenario_at(entry_point: str) -> Scenario:
    """Return the scenario at "module:attribute".

    Raises:
        LookupError: There is none.
        ValueError: A word of its instructions is not in the vocabulary.
    """
    from clbench.policy.language import word_ids

    scenario = resolve(entry_point)
    if not isinstance(scenario, Scenario):
        raise LookupError(f"{entry_point!r} is no Scenario but a {type(scenario).__name__}.")
    for task in scenario.tasks:
        word_ids(task.instructions)
    return scenario
