"""The problems of LIBERO: each is a task in its scene, with a goal, initial states and places of fixtures."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown

from .original import TASKS, RandomizationError, environment, initial_states
from .rules import Predicate, goal_of
from .scene import Places, Scene, Vector, heavier, scene_of
from .state import THINGS


@dataclass(frozen=True, eq=False)
class Problem:
    """A task of LIBERO, shared by all its episodes in a process."""

    scene: Scene
    goal: Sequence[Predicate]
    """Predicates that hold together when the task is done."""
    starts: Vector
    """LIBERO's initial states, (50, 1 + nq + nv): time, positions and velocities of the joints."""
    things: NDArray[np.int64]
    """Bodies of the objects and fixtures in the order of their names."""
    slots: NDArray[np.int64]
    """Numbers of these among all `THINGS`."""
    parts: NDArray[np.int64]
    """Addresses of the positions of drawers and knobs."""
    fixtures: dict[str, int]
    """Bodies of the fixtures by name. Their places are no joints, and therefore in no state of LIBERO."""
    original: Any
    """LIBERO's environment of the task, for its samplers; nobody steps it."""

    def start(self, seed: int) -> tuple[Vector, Places]:
        """Return the first state of an episode, as in `starts` (1 + nq + nv,), and the places of all bodies.

        Seeds below 50 are numbers of LIBERO's initial states. For any other seed LIBERO draws a state, as it
        drew those: 50 are too few for demonstrations and test episodes that have none in common.
        """
        if 0 <= seed < len(self.starts):
            return self.starts[seed], self.places(seed)
        sim = self.original.sim
        with _own_randomness(seed):
            while True:
                sim.reset()
                sim.model.body_pos[:], sim.model.body_quat[:] = self.scene.places
                try:
                    self.original._reset_internal()
                    break
                except RandomizationError:  # things overlap: LIBERO draws all again
                    continue
        start = np.concatenate(([0.0], sim.data.qpos, np.zeros(self.scene.model.nv)))
        return start, (sim.model.body_pos.copy(), sim.model.body_quat.copy())

    def places(self, seed: int) -> Places:
        """Return the places of all bodies in an initial state of LIBERO; its sampler draws those of fixtures.

        In LIBERO they depend on all resets before, and its initial states do not contain them.
        """
        positions, quaternions = (part.copy() for part in self.scene.places)
        drawn = _drawn(self.original.placement_initializer, seed)
        for name, body in self.fixtures.items():
            positions[body], quaternions[body], _ = drawn[name]
        return positions, quaternions

    def is_solved(self, data: mujoco.MjData) -> bool:
        """Return whether the goal holds."""
        return all(predicate(data) for predicate in self.goal)


@functools.cache
def problem_of(task: str) -> Problem:
    """Return the problem of a task; the first one in a scene compiles it.

    Raises:
        UnknownNameError: LIBERO has no task of this name; the error names the nearest one.
    """
    if task not in TASKS:
        raise unknown("task of the LIBERO world", task, TASKS)
    scenes: list[Scene] = []

    def compiled(xml: str) -> mujoco.MjModel:
        scenes.append(scene_of(xml))
        return scenes[-1].model

    with _own_randomness(0):
        env = environment(task, compiled)
    scene, model = scenes[-1], scenes[-1].model
    fixtures = {name: int(model.body(one.root_body).id) for name, one in env.fixtures_dict.items()}
    objects = {name: int(model.body(one.root_body).id) for name, one in env.objects_dict.items()}
    bodies = {**fixtures, **objects}
    names = sorted(bodies)
    of_fixtures = np.isin(model.body_rootid[model.jnt_bodyid], list(fixtures.values()))
    return Problem(
        scene,
        goal_of(env, model),
        initial_states(task),
        np.array([bodies[name] for name in names]),
        np.array([THINGS.index(name) for name in names]),
        model.jnt_qposadr[of_fixtures].astype(np.int64),
        fixtures,
        env,
    )


@functools.cache
def heavier_problem_of(task: str, mass: float) -> Problem:
    """Return the problem of a task whose objects are `mass` times as heavy."""
    problem = problem_of(task)
    return replace(problem, scene=heavier(problem.scene, mass))


def _drawn(sampler: Any, seed: int) -> dict[str, Any]:
    """Return the places that LIBERO's sampler draws, and draw all again if things overlap, as LIBERO does."""
    with _own_randomness(seed):
        while True:
            try:
                places: dict[str, Any] = sampler.sample()
            except RandomizationError:
                continue
            return places


@contextlib.contextmanager
def _own_randomness(seed: int) -> Iterator[None]:
    """Seed the global generator of numpy, from which LIBERO draws, and leave no trace in it."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002
