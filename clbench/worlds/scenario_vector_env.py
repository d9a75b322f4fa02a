"""Many environments of a scenario side by side, made by `gymnasium.make_vec`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from clbench.base.errors import InputError, WrongTypeError
from clbench.spec.fields import check_whole, is_whole, whole_number
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

    The results of `reset` and `step`, the spaces, `np_random` and `np_random_seed` equal those of a
    `gymnasium.vector.SyncVectorEnv` of these environments bit for bit, in all autoreset modes. Errors have
    other types and texts. There are no single environments: `envs`, `call`, `get_attr`, `set_attr` and
    `render` are missing; `gymnasium.make_vec(..., vectorization_mode="sync")` has them. A copy made by pickle
    is a new vector environment, which begins with its own first `reset()`.

    Args:
        scenario: Scenario, or its entry point "module:attribute".
        num_envs: Number of environments.
        instruction: Form of the instruction in observations, "text" or "tokens".
        episodes_per_stage: Episodes after which an environment goes on to the next stage.
        stage: Stage to stay in, for an agent that is trained stage by stage; None goes through all stages.
        order: Order of the targets, see `Scenario.in_order`; 0 is the published order.
        task: Name of the only task, or one for each environment, for example to learn all at once; None plays
            the tasks of the stages.
        threads: Threads that step the worlds, by default one per core, at most one per environment.
            Results do not depend on their number.
        render_mode: None; environments side by side cannot be drawn.
        max_episode_steps: None; an episode has the horizon of its task.
        autoreset_mode: When an environment whose episode has ended begins the next one. `NEXT_STEP` begins it
            at the next step, which ignores its action. `SAME_STEP` begins it at once; the infos then hold the
            last observation and info of the old episode, as `final_obs` and `final_info`. `DISABLED` leaves
            it to `reset` with the option "reset_mask".

    Raises:
        MissingPackageError: A package that the tasks need is not installed; the message says how to get it.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str,
        num_envs: int = 1,
        instruction: InstructionFormat = "text",
        episodes_per_stage: int = 100,
        stage: int | None = None,
        order: int = 0,
        task: str | Sequence[str] | None = None,
        threads: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: None = None,
    ) -> None:
        self._arguments = (
            *(scenario, num_envs, instruction, episodes_per_stage, stage, order, task, threads, render_mode),
            autoreset_mode,
        )
        if render_mode is not None:
            raise InputError(
                "This vector environment cannot be drawn. Draw a single environment with "
                'gymnasium.make(...), or use gymnasium.make_vec(..., vectorization_mode="sync").'
            )
        if max_episode_steps is not None:
            raise InputError(
                "This vector environment has no max_episode_steps: an episode has the horizon of its task. "
                'gymnasium.make_vec(..., vectorization_mode="sync") cuts episodes off earlier.'
            )
        self.scenario = opened_scenario(scenario, order)
        self.num_envs = num_envs
        check_whole(self, 1, "num_envs")
        threads = cores() if threads is None else whole_number("threads", threads, 1)
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.instruction: InstructionFormat = instruction
        self.order = int(order)
        self.steps_taken = 0
        """Steps of all environments together since they were made."""
        self.begun_at: float | None = None
        """Start of the first episodes in seconds, by `time.perf_counter`."""
        self._schedules = [
            Schedule(self.scenario, episodes_per_stage, instruction, stage, one)
            for one in _one_each(task, num_envs)
        ]
        self.stage = self._schedules[0].stage
        self._generators = [np_random() for _ in range(num_envs)]
        self._lanes = Lanes(num_envs, min(num_envs, threads))  # more would never get work
        first = self.scenario.tasks[0]
        world = self._lanes.world(first)
        shown = self._lanes.observer(first).spaces(world.single_observation_space)
        self.single_action_space = world.single_action_space
        self.single_observation_space = spaces.Dict(
            {**shown, "instruction": self._schedules[0].instruction_space}
        )
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._starts: dict[int, Start] = {}
        self._tasks: list[Task] = []
        self._everywhere = list(range(num_envs))
        self._known = np.ones(num_envs, np.bool_)
        self._instructions: list[Any] = []
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

    @property  # type: ignore[misc]  # SyncVectorEnv has no setter either
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generators of the environments, as `SyncVectorEnv` has them."""
        return tuple(generator for generator, _ in self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds of the generators in `np_random`."""
        return tuple(seed for _, seed in self._generators)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every environment, or in those that the option "reset_mask" names.

        Args:
            seed: Seed of the first environment, from which the others count up, or a seed or None for each.
            options: Options of `ScenarioEnv.reset`, for all environments. A task holds for one episode. With
                "reset_mask", an array (N,) of bool, the other environments go on with their episodes.

        Raises:
            ResetNeeded: The first `reset` has a mask.
            UnknownNameError: The scenario has no such task.
            InputError: The scenario has no such stage, an option is unknown, or the number of seeds is wrong.
            WrongTypeError: A seed is not a whole number.
        """
        options = dict(options or {})
        numbers, seeds = self._chosen(options.pop("reset_mask", None)), self._seeds(seed)
        for number in numbers:
            self._schedules[number].check(options)  # a refused reset changes nothing
        seeded = {number: np_random(own) for number in numbers if (own := seeds[number]) is not None}
        for number, generator in seeded.items():
            self._generators[number] = generator
            self._schedules[number].begin()
        self.begun_at = self.begun_at or time.perf_counter()
        self.closed = False  # the worlds are made anew
        self._begin(numbers, options)
        self._ended[numbers] = False
        info: dict[str, Any] = {}
        for number in numbers:
            info = self._add_info(info, self._starts[number].info(success=False), number)
        return self._observation(self._everywhere), info

    def _chosen(self, mask: Any) -> list[int]:
        """Return the environments that begin an episode: all, or those that a mask selects."""
        if mask is None:
            return self._everywhere
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not is_mask or not mask.any():
            raise InputError(
                f'The option "reset_mask" must be an array ({self.num_envs},) of bool, at least one of them '
                f"True, not {mask!r}."
            )
        if not self._starts:
            raise gymnasium.error.ResetNeeded(f"{self.scenario.id} has no episodes: first reset all.")
        return np.flatnonzero(mask).tolist()

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
        """Take one step in every environment; `autoreset_mode` decides when the next episode begins.

        Raises:
            ResetNeeded: There was no `reset` yet, or none since `close`, or without autoreset, an episode has
                ended.
            InputError: There is not one action for each environment.
        """
        if not self._starts:
            raise gymnasium.error.ResetNeeded(f"{self.scenario.id} has no episodes: call reset().")
        actions, shape = np.asarray(actions), self.action_space.shape
        if actions.shape != shape:  # NumPy would repeat a single action
            raise InputError(
                f"The actions must have shape {shape}, not {actions.shape}: one row per environment."
            )
        if self._ended.any():
            if self.autoreset_mode is AutoresetMode.DISABLED:
                raise gymnasium.error.ResetNeeded(
                    f"Episodes of {self.scenario.id} have ended, in the environments "
                    f'{np.flatnonzero(self._ended).tolist()}: reset them, with the option "reset_mask".'
                )
            rewards, successes = self._step_some(actions)
        else:
            self._states, rewards, successes = self._lanes.step(self._everywhere, actions)
            self._steps_left -= 1
            self.steps_taken += self.num_envs
        self._ended = successes | (self._steps_left <= 0)
        terminated = successes & ~self._at_horizon
        truncated = self._ended & ~terminated
        final = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = self._finished(np.flatnonzero(self._ended).tolist(), successes)
            successes, self._ended = successes & ~self._ended, np.zeros(self.num_envs, np.bool_)
        info = {**final, **self._info(successes)}
        return self._observation(self._everywhere), rewards, terminated, truncated, info

    def _finished(self, numbers: list[int], successes: Flags) -> dict[str, Any]:
        """Begin the next episodes of `numbers`; return the final observations and infos of the ended ones."""
        shown = self._observation(numbers)
        info: dict[str, Any] = {}
        for row, number in enumerate(numbers):
            told = self._starts[number].info(bool(successes[number]))
            last = {name: values[row] for name, values in shown.items()}
            info = self._add_info(info, {"final_obs": last, "final_info": told}, number)
        self._begin(numbers, {})
        return info

    def _step_some(self, actions: NDArray[np.float32]) -> tuple[NDArray[np.float64], Flags]:
        """Step where an episode goes on, begin the next one elsewhere; return rewards and successes."""
        rewards, successes = np.zeros(self.num_envs), np.zeros(self.num_envs, np.bool_)
        beginning, going = np.flatnonzero(self._ended).tolist(), np.flatnonzero(~self._ended).tolist()
        if going:
            outcomes = self._lanes.step(going, actions[going])
            self._states[going], rewards[going], successes[going] = outcomes
            self._steps_left[going] -= 1
            self.steps_taken += len(going)
        self._begin(beginning, {})
        return rewards, successes

    def close_extras(self, **kwargs: Any) -> None:
        """Close the worlds; Gymnasium's options of `close` change nothing here."""
        self._lanes.close()
        self._starts = {}

    def _begin(self, numbers: Sequence[int], options: dict[str, Any]) -> None:
        """Begin the next episodes of the environments `numbers`, or those that the options choose."""
        starts = [self._schedules[number].next(self._generators[number][0], options) for number in numbers]
        before, self._starts = self._starts, {}  # after an error of a world there are no episodes
        tasks = [start.task for start in starts]
        self._states[numbers] = self._lanes.reset(numbers, [start.seed for start in starts], tasks)
        self._starts = {**before, **dict(zip(numbers, starts, strict=True))}
        self._steps_left[numbers] = [task.horizon for task in tasks]
        self._tell()

    def _tell(self) -> None:
        """Collect the instructions and infos of the current episodes, which every step repeats."""
        starts = list(self._starts.values())
        self._tasks = [start.task for start in starts]
        self._at_horizon = np.array([success_at_horizon(task) for task in self._tasks])
        self._instructions = [start.observed_instruction for start in starts]
        rows = [start.info(success=False) for start in starts]
        self._told = {
            name: np.array(
                [row[name] for row in rows], dtype=object if isinstance(value, str) else type(value)
            )
            for name, value in rows[0].items()
        }

    def _observation(self, numbers: list[int]) -> Observation:
        """Return the observations of the environments `numbers`; later steps do not change them."""
        tasks = [self._tasks[number] for number in numbers]
        state, image = self._lanes.observe(numbers, tasks, self._states[numbers])
        images = {"image": image} if image.size else {}
        words = [self._instructions[number] for number in numbers]
        instruction = tuple(words) if self.instruction == "text" else np.stack(words)
        return {"state": state, **images, "instruction": instruction}

    def _info(self, successes: Flags) -> dict[str, Any]:
        """Return the infos as columns with masks, in the form of Gymnasium's vector environments."""
        info: dict[str, Any] = {}
        for name, column in {**self._told, "success": successes}.items():
            info[name], info[f"_{name}"] = column.copy(), self._known.copy()
        return info


def _one_each(task: str | Sequence[str] | None, count: int) -> Sequence[str | None]:
    """Return a task for each environment.

    Raises:
        InputError: There are more tasks than environments, or fewer.
    """
    if isinstance(task, str) or not np.iterable(task):
        return [task] * count
    if len(task) != count:
        raise InputError(f"{count} environments need as many tasks, or one for all, not {len(task)}.")
    return list(task)


def _mode(chosen: str | AutoresetMode) -> AutoresetMode:
    """Return the autoreset mode with a name such as "SameStep"."""
    try:
        return AutoresetMode(chosen)
    except ValueError as error:
        names = ", ".join(f'"{mode.value}"' for mode in AutoresetMode)
        raise InputError(
            f"autoreset_mode must be an AutoresetMode or one of {names}, not {chosen!r}."
        ) from error
