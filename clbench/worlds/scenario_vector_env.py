"""Many environments of a scenario side by side, made by `gymnasium.make_vec`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from copy import copy
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from clbench.base.errors import InputError, WrongTypeError
from clbench.spec.fields import is_whole
from clbench.spec.registry import opened_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import Lanes, success_at_horizon
from clbench.worlds.scenario_env import Observation
from clbench.worlds.schedule import InstructionFormat, Schedule, Start
from clbench.worlds.threads import cores

Flags = NDArray[np.bool_]
Outcome = tuple[Observation, NDArray[np.float64], Flags, Flags, dict[str, Any]]


class ScenarioVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Many `ScenarioEnv`, each with its own schedule, stepped together by the suite's vector world.

    It equals a `gymnasium.vector.SyncVectorEnv` of them bit for bit: an environment whose episode has ended
    begins the next one at the next step, which ignores its action. A copy made by pickle is a new vector,
    which begins with its own first `reset()`.

    Args:
        scenario: Scenario, or its entry point "module:attribute".
        num_envs: Number of environments.
        instruction: Form of the instruction in observations, "text" or "tokens".
        episodes_per_stage: Episodes after which an environment goes on to the next stage.
        stage: Stage to stay in, for an agent that is trained stage by stage; None goes through all stages.
        order: Order of the targets, see `Scenario.in_order`; 0 is the published order.
        task: Name of the only task; None has those of the stages.
        threads: Threads that step the worlds, by default one per core, at most one per environment.
            Results do not depend on it.
        render_mode: None; environments side by side cannot be drawn.

    Raises:
        MissingPackageError: A package that the tasks need is not installed; the message says how to get it.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str,
        num_envs: int = 1,
        instruction: InstructionFormat = "text",
        episodes_per_stage: int = 100,
        stage: int | None = None,
        order: int = 0,
        task: str | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._arguments = (scenario, num_envs, instruction, episodes_per_stage, stage, order, task, threads)
        if render_mode is not None:
            raise InputError(
                "Many environments side by side cannot be drawn. Draw one with gymnasium.make(...), or give "
                'gymnasium.make_vec(..., vectorization_mode="sync").'
            )
        self.scenario = opened_scenario(scenario, order)
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, not {num_envs}.")
        self.num_envs = num_envs
        self.instruction: InstructionFormat = instruction
        self.stage, self.order = stage, order
        self.steps_taken = 0
        """Steps of all environments together since they were made."""
        self.begun_at: float | None = None
        """Start of the first episodes in seconds, by `time.perf_counter`."""
        self._schedules = [
            Schedule(self.scenario, episodes_per_stage, instruction, stage, task) for _ in range(num_envs)
        ]
        self._generators: list[np.random.Generator] = [np_random()[0] for _ in range(num_envs)]
        self._lanes = Lanes(num_envs, min(num_envs, threads or cores()))  # more would never get work
        first = self.scenario.tasks[0]
        world = self._lanes.world(first)
        shown = self._lanes.observer(first).spaces(world.single_observation_space)
        self.single_action_space = world.single_action_space
        self.single_observation_space = spaces.Dict(
            {**shown, "instruction": self._schedules[0].instruction_space}
        )
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._starts: list[Start] = []
        self._tasks: list[Task] = []
        self._everywhere = list(range(num_envs))
        self._known = np.ones(num_envs, np.bool_)
        self._instructions: tuple[str, ...] | NDArray[np.int64] = ()
        self._told: dict[str, NDArray[Any]] = {}
        self._states = np.zeros((num_envs, *world.single_observation_space.shape), np.float32)
        self._steps_left = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)
        self._at_horizon = np.zeros(num_envs, np.bool_)

    def __getstate__(self) -> dict[str, Any]:  # as ScenarioEnv does
        return {"arguments": self._arguments, "spec": self.spec}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ScenarioVectorEnv.__init__(self, *state["arguments"])
        self.spec = state["spec"]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: Seed of the first environment, from which the others count up, or a seed or None for each.
            options: Options of `ScenarioEnv.reset`, for all environments. A task holds for one episode.

        Raises:
            UnknownNameError: The scenario has no such task.
            InputError: It has no such stage, an option is unknown, or the number of seeds is wrong.
            WrongTypeError: A seed is no whole number.
        """
        self.begun_at = self.begun_at or time.perf_counter()
        seeds = self._seeds(seed)
        for number, own in enumerate(seeds):
            if own is not None:
                self._generators[number], _ = np_random(own)
                self._schedules[number].begin()
        schedules = zip(self._schedules, self._generators, strict=True)
        self._starts = [schedule.next(generator, options or {}) for schedule, generator in schedules]
        self._begin(self._everywhere)
        self._ended = np.zeros(self.num_envs, np.bool_)
        return self._observation(), self._info(self._ended)

    def _seeds(self, seed: Any) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if is_whole(seed):
            return range(int(seed), int(seed) + self.num_envs)
        seeds = list(seed) if np.iterable(seed) else [seed]
        if not all(one is None or is_whole(one) for one in seeds):
            raise WrongTypeError(f"seed must be a whole number, or one per environment, not {seed!r}.")
        if len(seeds) != self.num_envs:
            raise InputError(f"{self.num_envs} environments need as many seeds, not {len(seeds)}.")
        return [None if one is None else int(one) for one in seeds]

    def step(self, actions: NDArray[np.float32]) -> Outcome:
        """Take one step in every environment; where the last one ended an episode, begin the next instead.

        Raises:
            ResetNeeded: There was no `reset` yet.
            InputError: There is not one action for each environment.
        """
        if not self._starts:
            raise gymnasium.error.ResetNeeded(f"{self.scenario.id} has no episodes yet: call reset().")
        actions, shape = np.asarray(actions), self.action_space.shape
        if actions.shape != shape:  # NumPy would repeat a single action
            raise InputError(f"The actions must have shape {shape}, not {actions.shape}: a row each.")
        if self._ended.any():
            rewards, successes = self._step_some(actions)
        else:
            self._states, rewards, successes = self._lanes.step(self._everywhere, actions)
            self._steps_left -= 1
            self.steps_taken += self.num_envs
        self._ended = successes | (self._steps_left <= 0)
        terminated = successes & ~self._at_horizon
        return self._observation(), rewards, terminated, self._ended & ~terminated, self._info(successes)

    def _step_some(self, actions: NDArray[np.float32]) -> tuple[NDArray[np.float64], Flags]:
        """Step where an episode goes on, begin the next one elsewhere; return rewards and successes."""
        rewards, successes = np.zeros(self.num_envs), np.zeros(self.num_envs, np.bool_)
        beginning, going = np.flatnonzero(self._ended).tolist(), np.flatnonzero(~self._ended).tolist()
        if going:
            outcomes = self._lanes.step(going, actions[going])
            self._states[going], rewards[going], successes[going] = outcomes
            self._steps_left[going] -= 1
            self.steps_taken += len(going)
        for number in beginning:
            self._starts[number] = self._schedules[number].next(self._generators[number], {})
        self._begin(beginning)
        return rewards, successes

    def close_extras(self, **kwargs: Any) -> None:
        """Close the worlds; Gymnasium's options of `close` change nothing here."""
        self._lanes.close()

    def _begin(self, numbers: Sequence[int]) -> None:
        """Put the environments `numbers` at their starts."""
        starts = [self._starts[number] for number in numbers]
        tasks = [start.task for start in starts]
        self._states[numbers] = self._lanes.reset(numbers, [start.seed for start in starts], tasks)
        self._steps_left[numbers] = [task.horizon for task in tasks]
        self._tell()

    def _tell(self) -> None:
        """Collect the instructions and infos of the current episodes, which every step repeats."""
        self._tasks = [start.task for start in self._starts]
        self._at_horizon = np.array([success_at_horizon(task) for task in self._tasks])
        instructions = [start.observed_instruction for start in self._starts]
        self._instructions = tuple(instructions) if self.instruction == "text" else np.stack(instructions)
        rows = [start.info(success=False) for start in self._starts]
        self._told = {
            name: np.array(
                [row[name] for row in rows], dtype=object if isinstance(value, str) else type(value)
            )
            for name, value in rows[0].items()
        }

    def _observation(self) -> Observation:
        state, image = self._lanes.observe(self._everywhere, self._tasks, self._states)
        images = {"image": image} if image.size else {}
        return {"state": state.copy(), **images, "instruction": copy(self._instructions)}

    def _info(self, successes: Flags) -> dict[str, Any]:
        """Return the infos as columns with masks, in the form of Gymnasium's vector environments."""
        info: dict[str, Any] = {}
        for name, column in {**self._told, "success": successes}.items():
            info[name], info[f"_{name}"] = column.copy(), self._known.copy()
        return info
