"""Worlds: the interface of one episode, and of many side by side."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, TypeAlias, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.worlds.gl_backend import draw_without_display

if TYPE_CHECKING:
    import mujoco
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

    from clbench.spec.task import Task

Lane = TypeVar("Lane")
World = gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]

States: TypeAlias = NDArray[np.float32]
"""States of N lanes, (N, S)."""
Outcomes: TypeAlias = tuple[States, NDArray[np.float64], NDArray[np.bool_]]
"""Result of a step in N lanes: states (N, S), rewards (N,), and whether each episode succeeded (N,)."""
Sizes: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]
"""Shapes of a state and of an action of a world."""


class VectorWorld(Protocol):
    """Many episodes of one world side by side, each in a lane.

    A suite has its own vector world where many episodes step faster together than one after the other. The
    attribute `vector_world` of its world makes it from the number of lanes and the most threads that may
    step them; a `clbench.worlds.threads.Team` of as many leaves cores to other runs. Each episode equals an
    episode of the plain world bit for bit, whatever the other lanes do. The caller resets a lane before
    stepping it, counts the steps, and leaves a lane alone once its episode has succeeded.

    The class that makes the episodes, this one or a plain world without a vector world, declares
    `perturbable: ClassVar[bool] = True` if it also takes the keyword argument `perturbed`. Its episodes are
    then perturbed by `clbench.worlds.perturbation.draw_perturbation`. Without the declaration its episodes
    cannot be perturbed.

    A plain world that judges success only at the horizon of its tasks declares
    `success_at_horizon: ClassVar[bool] = True`, whether it has a vector world or not. A success then does not
    end the task: environments report it in `info` and call the episode truncated, not terminated.
    """

    single_observation_space: spaces.Box
    """Space of the state in one lane, (S,)."""
    single_action_space: spaces.Box
    """Space of the action in one lane, (A,)."""

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> States:
        """Start an episode of a task in each of `lanes`, and return the states."""
        ...

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Step each of `lanes`, none of them twice, with its row of the actions (N, A)."""
        ...

    def close(self) -> None:
        """Free all worlds and threads."""
        ...


@contextmanager
def opened_worlds(**options: Any) -> Iterator[Callable[[Task], World]]:
    """Yield a function that returns the world of a task; worlds are made on demand and closed at the end.

    Args:
        **options: Options of every world, such as its render mode.
    """
    made: dict[str, World] = {}

    def world(task: Task) -> World:
        if task.world not in made:
            made[task.world] = resolve(task.world)(**options)
        return made[task.world]

    try:
        yield world
    finally:
        for one in made.values():
            one.close()


class OneLaneWorld(World, ABC):
    """A plain world that is the suite's own vector world with one lane: both share one physics.

    A suite names its vector world and its first task, draws the picture in `picture`, and gives the number of
    steps per second in its metadata. The vector world declares whether it is `perturbable`.

    Args:
        render_mode: "rgb_array", or None to draw nothing.
    """

    vector_world: ClassVar[Callable[[int, int], Any]]
    """Function that makes the vector world from the number of lanes and the number of threads."""
    first_task: ClassVar[str]
    """Name of the task that `reset` starts if its options name none."""
    success_at_horizon: ClassVar[bool] = False
    """Whether success is judged only at the horizon, see `VectorWorld`."""

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._world = type(self).vector_world(1, 1)
        self.observation_space = self._world.single_observation_space
        self.action_space = self._world.single_action_space
        self._task = self.first_task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[States, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default the first, and return the state (S,).

        Raises:
            UnknownNameError: No task has this name; the nearest one is named.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        task = (options or {}).get("task", self.first_task)
        state = self._world.reset([0], [seed], [task])[0]
        self._task = task
        return state, {"success": False, "task": task}

    def step(self, action: NDArray[np.float32]) -> tuple[States, float, bool, bool, dict[str, Any]]:
        """Take one step.

        Raises:
            InputError: The action has another shape than the action space, or a number in it is not finite.
        """
        states, rewards, successes = self._world.step([0], np.asarray(action)[None])
        success = bool(successes[0])
        return (states[0], float(rewards[0]), success, False, {"success": success, "task": self._task})

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3) if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        draw_without_display()
        return self.picture()

    @abstractmethod
    def picture(self) -> NDArray[np.uint8]:
        """Draw the scene, (480, 480, 3)."""


class Drawable(NamedTuple):
    """Everything that a picture of one lane is drawn from."""

    model: mujoco.MjModel
    """The compiled scene."""
    data: mujoco.MjData
    """The physics of the lane's episode, with the mark of its goal in place."""
    camera: dict[str, Any]
    """Settings of a free camera: distance in metres, azimuth and elevation in degrees, and `lookat` (3,)."""


class MujocoWorld(OneLaneWorld):
    """A world whose vector world has `drawable(lane) -> Drawable`; Gymnasium's renderer draws it.

    Args:
        render_mode: "rgb_array", or None to draw nothing.
    """

    _renderer: MujocoRenderer | None = None

    def picture(self) -> NDArray[np.uint8]:
        """Draw the scene, (480, 480, 3)."""
        from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer  # only drawing needs MuJoCo here

        model, data, camera = self._world.drawable(0)
        if self._renderer is None or self._renderer.data is not data:
            self.close()
            self._renderer = MujocoRenderer(model, data, camera, 480, 480)
        picture: NDArray[np.uint8] = self._renderer.render("rgb_array")
        return picture

    def close(self) -> None:
        """Free the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()  # type: ignore[no-untyped-call]
            self._renderer = None


def check_sizes(
    world: str, states: spaces.Space[Any], actions: spaces.Space[Any], known: dict[Sizes, str]
) -> None:
    """Refuse a world whose states or actions differ in size from those of the scenario's other worlds.

    Args:
        world: Entry point of the world.
        states: Its observation space.
        actions: Its action space.
        known: The sizes so far, each with the world that has them; those of this world are added.

    Raises:
        InputError: A space is not a Box, or has another shape than in the other worlds.
    """
    for kind, space in (("observation", states), ("action", actions)):
        if not isinstance(space, spaces.Box):
            raise InputError(f"The {kind} space of {world} must be a Box, not {space}.")
    sizes = states.shape or (), actions.shape or ()
    for others, other in known.items():
        if others != sizes:
            raise InputError(
                f"All worlds of a scenario must have states and actions of the same shapes, but {other} has "
                f"{others[0]} and {others[1]}, and {world} has {sizes[0]} and {sizes[1]}: fill the smaller "
                "ones with zeros."
            )
    known.setdefault(sizes, world)


def checked_actions(
    actions: NDArray[np.floating[Any]], space: spaces.Box, world: str, lanes: int
) -> NDArray[np.float32]:
    """Return actions (N, A) within the bounds of the action space of a world.

    Raises:
        InputError: An action has another shape than the space, does not consist of finite numbers, or there
            is not one action for each of the `lanes`.
    """
    actions = np.asarray(actions)
    if actions.shape[1:] != space.shape:
        raise InputError(
            f"An action of the {world} world must have shape {space.shape}, not {actions.shape[1:]}."
        )
    if len(actions) != lanes:
        raise InputError(
            f"{lanes} lanes of the {world} world need one action each, not {len(actions)} in total."
        )
    if actions.dtype.kind not in "fiub":
        raise InputError(f"An action of the {world} world must be numbers, not {actions[0].tolist()}.")
    finite = np.isfinite(actions)
    if not finite.all():
        wrong = actions[~finite.all(axis=1)][0]
        raise InputError(f"An action of the {world} world must be finite, not {wrong.tolist()}.")
    within: NDArray[np.float32] = np.minimum(np.maximum(actions, space.low), space.high)
    return within.astype(np.float32, copy=False)


def lane_at(lanes: Sequence[Lane | None], number: int, world: str) -> Lane:
    """Return lane `number` of a vector world.

    Raises:
        ResetNeeded: The lane has had no episode yet.
    """
    lane = lanes[number]
    if lane is None:
        raise gymnasium.error.ResetNeeded(f"Lane {number} of the {world} world has no episode: reset it.")
    return lane


def rows_by_task(tasks: Iterable[str]) -> dict[str, list[int]]:
    """Return the rows in which each task occurs, in the order of first occurrence."""
    rows: defaultdict[str, list[int]] = defaultdict(list)
    for row, task in enumerate(tasks):
        rows[task].append(row)
    return rows


class _OneTask(gymnasium.Wrapper[States, States, States, States]):
    """A world whose episodes have one task unless `reset` is told another."""

    def __init__(self, env: World, task: str) -> None:
        super().__init__(env)
        self.task = task

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[States, dict[str, Any]]:
        """Start an episode."""
        return self.env.reset(seed=seed, options={"task": self.task, **(options or {})})


def one_task(world: str, task: str, **options: Any) -> gymnasium.Env[States, States]:
    """Return a world whose episodes have one task: the environment that a Minari dataset recovers.

    Args:
        world: Entry point of the world.
        task: Name of the task.
        options: Arguments of the world, such as `render_mode`.
    """
    return _OneTask(resolve(world)(**options), task)
