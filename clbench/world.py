"""Worlds: one episode in a Gymnasium environment, or many side by side in the lanes of a vector world."""

from __future__ import annotations

import functools
import inspect
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from queue import SimpleQueue
from typing import Any, ClassVar, Protocol, TypeAlias, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.camera import VIEW_SIZE, Images
from clbench.observer import Observer
from clbench.perturbation import draw_perturbation
from clbench.task import Task, resolve

World = gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]

States: TypeAlias = NDArray[np.float32]
"""States of N lanes, (N, S)."""
Item = TypeVar("Item")
Outcomes: TypeAlias = tuple[States, NDArray[np.float64], NDArray[np.bool_]]
"""What a step led to in N lanes: states (N, S), rewards (N,), and which episodes succeeded (N,)."""


class VectorWorld(Protocol):
    """Many episodes of one world side by side, each in a lane.

    A suite has its own where stepping many episodes together is faster than one after the other: the
    attribute `vector_world` of its world makes it, from the number of lanes and of threads. Each episode is
    bit for bit that of the plain world, whatever the other lanes do. Who uses it resets a lane before
    stepping it, counts the steps, and lets a lane rest once its episode has succeeded.

    A world can be perturbed if what makes it takes `perturbed` besides, the vector world or, where there is
    none, the plain world. Its episodes are then disturbed as `clbench.perturbation.draw_perturbation` says.
    """

    single_observation_space: spaces.Box
    """Of the state in one lane."""
    single_action_space: spaces.Box

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> States:
        """Start an episode of a task in each of `lanes`, and return the states."""
        ...

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Move each of `lanes`, none twice, by its row of actions (N, A)."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class OneLaneWorld(World, ABC):
    """A suite's own vector world with one lane, as the plain world: one physics serves both.

    A suite names its vector world and its first task, and draws the picture in `picture`; its metadata say
    how many steps a second has.

    Args:
        render_mode: "rgb_array", or None to draw nothing.
    """

    vector_world: ClassVar[Callable[[int, int], Any]]
    """Makes the vector world, from the number of lanes and of threads."""
    first_task: ClassVar[str]
    """What `reset` starts if no task is asked for."""

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._world = type(self).vector_world(1, 1)
        self.observation_space = self._world.single_observation_space
        self.action_space = self._world.single_action_space
        self._task = self.first_task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[States, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default of the first, and return the state (S,).

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        task = (options or {}).get("task", self.first_task)
        state = self._world.reset([0], [seed], [task])[0]
        self._task = task
        return state, {"success": False, "task": task}

    def step(self, action: NDArray[np.float32]) -> tuple[States, float, bool, bool, dict[str, Any]]:
        """Move for one step.

        Raises:
            ValueError: The action has another shape than the action space, or a number in it is not finite.
        """
        states, rewards, successes = self._world.step([0], np.asarray(action, np.float32)[None])
        success = bool(successes[0])
        return states[0], float(rewards[0]), success, False, {"success": success, "task": self._task}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3) if the render mode is "rgb_array"."""
        return None if self.render_mode is None else self.picture()

    @abstractmethod
    def picture(self) -> NDArray[np.uint8]:
        """Draw the scene, (480, 480, 3)."""


def checked_actions(actions: NDArray[np.float32], space: spaces.Box, world: str) -> NDArray[np.float32]:
    """Return actions (N, A) within the bounds of the action space of a world.

    Raises:
        ValueError: An action has another shape than the space, or a number in it is not finite.
    """
    actions = np.asarray(actions, np.float32)
    if actions.shape[1:] != space.shape:
        raise ValueError(f"An action of the {world} world has shape {space.shape}, not {actions.shape[1:]}.")
    finite = np.isfinite(actions)
    if not finite.all():
        wrong = actions[~finite.all(axis=1)][0]
        raise ValueError(f"An action of the {world} world is finite, not {wrong.tolist()}.")
    return np.minimum(np.maximum(actions, space.low), space.high)


def no_episode(lane: int, world: str) -> gymnasium.error.ResetNeeded:
    """Return the error for a lane that is used before its first episode."""
    return gymnasium.error.ResetNeeded(f"Lane {lane} of the {world} world has no episode: reset it.")


class Team:
    """Threads that share out work, the calling one among them; MuJoCo releases the interpreter lock.

    Args:
        threads: How many.
    """

    def __init__(self, threads: int) -> None:
        self._helpers = [_Helper() for _ in range(threads - 1)]

    def each(self, work: Callable[[Item], None], items: Sequence[Item]) -> None:
        """Do the work on each item, in any order: each thread takes the next that is left."""
        left = iter(items)

        def take() -> None:
            for item in left:
                work(item)

        helpers = self._helpers[: len(items) - 1] if items else []
        for helper in helpers:
            helper.asked.put(take)
        try:
            take()
        finally:
            errors = [error for helper in helpers if (error := helper.ended.get()) is not None]
        if errors:
            raise errors[0]

    def close(self) -> None:
        """End the threads."""
        for helper in self._helpers:
            helper.asked.put(None)
        self._helpers = []

    def __del__(self) -> None:
        """End the threads of a team that nobody closed."""
        self.close()


class _Helper:
    """A thread that does what it is asked for, until that is None.

    Two queues in C pass work on in 10 us; an executor takes 50, a fortieth of a step of Meta-World.
    """

    def __init__(self) -> None:
        self.asked: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.ended: SimpleQueue[Exception | None] = SimpleQueue()
        threading.Thread(target=_help, args=(self.asked, self.ended), daemon=True).start()


def _help(asked: SimpleQueue[Callable[[], None] | None], ended: SimpleQueue[Exception | None]) -> None:
    while (work := asked.get()) is not None:
        try:
            work()
        except Exception as error:
            ended.put(error)
        else:
            ended.put(None)


class PlainVectorWorld:
    """The vector world of a suite that has no own: a plain world in each lane, one stepped after the other.

    Args:
        make: Makes a world.
        lanes: Places for episodes; a world is made when its lane is first reset.
    """

    def __init__(self, make: Callable[[], World], lanes: int) -> None:
        first = make()
        assert isinstance(first.observation_space, spaces.Box)
        assert isinstance(first.action_space, spaces.Box)
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
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
        """Move each of `lanes`, none twice, by its row of actions (N, A)."""
        outcomes = []
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
    """Return a vector world of the world that `entry_point` names: the suite's own if it has one.

    Args:
        entry_point: Of the world.
        lanes: Places for episodes.
        threads: Threads that a suite's own vector world may use.
        perturbed: Whether its episodes are perturbed, which not every world's can be: `check_perturbable`.
    """
    world = resolve(entry_point)
    disturbed = {"perturbed": True} if perturbed else {}
    own: Callable[..., VectorWorld] | None = getattr(world, "vector_world", None)
    if own is None:
        return PlainVectorWorld(functools.partial(world, **disturbed), lanes)
    return own(lanes, threads, **disturbed)


def check_perturbable(tasks: Iterable[Task]) -> None:
    """Refuse tasks whose worlds cannot be perturbed.

    Raises:
        ValueError: The world of a task takes no `perturbed`; the message says what to do.
    """
    for task in tasks:
        world = resolve(task.world)
        own = getattr(world, "vector_world", None)
        if "perturbed" not in inspect.signature(own or world).parameters:
            what = f"the vector world of {task.world}" if own else task.world
            raise ValueError(
                f"The task {task.name!r} cannot be perturbed: {what} takes no argument `perturbed`. Run "
                "without --perturb, or give it one, as docs/your_scenario.md shows."
            )


class Lanes:
    """Places for episodes of any tasks: each runs in the vector world of its task.

    Args:
        count: How many; they are numbered from 0.
        threads: Threads that a suite's own vector world may use.
    """

    def __init__(self, count: int, threads: int = 1) -> None:
        self._count, self._threads = count, threads
        self._worlds: dict[tuple[str, bool], VectorWorld] = {}
        self._observers: dict[tuple[str, str] | None, Observer] = {}
        self._home: list[VectorWorld | None] = [None] * count
        self._views = np.zeros((count, VIEW_SIZE), np.float32)

    def world(self, task: Task, perturbed: bool = False) -> VectorWorld:
        """Return the vector world of a task, or its perturbed twin; it is made when first needed."""
        key = task.world, perturbed
        if key not in self._worlds:
            self._worlds[key] = vector_world(task.world, self._count, self._threads, perturbed)
        return self._worlds[key]

    def observer(self, task: Task) -> Observer:
        """Return what shows the states of a task to a policy; it is made when first needed."""
        key = None if task.camera is None else (task.world, task.camera)
        if key not in self._observers:
            self._observers[key] = Observer(task.world, task.camera)
        return self._observers[key]

    def observe(self, lanes: Sequence[int], tasks: Sequence[Task], states: States) -> tuple[States, Images]:
        """Return what a policy is shown of the states (N, S) of `lanes`: numbers (N, P) and pictures.

        Args:
            lanes: Whose states they are; in a perturbed episode camera and light are disturbed.
            tasks: What each of them does.
            states: What is shown.

        Raises:
            RenderingError: Nothing here can draw a world.
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
            lanes: Where to.
            seeds: Of the initial states.
            tasks: What to do.
            perturbed: Which of the episodes are perturbed; none is if None.
        """
        disturbed = perturbed or [False] * len(tasks)
        for lane, seed, task, is_disturbed in zip(lanes, seeds, tasks, disturbed, strict=True):
            self._home[lane] = self.world(task, is_disturbed)
            self._views[lane] = draw_perturbation(seed).view if is_disturbed else 0.0
        states = self._empty(lanes)
        for world, rows in self._by_world(lanes):
            names = [tasks[row].name for row in rows]
            states[rows] = world.reset([lanes[row] for row in rows], [seeds[row] for row in rows], names)
        return states

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Move each of `lanes`, none twice, by its row of actions (N, A)."""
        states, rewards, successes = self._empty(lanes), np.empty(len(lanes)), np.empty(len(lanes), np.bool_)
        if len(self._worlds) == 1:
            (world,) = self._worlds.values()
            states[:], rewards[:], successes[:] = world.step(lanes, actions)
            return states, rewards, successes
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
        self._home = [None] * self._count

    def _empty(self, lanes: Sequence[int]) -> States:
        """Return memory for the states of `lanes`, all of which have an episode."""
        homes = [self._home[lane] for lane in lanes]
        if None in homes:
            raise gymnasium.error.ResetNeeded(f"Lane {lanes[homes.index(None)]} has no episode: reset it.")
        assert homes[0] is not None
        return np.empty((len(lanes), *homes[0].single_observation_space.shape), np.float32)

    def _by_world(self, lanes: Sequence[int]) -> Iterator[tuple[VectorWorld, list[int]]]:
        """Return each world with the rows of `lanes` that are in it."""
        for world in self._worlds.values():
            rows = [row for row, lane in enumerate(lanes) if self._home[lane] is world]
            if rows:
                yield world, rows
