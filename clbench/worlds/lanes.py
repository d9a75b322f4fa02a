"""Worlds: one episode in a Gymnasium environment, or many side by side in the lanes of a vector world."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from typing import cast

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.spec.task import Task
from clbench.worlds.camera import VIEW_SIZE, Images
from clbench.worlds.observation import Observer
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.world import Outcomes, Sizes, States, VectorWorld, World, check_sizes, checked_actions


class PlainVectorWorld:
    """The vector world of a suite without its own: a plain world in each lane, stepped one after the other.

    Args:
        make: Function that makes a world.
        lanes: Number of lanes; a world is made when its lane is first reset.
    """

    def __init__(self, make: Callable[[], World], lanes: int) -> None:
        first = make()
        self.single_observation_space = cast(spaces.Box, first.observation_space)
        self.single_action_space = cast(spaces.Box, first.action_space)
        self._make = make
        self._worlds: list[World | None] = [first, *[None] * (lanes - 1)]

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> States:
        """Start an episode of a task in each of `lanes`, and return the states."""
        states = []
        for lane, seed, task in zip(lanes, seeds, tasks, strict=True):
            world = self._worlds[lane] or self._make()
            self._worlds[lane] = world
            states.append(world.reset(seed=seed, options={"task": task})[0])
        return np.stack(states)

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Step each of `lanes`, none of them twice, with its row of the actions (N, A)."""
        outcomes = []
        actions = checked_actions(actions, self.single_action_space, "plain", len(lanes))
        for lane, action in zip(lanes, actions, strict=True):
            world = self._worlds[lane]
            if world is None:
                raise gymnasium.error.ResetNeeded(f"Lane {lane} has no episode: reset it.")
            outcomes.append(world.step(action)[:3])
        states, rewards, successes = zip(*outcomes, strict=True)
        return np.stack(states), np.array(rewards, np.float64), np.array(successes, np.bool_)

    def close(self) -> None:
        """Close all worlds."""
        for world in self._worlds:
            if world is not None:
                world.close()


def vector_world(entry_point: str, lanes: int, threads: int = 1, perturbed: bool = False) -> VectorWorld:
    """Return a vector world of the world at `entry_point`: the suite's own if it has one.

    Args:
        entry_point: Entry point of the world.
        lanes: Number of lanes.
        threads: Threads that a suite's own vector world may use.
        perturbed: Whether its episodes are perturbed; `check_perturbable` refuses worlds without support.
    """
    world = resolve(entry_point)
    options = {"perturbed": True} if perturbed else {}
    own: Callable[..., VectorWorld] | None = getattr(world, "vector_world", None)
    if own is None:
        return PlainVectorWorld(functools.partial(world, **options), lanes)
    return own(lanes, threads, **options)


def is_perturbable(task: Task) -> bool:
    """Return whether the world of a task, or its suite's own vector world, declares itself perturbable."""
    world = resolve(task.world)
    return bool(getattr(getattr(world, "vector_world", None) or world, "perturbable", False))


def success_at_horizon(task: Task) -> bool:
    """Return whether the world of a task declares that it judges success only at the horizon."""
    return bool(getattr(resolve(task.world), "success_at_horizon", False))


def control_rate(task: Task) -> float | None:
    """Return the steps per second of a task in its world, None if the world does not give them."""
    with closing(resolve(task.world)()) as world:
        world.reset(seed=0, options={"task": task.name})  # a world may have a rate for each task
        rate = world.metadata.get("render_fps")
    return None if rate is None else float(rate)


def check_perturbable(tasks: Iterable[Task]) -> None:
    """Refuse tasks whose worlds cannot be perturbed.

    Raises:
        InputError: The world of a task does not declare itself perturbable; the message says what to do.
    """
    for task in tasks:
        if not is_perturbable(task):
            own = getattr(resolve(task.world), "vector_world", None)
            what = f"the vector world of {task.world}" if own else task.world
            raise InputError(
                f"The task {task.name!r} cannot be perturbed: {what} does not declare `perturbable = True`. "
                "Run without --perturb, or perturb its episodes as docs/guide/your_scenario.md shows."
            )


class Lanes:
    """Slots for episodes of any tasks; each episode runs in the vector world of its task.

    Args:
        count: Number of lanes; they are numbered from 0.
        threads: Threads that a suite's own vector world may use.
    """

    def __init__(self, count: int, threads: int = 1) -> None:
        self.count = count
        """Number of lanes."""
        self._threads = threads
        self._worlds: dict[tuple[str, bool], VectorWorld] = {}
        self._sizes: dict[Sizes, str] = {}
        self._observers: dict[tuple[str, str] | None, Observer] = {}
        self._home: list[VectorWorld | None] = [None] * count
        self._views = np.zeros((count, VIEW_SIZE), np.float32)

    def world(self, task: Task, perturbed: bool = False) -> VectorWorld:
        """Return the vector world of a task, or its perturbed twin, which is made on first use.

        Raises:
            InputError: Its states or actions differ in size from those of the other worlds.
        """
        key = task.world, perturbed
        if key not in self._worlds:
            made = vector_world(task.world, self.count, self._threads, perturbed)
            check_sizes(task.world, made.single_observation_space, made.single_action_space, self._sizes)
            self._worlds[key] = made
        return self._worlds[key]

    def observer(self, task: Task) -> Observer:
        """Return the observer that shows the states of a task to a policy, which is made on first use."""
        key = None if task.camera is None else (task.world, task.camera)
        if key not in self._observers:
            self._observers[key] = Observer(task.world, task.camera)
        return self._observers[key]

    def observe(self, lanes: Sequence[int], tasks: Sequence[Task], states: States) -> tuple[States, Images]:
        """Return the observations of the states (N, S) of `lanes`: numbers (N, P) and pictures.

        Args:
            lanes: Lanes of the states; in a perturbed episode camera and light are perturbed too.
            tasks: Task of each lane.
            states: States (N, S) to show.

        Raises:
            RenderingError: No back end of this machine can draw a world.
        """
        views = self._views[list(lanes)]
        if len({(task.world, task.camera) if task.camera else None for task in tasks}) == 1:
            return self.observer(tasks[0]).observe(states, views)
        shown = [
            self.observer(task).observe(state[None], view[None])
            for task, state, view in zip(tasks, states, views, strict=True)
        ]
        numbers, images = zip(*shown, strict=True)
        return np.concatenate(numbers), np.concatenate(images)

    def reset(
        self,
        lanes: Sequence[int],
        seeds: Sequence[int],
        tasks: Sequence[Task],
        perturbed: Sequence[bool] | None = None,
    ) -> States:
        """Start an episode of a task in each of `lanes`, and return the states (N, S).

        Args:
            lanes: Lanes of the episodes.
            seeds: Seeds of the initial states.
            tasks: Tasks of the episodes.
            perturbed: Whether each episode is perturbed; None perturbs none.
        """
        flags = perturbed or [False] * len(tasks)
        for lane, seed, task, is_perturbed in zip(lanes, seeds, tasks, flags, strict=True):
            self._home[lane] = self.world(task, is_perturbed)
            self._views[lane] = draw_perturbation(seed).view if is_perturbed else 0.0
        states = self._empty(lanes)
        for world, rows in self._by_world(lanes):
            names = [tasks[row].name for row in rows]
            states[rows] = world.reset([lanes[row] for row in rows], [seeds[row] for row in rows], names)
        return states

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Step each of `lanes`, none of them twice, with its row of the actions (N, A).

        Raises:
            InputError: An action is refused; no lane has moved.
        """
        states, rewards, successes = (
            self._empty(lanes),
            np.empty(len(lanes)),
            np.empty(len(lanes), np.bool_),
        )
        if len(self._worlds) == 1:
            (world,) = self._worlds.values()
            states[:], rewards[:], successes[:] = world.step(lanes, actions)
            return states, rewards, successes
        for world, rows in self._by_world(lanes):
            checked_actions(actions[rows], world.single_action_space, "scenario's", len(rows))
        for world, rows in self._by_world(lanes):
            outcomes = world.step([lanes[row] for row in rows], actions[rows])
            states[rows], rewards[rows], successes[rows] = outcomes
        return states, rewards, successes

    def close(self) -> None:
        """Close all worlds."""
        for world in self._worlds.values():
            world.close()
        for observer in self._observers.values():
            observer.close()
        self._worlds.clear()
        self._observers.clear()
        self._home = [None] * self.count

    def _empty(self, lanes: Sequence[int]) -> States:
        """Return uninitialised memory for the states of `lanes`, each of which must have an episode."""
        homes = [self._home[lane] for lane in lanes]
        if None in homes:
            raise gymnasium.error.ResetNeeded(f"Lane {lanes[homes.index(None)]} has no episode: reset it.")
        assert homes[0] is not None
        return np.empty((len(lanes), *homes[0].single_observation_space.shape), np.float32)

    def _by_world(self, lanes: Sequence[int]) -> Iterator[tuple[VectorWorld, list[int]]]:
        """Return each world with the rows of `lanes` that it runs."""
        for world in self._worlds.values():
            rows = [row for row, lane in enumerate(lanes) if self._home[lane] is world]
            if rows:
                yield world, rows
