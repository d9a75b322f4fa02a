"""The problems of LIBERO: each is a task in its scene, with a goal, initial states and places of fixtures."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError

from .original import TASKS, RandomizationError, environment, initial_states
from .rules import PREDICATES, Predicate, goal_of
from .scene import Places, Scene, Vector, heavier, scene_of
from .state import THINGS

OVERLAP = 0.008
"""Largest overlap in metres of two things in a drawn state; other states are drawn again. LIBERO's samplers
treat things as circles, and put the bowl up to 7.5 mm into the plate in the 50 stored states of a task. Of
the bowls that were deeper, the expert brought 8 of 17 to the plate, and 59 of 63 other bowls: the physics
throws deep bowls away.
"""


@dataclass(frozen=True, eq=False)
class Problem:
    """A task of LIBERO, shared by all its episodes in a process."""

    scene: Scene
    plain: Scene
    """The scene with objects of their own mass, in which LIBERO draws the starts and things fall to rest."""
    goal: Sequence[Predicate]
    """Predicates that hold together when the task is done."""
    starts: Vector
    """LIBERO's initial states, (50, 1 + nq + nv): time, positions and velocities of the joints."""
    things: NDArray[np.int64]
    """Bodies of the objects and fixtures in the order of their names."""
    slots: NDArray[np.int64]
    """Numbers of these things among all `THINGS`."""
    parts: NDArray[np.int64]
    """Addresses of the positions of drawers and knobs."""
    fixtures: dict[str, int]
    """Bodies of the fixtures by name. Their places are not joints, so no state of LIBERO contains them."""
    lights: dict[int, Predicate]
    """Sites that are drawn while a predicate holds: the burner of a stove, red while the stove is on."""
    original: Any
    """LIBERO's environment of the task, for its samplers; nobody steps it."""

    def start(self, seed: int) -> tuple[Vector, Places]:
        """Return the first state of an episode, as in `starts` (1 + nq + nv,), and the places of all bodies.

        Seeds below 50 are numbers of LIBERO's initial states. For any other seed LIBERO draws a state, as it
        drew those: with only 50, demonstrations and test episodes would have states in common.
        """
        if 0 <= seed < len(self.starts):
            return self.starts[seed], self.places(seed)
        sim, models = self.original.sim, self.plain.models
        with _own_randomness(seed):
            sim.model._model = model = models.take()  # no other thread moves its fixtures now
            try:
                self._draw(sim)
                start = np.concatenate(([0.0], sim.data.qpos, np.zeros(model.nv)))
                return start, (model.body_pos.copy(), model.body_quat.copy())
            finally:
                models.give_back(model)

    def _draw(self, sim: Any) -> None:
        """Let LIBERO draw a state in its environment."""
        while True:
            sim.reset()
            sim.model.body_pos[:], sim.model.body_quat[:] = self.plain.places
            try:
                self.original._reset_internal()
            except RandomizationError:  # things overlap: LIBERO draws all again
                continue
            if _overlap(sim.model._model, sim.data.qpos) <= OVERLAP:
                return

    def places(self, seed: int) -> Places:
        """Return the places of all bodies in an initial state of LIBERO, whose sampler places the fixtures.

        In LIBERO they depend on all earlier resets, and its initial states do not contain them.
        """
        positions, quaternions = (part.copy() for part in self.scene.places)
        drawn = _drawn(self.original.placement_initializer, seed)
        for name, body in self.fixtures.items():
            positions[body], quaternions[body], _ = drawn[name]
        return positions, quaternions

    def places_in(self, xml: str) -> Places:
        """Return the places of all bodies, with the fixtures where a scene in MJCF has them.

        Raises:
            InputError: The text is not a scene of this task.
        """
        positions, quaternions = (part.copy() for part in self.scene.places)
        try:
            bodies = {body.get("name"): body for body in ElementTree.fromstring(xml).iter("body")}
        except ElementTree.ParseError as error:
            raise InputError(f"model_file is not XML: {error}") from error
        for body in self.fixtures.values():
            name = self.scene.model.body(body).name
            if name not in bodies:
                raise InputError(f"model_file has no body {name}")
            positions[body] = bodies[name].get("pos", "0 0 0").split()
            quaternions[body] = bodies[name].get("quat", "1 0 0 0").split()
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
    lights = {
        int(model.site(site).id): PREDICATES["turnon"](env, model, name)
        for name in env.visualization_sites_list
        for site, _ in env.get_object(name).object_properties["vis_site_names"].values()
    }
    names = sorted(bodies)
    of_fixtures = np.isin(model.body_rootid[model.jnt_bodyid], list(fixtures.values()))
    return Problem(
        scene,
        scene,
        goal_of(env, model),
        initial_states(task),
        np.array([bodies[name] for name in names]),
        np.array([THINGS.index(name) for name in names]),
        model.jnt_qposadr[of_fixtures].astype(np.int64),
        fixtures,
        lights,
        env,
    )


@functools.cache
def heavier_problem_of(task: str, mass: float) -> Problem:
    """Return the problem of a task whose objects are `mass` times as heavy."""
    problem = problem_of(task)
    return replace(problem, scene=heavier(problem.scene, mass))


def _overlap(model: mujoco.MjModel, positions: Vector) -> float:
    """Return the largest overlap, in metres, of two things that can move.

    In libero_object all things begin up to 4 cm inside the floor, which lifts them at once.

    Args:
        model: The scene, with its fixtures in place.
        positions: Positions of the joints (nq,).
    """
    data = mujoco.MjData(model)
    data.qpos[:] = positions
    mujoco.mj_fwdPosition(model, data)
    contact = data.contact
    things = model.body_rootid[model.geom_bodyid[contact.geom]]
    apart = (things[:, 0] != things[:, 1]) & (model.body_dofnum[things] > 0).all(axis=1)
    return max(0.0, -float(contact.dist[apart].min(initial=0.0)))


def _drawn(sampler: Any, seed: int) -> dict[str, Any]:
    """Return the places that LIBERO's sampler draws, and draw all again if things overlap, as LIBERO does."""
    with _own_randomness(seed):
        while True:
            try:
                places: dict[str, Any] = sampler.sample()
            except RandomizationError:
                continue
            return places


_DRAWING = threading.RLock()
"""Threads draw one after the other: LIBERO draws into its environment, from one generator for all."""


@contextlib.contextmanager
def _own_randomness(seed: int) -> Iterator[None]:
    """Seed the global generator of numpy, from which LIBERO draws, and leave no trace in it."""
    with _DRAWING:
        before = np.random.get_state()  # noqa: NPY002
        np.random.seed(seed % 2**32)  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(before)  # noqa: NPY002
