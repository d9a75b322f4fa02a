"""Tasks: one thing to do in one simulated world, as data."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from clbench.base.errors import InputError
from clbench.base.source import package_of
from clbench.base.text import html_table, quoted
from clbench.spec.fields import check_entry_point, check_share, check_tuple, check_whole
from clbench.spec.protocol import Split

_NAME = re.compile(r"\w[\w-]*", re.ASCII)
"""What Minari and Gymnasium allow in a part of an id."""


@dataclass(frozen=True)
class Task:
    """One thing to do in one simulated world."""

    name: str
    """Name inside its suite, such as "push"."""
    suite: str
    """Family of worlds that it belongs to, such as "fetch"."""
    instructions: tuple[str, ...]
    """Instruction in words: the canonical wording, then its paraphrases, from which training draws."""
    horizon: int
    """Length in steps after which an episode ends without success."""
    world: str
    """Entry point "module:callable" that makes the Gymnasium environment. One environment serves every task
    of its world: `reset(options={"task": name})` chooses the task. The observation is the state, a float32
    vector; `terminated` means success, and `info["success"]` repeats it."""
    expert: str
    """Entry point of a callable that takes the task's name and returns a callable (S,) -> (A,): the expert's
    action in a state. It must not remember earlier states: it also labels noisy demonstrations."""
    camera: str | None = None
    """Entry point of the `clbench.worlds.camera.Camera` through which a policy sees the world, for states
    that hold more than a policy may know. With None the policy sees the states."""
    version: int = 0
    """Version, raised whenever the task, its expert or its demonstrations change."""
    action_noise: float = 0.1
    """Probability, at each step of a noisy demonstration, that 3 to 6 random actions begin."""
    packages: tuple[str, ...] = ()
    """Distributions whose version can change a trajectory, besides those common to all worlds: the simulator
    of the suite, such as ("gymnasium-robotics",)."""
    test_instructions: tuple[str, ...] = ()
    """Wordings for test episodes, which training never shows. If empty, test episodes use `instructions`."""
    seed_name: str | None = None
    """Spelling of the suite in seeds and dataset ids, where it differs from `suite`. It may never change, or
    demonstrations and measurements would change with it."""

    def __post_init__(self) -> None:
        for field, value in (("name", self.name), ("suite", self.suite), ("seed_name", self.seed_suite)):
            if not isinstance(value, str) or not _NAME.fullmatch(value):
                raise InputError(
                    f"{quoted(str(value))} cannot be the {field} of a task: letters, digits, _ and - only."
                )
        check_tuple(self, str, "instructions", "test_instructions", "packages")
        if not self.instructions or not all(
            words.strip() for words in self.instructions + self.test_instructions
        ):
            raise InputError(
                f"The task {self.name} needs at least one instruction, and no instruction may be empty."
            )
        check_whole(self, 1, "horizon")
        check_whole(self, 0, "version")
        check_share(self, "action_noise")
        check_entry_point(self, "world", "expert", *(("camera",) if self.camera is not None else ()))

    def __repr__(self) -> str:
        return f"<Task {self.suite}/{self.name}: {self.instructions[0]}>"

    def _repr_html_(self) -> str:
        """Return what defines the task as a table, for notebooks."""
        names = ("instructions", "test_instructions", "horizon", "world", "expert", "camera", "version")
        rows = [(name.replace("_", " "), getattr(self, name)) for name in names]
        title = f"Task {self.name} of the suite {self.suite}"
        return html_table(title, ("field", "value"), [row for row in rows if row[1] not in (None, ())])

    def wordings(self, split: Split) -> tuple[str, ...]:
        """Return the wordings of the instruction that the episodes of a split use in turn."""
        return (split != "validation" and self.test_instructions) or self.instructions

    @property
    def seed_suite(self) -> str:
        """Spelling of the suite in seeds and dataset ids."""
        return self.seed_name or self.suite

    @property
    def dataset_id(self) -> str:
        """Id of the Minari dataset that holds the demonstrations."""
        return f"clbench/{self.seed_suite}/{self.name.replace('_', '-')}-v{self.version}"

    @property
    def environment_id(self) -> str:
        """Id of the environment in the task's dataset, and in its exports."""
        return f"clbench/{self.suite}.{self.name}-v{self.version}"


def packages_of(tasks: Iterable[Task], *parts: str) -> list[str]:
    """Return the packages of some parts of the tasks, such as "world", "expert" and "camera", sorted."""
    entry_points = (getattr(task, part) for task in tasks for part in parts)
    return sorted({package_of(entry_point) for entry_point in entry_points if entry_point is not None})
