"""The walk: which episode of a scenario comes next."""

from __future__ import annotations

import string
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from clbench.policy import TEXT_LENGTH, VOCABULARY_SIZE, encode
from clbench.task import Scenario, Task

InstructionFormat = Literal["text", "tokens"]


@dataclass(frozen=True)
class Start:
    """How an episode begins."""

    task: Task
    stage: int
    """The stage that trains the task; 0 for retained and held-out tasks."""
    instruction: str
    """One of the task's wordings."""
    observed_instruction: Any
    """The same as the observation gives it: text, or word ids (L,)."""
    seed: int
    """Of the world."""

    def info(self, success: bool) -> dict[str, Any]:
        """Return what `step` and `reset` tell besides."""
        return {
            "task": self.task.name,
            "stage": self.stage,
            "instruction": self.instruction,
            "success": success,
        }


class Walk:
    """The way of one environment through the stages of a scenario, as `ScenarioEnv` tells.

    Args:
        scenario: The sequence.
        episodes_per_stage: Episodes after which the next stage begins.
        instruction: How observations give the instruction.
    """

    def __init__(self, scenario: Scenario, episodes_per_stage: int, instruction: InstructionFormat) -> None:
        if instruction not in ("text", "tokens"):
            raise ValueError(f'instruction must be "text" or "tokens", not {instruction!r}.')
        if episodes_per_stage < 1:
            raise ValueError(f"episodes_per_stage must be at least 1, not {episodes_per_stage}.")
        self._scenario, self._episodes_per_stage, self._format = scenario, episodes_per_stage, instruction
        self._episode = -1

    @property
    def instruction_space(self) -> spaces.Space[Any]:
        """Of the observation's instruction."""
        if self._format == "tokens":
            return spaces.Box(0, VOCABULARY_SIZE - 1, (TEXT_LENGTH,), np.int64)
        longest = max(len(words) for task in self._scenario.tasks for words in task.instructions)
        return spaces.Text(max_length=longest, charset=string.ascii_lowercase + " ")

    def begin(self) -> None:
        """Go back to the first episode."""
        self._episode = -1

    def next(self, generator: np.random.Generator, options: Mapping[str, Any]) -> Start:
        """Return the next episode, or the one that `options` choose.

        Raises:
            LookupError: The scenario has no such task.
            ValueError: It has no such stage, or an option is unknown.
        """
        if set(options) - {"task", "stage"}:
            raise ValueError(f'Options of reset are "task" and "stage", not {sorted(options)}.')
        task, stage = self._choose(options)
        words = task.instructions[int(generator.integers(len(task.instructions)))]
        observed = encode([words])[0].numpy() if self._format == "tokens" else words
        return Start(task, stage, words, observed, int(generator.integers(2**31)))

    def _choose(self, options: Mapping[str, Any]) -> tuple[Task, int]:
        """Return task and stage of the next episode."""
        scenario, stages = self._scenario, len(self._scenario.target)
        first = 0 if scenario.retained else 1
        if "task" in options:
            task = scenario.task(options["task"])
            return task, scenario.target.index(task) + 1 if task in scenario.target else 0
        if "stage" in options:
            if options["stage"] not in range(first, stages + 1):
                raise ValueError(f"{scenario.id} has stages {first} to {stages}, not {options['stage']!r}.")
            self._episode = (options["stage"] - first) * self._episodes_per_stage
        else:
            self._episode += 1
        stage = min(first + self._episode // self._episodes_per_stage, stages)
        retained = scenario.retained
        return scenario.target[stage - 1] if stage else retained[self._episode % len(retained)], stage
