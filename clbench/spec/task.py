"""Tasks, scenarios and budgets: what there is to learn, as data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from clbench.base.errors import InputError, WrongTypeError
from clbench.base.source import package_of


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
    """Entry point of the `clbench.worlds.camera.Camera` that a policy sees the world through, as the states hold
    more than it may know; if None, it is shown the states."""
    version: int = 0
    """Raised whenever the task, its expert or its demonstrations change."""
    action_noise: float = 0.1
    """Chance, at each step of a noisy demonstration, that 3 to 6 random actions begin."""
    packages: tuple[str, ...] = ()
    """Distributions whose version can change a trajectory, beside those that all worlds have in common: the
    simulator of its suite, as ("gymnasium-robotics",)."""

    def __post_init__(self) -> None:
        from clbench.spec.identifiers import check_plain  # it knows the scenarios

        check_plain("task", self.name)
        if isinstance(self.instructions, str):
            raise WrongTypeError(
                f"instructions of the task {self.name} must be a tuple of texts, not one text."
            )
        if not self.instructions or not all(words.strip() for words in self.instructions):
            raise InputError(f"The task {self.name} needs an instruction, and none of them may be empty.")
        if self.horizon < 1:
            raise InputError(f"horizon of the task {self.name} must be at least 1 step, not {self.horizon}.")

    @property
    def dataset_id(self) -> str:
        """Id of the Minari dataset that holds the demonstrations."""
        return f"clbench/{self.suite}/{self.name.replace('_', '-')}-v{self.version}"


def packages_of(tasks: Iterable[Task], *parts: str) -> list[str]:
    """Return the packages that parts of the tasks lie in, as "world", "expert" and "camera", in order."""
    entry_points = (getattr(task, part) for task in tasks for part in parts)
    return sorted({package_of(entry_point) for entry_point in entry_points if entry_point is not None})
