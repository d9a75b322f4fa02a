"""The schedule: it chooses the next episode of a scenario."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError
from gymnasium.vector.utils import create_shared_memory

from clbench.base.errors import InputError
from clbench.spec.fields import is_whole, whole_number
from clbench.spec.language import VOCABULARY_SIZE, word_ids
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

InstructionFormat = Literal["text", "tokens"]


class InstructionSpace(spaces.Text):
    """Space of instructions as text, which equals Gymnasium's own, but is refused in shared memory.

    `AsyncVectorEnv` reads texts from shared memory only once, before the first episode, and would show blank
    instructions from then on.
    """


@create_shared_memory.register
def _refuse_shared_memory(space: InstructionSpace, n: int = 1, ctx: Any = None) -> NoReturn:
    raise CustomSpaceError(
        "Gymnasium cannot show instructions as text from shared memory. Give AsyncVectorEnv "
        'shared_memory=False (make_vec: vector_kwargs={"shared_memory": False}), or give the environment '
        'instruction="tokens".'
    )


@dataclass(frozen=True)
class Start:
    """Start of an episode."""

    task: Task
    stage: int
    """Stage that trains the task; 0 for tasks that no stage trains."""
    instruction: str
    """One of the task's wordings."""
    observed_instruction: Any
    """The same wording in the form of the observation: text, or word ids (L,)."""
    seed: int
    """Seed for the world's `reset`."""

    def info(self, success: bool) -> dict[str, Any]:
        """Return the info dictionary of `step` and `reset`."""
        return {
            "task": self.task.name,
            "stage": self.stage,
            "instruction": self.instruction,
            "success": success,
        }


class Schedule:
    """Sequence of episodes of one environment through the stages of a scenario, see `ScenarioEnv`.

    Args:
        scenario: Scenario with its tasks.
        episodes_per_stage: Episodes after which the next stage begins.
        instruction: Form of the instruction in observations, "text" or "tokens".
        stage: Stage that it never leaves; None goes through all stages.
        task: Name of the only task of its episodes; None goes through the tasks of the stages.
    """

    def __init__(
        self,
        scenario: Scenario,
        episodes_per_stage: int,
        instruction: InstructionFormat,
        stage: int | None = None,
        task: str | None = None,
    ) -> None:
        if instruction not in ("text", "tokens"):
            raise InputError(f'instruction must be "text" or "tokens", not {instruction!r}.')
        self._scenario, self._format = scenario, instruction
        self._episodes_per_stage = whole_number("episodes_per_stage", episodes_per_stage, 1)
        self.stage: int | None = None
        """Stage that it never leaves."""
        self._task: str | None = None
        self._episode, self._first = -1, 0 if scenario.retained else 1
        if stage is not None and task is not None:
            raise InputError("Give stage or task, not both: a task determines its stage.")
        if stage is not None:
            self.stage = self._checked_stage(stage)
        if task is not None:
            self._task = self._checked_task(task).name

    @property
    def instruction_space(self) -> spaces.Space[Any]:
        """Space of the instruction in observations."""
        if self._format == "tokens":
            return spaces.Box(0, VOCABULARY_SIZE - 1, (self._scenario.text_length,), np.int64)
        tasks = (*self._scenario.tasks, *self._scenario.background)
        texts = [words for task in tasks for words in task.instructions + task.test_instructions]
        characters = {*string.ascii_lowercase, " ", *"".join(texts)}
        return InstructionSpace(max_length=max(map(len, texts)), charset="".join(sorted(characters)))

    def begin(self) -> None:
        """Go back to the first episode."""
        self._episode = -1

    def check(self, options: Mapping[str, Any]) -> None:
        """Refuse options that choose no episode, before anything changes.

        Raises:
            UnknownNameError: The scenario has no such task.
            InputError: The scenario has no such stage, or an option is unknown.
        """
        unknown = [name for name in options if name not in ("task", "stage")]
        if unknown:
            raise InputError(f'Options of reset are "task" and "stage", not {unknown}.')
        if "task" in options and "stage" in options:
            raise InputError('Options of reset are "task" or "stage", not both: a task determines its stage.')
        if "stage" in options:
            self._checked_stage(options["stage"])
        if "task" in options:
            self._checked_task(options["task"])

    def next(self, generator: np.random.Generator, options: Mapping[str, Any]) -> Start:
        """Return the start of the next episode, or of the episode that checked `options` choose."""
        task, stage = self._choose(options)
        words = task.instructions[int(generator.integers(len(task.instructions)))]
        shown = shown_instruction(words, self._format, self._scenario)
        return Start(task, stage, words, shown, int(generator.integers(2**31)))

    def _choose(self, options: Mapping[str, Any]) -> tuple[Task, int]:
        """Return the task and the stage of the next episode."""
        scenario = self._scenario
        if "stage" in options:
            self._episode = (self._checked_stage(options["stage"]) - self._first) * self._episodes_per_stage
        elif "task" in options or self._task is not None:
            task = self._checked_task(options.get("task", self._task))
            return task, scenario.target.index(task) + 1 if task in scenario.target else 0
        else:
            self._episode += 1
        stage = min(self._first + self._episode // self._episodes_per_stage, len(scenario.target))
        stage = stage if self.stage is None else self.stage
        retained = scenario.retained
        return scenario.target[stage - 1] if stage else retained[self._episode % len(retained)], stage

    def _checked_task(self, name: Any) -> Task:
        if not isinstance(name, str):
            raise InputError(f'The option "task" must be a name, not {name!r}.')
        return self._scenario.task(name)

    def _checked_stage(self, stage: Any) -> int:
        """Return a stage as a Python int: small ones of NumPy overflow when they are multiplied.

        Raises:
            InputError: The scenario does not have the stage, or this schedule never reaches it.
        """
        last = len(self._scenario.target)
        if not is_whole(stage) or stage not in range(self._first, last + 1):
            raise InputError(f"{self._scenario.id} has stages {self._first} to {last}, not {stage!r}.")
        if self.stage not in (None, stage) or self._task is not None:
            home = f"in stage {self.stage}" if self._task is None else f"with the task {self._task!r}"
            raise InputError(f"This environment stays {home}: make another for stage {stage}.")
        return int(stage)


def shown_instruction(words: str, form: InstructionFormat, scenario: Scenario) -> Any:
    """Return an instruction in the form of observations: text, or the ids (L,) of its tokens."""
    return np.array(word_ids([words], scenario.text_length)[0]) if form == "tokens" else words
