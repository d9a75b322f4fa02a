"""The Gymnasium environment of a scenario: it walks through the sequence of tasks."""

from __future__ import annotations

import string
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.demonstrations import World
from clbench.policy import TEXT_LENGTH, VOCABULARY_SIZE, encode
from clbench.task import Scenario, Task, resolve

Observation = dict[str, Any]


class ScenarioEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A sequence of tasks as one environment.

    `reset()` begins the next episode of the walk: `episodes_per_stage` episodes of stage 0, in which the
    retained tasks take turns, then as many of each target task; the last target goes on for ever.
    `reset(seed=...)` begins the walk anew. `reset(options={"stage": k})` goes on from the start of a stage,
    and `reset(options={"task": name})` chooses any task for one episode.

    Observation: a dictionary of `state`, float32 (S,), as the task's world gives it, and `instruction`, text,
    or with `instruction="tokens"` the word ids, int64 (L,), for agents that want numbers.
    Reward: the task's dense reward. An episode is terminated by success and truncated at the task's horizon.
    Info: `task`, `stage`, `instruction`, `success`.

    Args:
        scenario: The sequence, or its entry point "module:attribute".
        instruction: How the observation gives the instruction.
        episodes_per_stage: Episodes after which `reset()` goes on to the next stage.
        render_mode: "rgb_array" or None; handed to the worlds.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str,
        instruction: Literal["text", "tokens"] = "text",
        episodes_per_stage: int = 100,
        render_mode: str | None = None,
    ) -> None:
        if instruction not in ("text", "tokens"):
            raise ValueError(f'instruction must be "text" or "tokens", not {instruction!r}.')
        if episodes_per_stage < 1:
            raise ValueError(f"episodes_per_stage must be at least 1, not {episodes_per_stage}.")
        self.scenario: Scenario = resolve(scenario) if isinstance(scenario, str) else scenario
        self.render_mode = render_mode
        self._instruction_format = instruction
        self._episodes_per_stage = episodes_per_stage
        self._worlds: dict[str, World] = {}
        self._episode = -1
        self._task = self.scenario.retained[0]
        self._stage = 0
        self._steps = 0
        self._words = ""
        world = self._world
        self.action_space = world.action_space
        self.observation_space = spaces.Dict(
            {"state": world.observation_space, "instruction": self._instruction_space()}
        )

    def _instruction_space(self) -> spaces.Space[Any]:
        if self._instruction_format == "tokens":
            return spaces.Box(0, VOCABULARY_SIZE - 1, (TEXT_LENGTH,), np.int64)
        longest = max(len(words) for task in self.scenario.tasks for words in task.instructions)
        return spaces.Text(max_length=longest, charset=string.ascii_lowercase + " ")

    @property
    def _world(self) -> World:
        """The world of the current task; each is made when first needed."""
        entry_point = self._task.world
        if entry_point not in self._worlds:
            self._worlds[entry_point] = resolve(entry_point)(render_mode=self.render_mode)
        return self._worlds[entry_point]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; see the class for what `seed` and `options` choose.

        Raises:
            LookupError: The scenario has no such task.
            ValueError: It has no such stage, or an option is unknown.
        """
        super().reset(seed=seed)
        options = options or {}
        if set(options) - {"task", "stage"}:
            raise ValueError(f'Options of reset are "task" and "stage", not {sorted(options)}.')
        if seed is not None:
            self._episode = -1
        self._choose(options)
        self._steps = 0
        wording = int(self.np_random.integers(len(self._task.instructions)))
        self._words = self._task.instructions[wording]
        world_seed = int(self.np_random.integers(2**31))
        state, _ = self._world.reset(seed=world_seed, options={"task": self._task.name})
        return self._observation(state), self._info(False)

    def _choose(self, options: dict[str, Any]) -> None:
        """Set task and stage for the next episode."""
        stages = len(self.scenario.target)
        if "task" in options:
            self._task = self.scenario.task(options["task"])
            self._stage = self._stage_of(self._task)
            return
        if "stage" in options:
            if options["stage"] not in range(stages + 1):
                raise ValueError(f"{self.scenario.id} has stages 0 to {stages}, not {options['stage']!r}.")
            self._episode = options["stage"] * self._episodes_per_stage
        else:
            self._episode += 1
        self._stage = min(self._episode // self._episodes_per_stage, stages)
        retained = self.scenario.retained
        self._task = (
            self.scenario.target[self._stage - 1] if self._stage else retained[self._episode % len(retained)]
        )

    def _stage_of(self, task: Task) -> int:
        """Return the stage that trains a task; 0 for retained and held-out ones."""
        return self.scenario.target.index(task) + 1 if task in self.scenario.target else 0

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step of the current task."""
        state, reward, terminated, _, _ = self._world.step(action)
        self._steps += 1
        truncated = not terminated and self._steps >= self._task.horizon
        return self._observation(state), float(reward), terminated, truncated, self._info(terminated)

    def _observation(self, state: NDArray[np.float32]) -> Observation:
        words: Any = self._words
        if self._instruction_format == "tokens":
            words = encode([self._words])[0].numpy()
        return {"state": state, "instruction": words}

    def _info(self, success: bool) -> dict[str, Any]:
        return {"task": self._task.name, "stage": self._stage, "instruction": self._words, "success": success}

    def render(self) -> Any:
        """Return what the current world renders."""
        return self._world.render()

    def close(self) -> None:
        """Close all worlds."""
        for world in self._worlds.values():
            world.close()
        self._worlds.clear()
