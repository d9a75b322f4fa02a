"""Scenarios: a sequence of tasks with its budget, as data."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, get_args

from clbench.base.dependencies import require_packages
from clbench.base.entry_points import resolve, unknown
from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.base.text import html_table, quoted
from clbench.spec.budget import Budget
from clbench.spec.fields import check_entry_point, check_tuple, is_whole
from clbench.spec.limits import Limits
from clbench.spec.policies import DEFAULT_POLICY, check_policy_name
from clbench.spec.task import Task

Group = Literal["retained", "target", "held_out"]
"""Part of a scenario that is scored."""

Part = Literal[Group, "background"]
"""Part of a scenario."""

MOST_ORDERS = 99
"""Largest number of orders besides the published one: a number in a stranger's record must not keep a reader
busy."""


@dataclass(frozen=True, repr=False)
class Scenario:
    """A named, versioned sequence of tasks with its budget: skills to keep, then tasks to learn in order."""

    id: str
    """Gymnasium id, such as "clbench/Fetch-v1"."""
    description: str
    """Description for lists, in one sentence."""
    retained: tuple[Task, ...]
    """Skills that the policy is pretrained on and that no stage trains again; there may be none."""
    target: tuple[Task, ...]
    """Tasks to learn, in their published order."""
    held_out: tuple[Task, ...]
    """Tasks that are never trained."""
    questions: str
    """Entry point of a tuple of `QuestionKind`, the questions about a state."""
    background: tuple[Task, ...] = ()
    """Tasks that the policy is pretrained on besides the skills, just as a large model is pretrained on more
    than a benchmark measures. No score counts them, and no method gets their demonstrations."""
    scenes: tuple[Task, ...] = ()
    """Tasks whose expert episodes give the states for the questions. If empty, the retained tasks do."""
    balanced: bool = False
    """Whether each seed learns the targets in its own order, see `balanced_order`, so that every target is
    learned in every position. If not, all seeds have the published order."""
    budget: Budget = field(default_factory=Budget)
    """Data, steps and evaluation episodes that every method gets."""
    limits: Limits = field(default_factory=Limits)
    """Limits of the process of a submitted run."""
    policy: str = DEFAULT_POLICY
    """Name of the policy that is pretrained and fine-tuned, see `clbench.spec.policies`."""

    def __post_init__(self) -> None:
        check_tuple(self, Task, "retained", "target", "held_out", "background", "scenes")
        for name, kind in (("budget", Budget), ("limits", Limits)):
            if not isinstance(getattr(self, name), kind):
                value = quoted(repr(getattr(self, name)))
                raise WrongTypeError(f"{name} of {self.id} must be a {kind.__name__}, not {value}.")
        names = [task.name for task in self.tasks + self.background]
        known: dict[str, str] = {}
        for name in names:
            other = known.setdefault(name.replace("_", "-"), name)  # as in ids of datasets
            if names.count(name) > 1:
                raise InputError(f"{self.id}: two tasks are called {name!r}.")
            if other != name:
                raise InputError(f"{self.id}: tasks cannot be called {other!r} and {name!r}: _ counts as -.")
        check_entry_point(self, "questions")
        check_policy_name(self.policy)
        if not self.retained + self.target:
            raise InputError(
                f"{self.id}: a scenario needs retained or target tasks; held-out tasks and scenes alone make "
                "no stage."
            )
        if not self.scene_tasks:
            raise InputError(
                f"{self.id}: a scenario without retained tasks needs scenes (tasks that give the states for "
                "its questions), for example scenes=target."
            )
        cameras = {task.camera or "none" for task in self.tasks + self.background + self.scenes}
        if len(cameras) > 1:
            raise InputError(f"{self.id}: all tasks must have the same camera, not {sorted(cameras)}.")

    def __repr__(self) -> str:
        groups = {"retained": self.retained, "targets": self.target, "held out": self.held_out}
        names = "; ".join(
            f"{name} {', '.join(task.name for task in group)}" for name, group in groups.items() if group
        )
        return f"<Scenario {self.id}: {names}>"

    def _repr_html_(self) -> str:
        """Return the tasks with their groups as a table, for notebooks."""
        groups: tuple[Group, ...] = get_args(Group)
        rows = [
            (group.replace("_", " "), task.name, task.instructions[0], task.horizon)
            for group in groups
            for task in getattr(self, group)
        ]
        title = f"{self.id}: {self.description}"
        return html_table(title, ("group", "task", "instruction", "horizon in steps"), rows)

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks: retained, then target, then held out. Columns of every score table follow this order."""
        return self.retained + self.target + self.held_out

    @property
    def pretrained(self) -> tuple[Task, ...]:
        """Tasks that the policy is pretrained on: the retained skills, then the background."""
        return self.retained + self.background

    @property
    def scene_tasks(self) -> tuple[Task, ...]:
        """Tasks whose expert episodes give the states for the questions."""
        return self.scenes or self.retained

    @property
    def text_length(self) -> int:
        """Length in tokens of every text that the policy reads: the shortest one that all texts fit."""
        # imports the tokenizer and the questions, which a scenario that is only named does without
        from clbench.spec.language import fitting_length

        tasks = self.tasks + self.background
        instructions = [text for task in tasks for text in task.instructions + task.test_instructions]
        questions = [text for kind in resolve(self.questions) for text in kind.wordings]
        return fitting_length((*instructions, *questions))

    def require_packages(self) -> None:
        """Check that the packages of its tasks, background and scenes are installed.

        Raises:
            MissingPackageError: A package is not installed; the message says how to get it.
        """
        every = self.tasks + self.background + self.scenes
        require_packages({package for task in every for package in task.packages}, self.id)

    def in_order(self, order: int) -> Scenario:
        """Return the scenario with its targets in an order of `target_order`; 0 is the published order.

        All else stays the same: pretrained policy, demonstrations, questions and initial states of episodes.

        Raises:
            InputError: There is no such order.
        """
        if order and self.balanced:
            raise InputError(
                f"{self.id} has no order {order}: each seed learns the targets in its own order. "
                "Leave out --order (order= in Python)."
            )
        try:
            places = target_order(len(self.target), order)
        except InputError as error:
            raise InputError(f"{self.id}: {error}") from error
        return replace(self, target=tuple(self.target[place] for place in places)) if order else self

    def with_policy(self, name: str) -> Scenario:
        """Return the scenario with another policy; all else stays the same.

        Raises:
            UnknownNameError: There is no such policy.
        """
        return self if name == self.policy else replace(self, policy=name)

    def for_seed(self, seed: int) -> Scenario:
        """Return the scenario with its targets in the order in which runs of `seed` learn them."""
        if not self.balanced:
            return self
        places = balanced_order(len(self.target), seed)
        return replace(self, target=tuple(self.target[place] for place in places))

    def group(self, task: str) -> Part:
        """Return the part of the scenario that the task called `task` belongs to.

        Raises:
            UnknownNameError: No task has this name; the nearest one is named.
        """
        parts: tuple[Part, ...] = get_args(Part)
        for part in parts:
            if any(task == member.name for member in getattr(self, part)):
                return part
        raise self._unknown(task)

    def task(self, name: str) -> Task:
        """Return the task called `name`.

        Raises:
            UnknownNameError: No task has this name; the nearest one is named.
        """
        for task in self.tasks + self.background:
            if task.name == name:
                return task
        raise self._unknown(name)

    def _unknown(self, name: str) -> UnknownNameError:
        return unknown(f"task of {self.id}", name, (task.name for task in self.tasks + self.background))


def balanced_order(count: int, seed: int) -> tuple[int, ...]:
    """Return, for each stage, the published place, from 0, of the target that a seed learns in it.

    Seeds 0 to `count` - 1 are the rows of a Latin square: together they learn every target once in every
    stage. So are the next `count` seeds, and so on. If `count` is even, each square is also balanced for what
    comes before: every target directly follows every other one once (Williams 1949, doi 10.1071/CH9490149).
    Seed 0 has the published order.

    Args:
        count: Number of targets.
        seed: Seed of the run.
    """
    square, row = divmod(seed, max(count, 1))
    steps = [(place + 1) // 2 * (-1) ** (place + 1) % max(count, 1) for place in range(count)]
    names = {step: place for place, step in enumerate(steps)}  # row 0 of the first square counts up
    places = [names[(step + row) % count] for step in steps]
    generator = random.Random(square)  # random() is the only draw that Python promises never to change
    draws = [generator.random() for _ in range(count)] if square else list(range(count))
    relabelled = sorted(range(count), key=draws.__getitem__)
    return tuple(relabelled[place] for place in places)


def target_order(count: int, order: int) -> tuple[int, ...]:
    """Return, for each stage, the published place, from 0, of the target that it learns.

    Order 0 is the published order. Later orders are distinct permutations, drawn at random once and for all.

    Args:
        count: Number of targets.
        order: Number of the order.

    Raises:
        InputError: There is no such order.
    """
    # a stranger's long list of targets has a factorial of millions of digits; the factorial of 5 is enough
    last = min(math.factorial(min(count, 5)) - 1, MOST_ORDERS)
    if not is_whole(order) or not 0 <= order <= last:
        orders = f"orders 0 to {last}" if last else "order 0 alone"
        raise InputError(f"{count} targets have {orders}, not {order!r}.")
    generator = random.Random(0)  # the only generator whose random() Python promises never to change
    found = {tuple(range(count)): None}
    while len(found) <= order:
        draws = [generator.random() for _ in range(count)]
        found[tuple(sorted(range(count), key=draws.__getitem__))] = None
    return list(found)[order]
