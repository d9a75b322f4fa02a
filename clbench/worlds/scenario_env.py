"""The Gymnasium environment of a scenario: it goes through the sequence of tasks."""

from __future__ import annotations

import time
from copy import copy
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.spec.registry import opened_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.gl_backend import draw_without_display
from clbench.worlds.lanes import success_at_horizon
from clbench.worlds.observation import Observer
from clbench.worlds.schedule import InstructionFormat, Schedule, Start
from clbench.worlds.world import Sizes, World, check_sizes, checked_actions

Observation = dict[str, Any]


class ScenarioEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A sequence of tasks as one environment.

    `reset()` begins the next episode of the schedule: `episodes_per_stage` episodes of stage 0, in which the
    retained tasks take turns, if there are any, then as many of each target task. The last one never ends.
    `reset(seed=...)` restarts the schedule. `reset(options={"stage": k})` continues from the start of a
    stage, and `reset(options={"task": name})` chooses any task for one episode. With `task=name` all episodes
    have that task.

    Observation: a dictionary of `state`, float32 (S,), from the task's world, and `instruction`, text, or
    with `instruction="tokens"` the word ids, int64 (L,), for agents that need numbers. Where the task has a
    camera, `state` holds only the numbers that a policy may see, and `image`, uint8 (N, N, 3), the picture.
    Action: float32 (A,), from -1 to 1, clipped; a number that is not finite is refused.
    Reward: the reward of the task's world, which is dense, but sparse on LIBERO. An episode is terminated by
    success and truncated at the task's horizon. Where success is judged only at the horizon, as on
    dm_control, an episode is always truncated, and `info` alone reports success.
    Info: `task`, `stage`, `instruction`, `success`. The stage is 0 for all tasks that no stage trains;
    `scenario.group(info["task"])` tells which part of the scenario a task belongs to. Instructions have the
    training wordings; `clbench.evaluate_agent` and `clbench score` also play episodes with test wordings. A
    copy made by pickle is a new environment, which begins with its own first `reset()`.
    Metadata: `render_fps` is the rate of the present task, in steps per second. Gymnasium's `RecordVideo`
    reads it once: where a world has several rates, wrap the environment after `reset()`.

    Args:
        scenario: Scenario, or its entry point "module:attribute".
        instruction: Form of the instruction in observations, "text" or "tokens".
        episodes_per_stage: Episodes after which `reset()` goes on to the next stage.
        stage: Stage to stay in, for an agent that is trained stage by stage; None goes through all stages.
        order: Order of the targets, see `Scenario.in_order`; 0 is the published order.
        task: Name of the only task, for example to evaluate one skill; None plays the tasks of the stages.
        render_mode: "rgb_array" or None, passed on to the worlds.

    Raises:
        MissingPackageError: A package that the tasks need is not installed; the message says how to get it.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | str,
        instruction: InstructionFormat = "text",
        episodes_per_stage: int = 100,
        stage: int | None = None,
        order: int = 0,
        task: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._arguments = (scenario, instruction, episodes_per_stage, stage, order, task, render_mode)
        self.scenario = opened_scenario(scenario, order)
        self.render_mode = render_mode
        self.instruction: InstructionFormat = instruction
        self.order = int(order)
        self.steps_taken = 0
        """Steps since the environment was made."""
        self.begun_at: float | None = None
        """Start of the first episode in seconds, by `time.perf_counter`."""
        self._schedule = Schedule(self.scenario, episodes_per_stage, instruction, stage, task)
        self.stage = self._schedule.stage
        self._worlds: dict[str, World] = {}
        self._sizes: dict[Sizes, str] = {}
        self._observers: dict[str, Observer] = {}
        self._begun: Start | None = None
        self._steps, self._ended, self._at_horizon = 0, False, False
        first = self.scenario.tasks[0]
        world = self._world(first)
        self.metadata = {**self.metadata, **_rate(world)}
        assert isinstance(world.observation_space, spaces.Box)
        assert isinstance(world.action_space, spaces.Box)
        self.action_space = self._actions = world.action_space
        shown = self._observers[first.world].spaces(world.observation_space)
        self.observation_space = spaces.Dict({**shown, "instruction": self._schedule.instruction_space})

    def __getstate__(self) -> dict[str, Any]:  # Gymnasium's EzPickle forgets the spec
        return {"arguments": self._arguments, "spec": self.spec}

    def __setstate__(self, state: dict[str, Any]) -> None:
        ScenarioEnv.__init__(self, *state["arguments"])
        self.spec = state["spec"]

    def _world(self, task: Task) -> World:
        """Return the world of a task, which is made on first use."""
        if task.world not in self._worlds:
            # a world that cannot draw need not know the argument
            options = {} if self.render_mode is None else {"render_mode": self.render_mode}
            world: World = resolve(task.world)(**options)
            check_sizes(task.world, world.observation_space, world.action_space, self._sizes)
            self._worlds[task.world] = world
            self._observers[task.world] = Observer(task.world, task.camera)
        return self._worlds[task.world]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the class documents `seed` and `options`.

        Raises:
            UnknownNameError: The scenario has no such task.
            InputError: The scenario has no such stage, or an option is unknown.
        """
        self._schedule.check(options or {})  # a refused reset changes nothing
        super().reset(seed=seed)
        self.begun_at = self.begun_at or time.perf_counter()
        if seed is not None:
            self._schedule.begin()
        start = self._schedule.next(self.np_random, options or {})
        self._begun = None  # after an error of the world there is no episode
        world = self._world(start.task)
        state, _ = world.reset(seed=start.seed, options={"task": start.task.name})
        self._begun = start
        self._steps, self._ended, self._at_horizon = 0, False, success_at_horizon(start.task)
        self.metadata.update(_rate(world))  # in place: wrappers share the dictionary
        return self._observation(state), start.info(False)

    @property
    def _start(self) -> Start:
        """Start of the current episode."""
        if self._begun is None:
            raise gymnasium.error.ResetNeeded(f"{self.scenario.id} has no episode: call reset().")
        return self._begun

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one step of the current task.

        Raises:
            ResetNeeded: There was no `reset` yet, or none since `close`, or the episode has ended.
            InputError: The action has another shape than the action space, or a number in it is not finite.
        """
        task = self._start.task
        if self._ended:  # a success would be counted again
            raise gymnasium.error.ResetNeeded(f"The episode of {self.scenario.id} has ended: call reset().")
        (checked,) = checked_actions(np.asarray(action)[None], self._actions, self.scenario.id, 1)
        state, reward, success, _, _ = self._world(task).step(checked)
        self._steps += 1
        self.steps_taken += 1
        self._ended = success or self._steps >= task.horizon
        terminated = success and not self._at_horizon
        truncated = self._ended and not terminated
        return self._observation(state), float(reward), terminated, truncated, self._start.info(success)

    def _observation(self, state: NDArray[np.float32]) -> Observation:
        shown, images = self._observers[self._start.task.world].observe(state[None])
        image = {"image": images[0]} if images.size else {}
        return {"state": shown[0], **image, "instruction": copy(self._start.observed_instruction)}

    def render(self) -> Any:
        """Return the rendering of the current world; without a display MuJoCo draws off screen."""
        if self.render_mode is not None:
            draw_without_display()
        return self._world(self._start.task).render()

    def close(self) -> None:
        """Close all worlds."""
        for world in self._worlds.values():
            world.close()
        for observer in self._observers.values():
            observer.close()
        self._worlds.clear()
        self._observers.clear()
        self._begun = None


def _rate(world: World) -> dict[str, Any]:
    """Return the steps per second of a world's present task, as an entry of the metadata."""
    return {"render_fps": world.metadata.get("render_fps", ScenarioEnv.metadata["render_fps"])}
