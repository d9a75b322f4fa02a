"""The bodies of dm_control, stepped and observed with the same bits as its Python code, but without it."""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from clbench.base.errors import InputError
from clbench.worlds.perturbation import with_mass

from .state import ACTION_SIZE, OBSERVATION_SIZE, Observation

_ALONE = threading.Lock()
"""Held while dm_control's own physics begins an episode, or dm_control is imported: worlds share both."""


@dataclass(frozen=True)
class Body:
    """One domain of dm_control, with the step length of this suite."""

    name: str
    """Name of the domain."""
    substeps: int
    """Physics steps per action."""
    scale: tuple[float, ...]
    """Typical size of each observed number: experts train on numbers of about 1."""
    thing: str
    """Name of the part of the model that is heavier or lighter in perturbed episodes."""
    starts: tuple[float, ...]
    """Largest speed of each joint at a perturbed start, in m/s or rad/s, below the usual speeds of an
    episode. dm_control's bodies start nearly at rest."""
    camera: dict[str, Any]
    """Settings of the camera, see `clbench.worlds.world.Drawable`."""
    observer: Callable[[mujoco.MjModel, mujoco.MjData], Callable[[], Observation]]
    """Takes the physics of one episode and returns a function that reads dm_control's observation (K,) from
    it: the views of the physics, 0.3 us each, are made once."""


@dataclass(frozen=True, eq=False)
class Start:
    """A task of dm_control, from which episodes begin; all worlds of a process share it."""

    body: Body
    physics: Any
    """The `dm_control.mujoco.Physics` in which an episode is initialised, and from which it is copied."""
    task: Any
    """The `dm_control.suite.base.Task`."""
    model: mujoco.MjModel
    """The scene of all episodes. `physics` has one of its own: a reset briefly switches its motors off."""

    def begin(self, seed: int, data: mujoco.MjData) -> None:
        """Set `data` to the initial state that dm_control draws for a seed."""
        with _ALONE:
            self.task.random.seed(seed % 2**32)  # NumPy's generator takes no larger seed
            with self.physics.reset_context():
                self.task.initialize_episode(self.physics)
            mujoco.mj_copyData(data, self.model, self.physics.data.ptr)

    @functools.cached_property
    def _takes_whole_steps(self) -> bool:
        return bool(self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4)

    def advance(self, data: mujoco.MjData) -> None:
        """Advance `data` by one step in dm_control's order of calls, which keeps all positions current."""
        substeps = self.body.substeps
        if self._takes_whole_steps:
            mujoco.mj_step(self.model, data, substeps)
        else:
            mujoco.mj_step2(self.model, data)
            if substeps > 1:
                mujoco.mj_step(self.model, data, substeps - 1)
        mujoco.mj_step1(self.model, data)


@functools.cache
def start(body: str, task: str) -> Start:
    """Return the task `task` of dm_control's domain `body`; this takes 0.1 s, once per process.

    Raises:
        InputError: The body has more motors or more observed numbers than actions and states have places.
    """
    environment = original_environment(body, task)
    observed = sum(int(np.prod(spec.shape)) for spec in environment.observation_spec().values())
    motors = int(environment.action_spec().shape[0])
    if observed > OBSERVATION_SIZE:
        raise InputError(
            f"{body} is observed in {observed} numbers; a state has places for {OBSERVATION_SIZE}."
        )
    if motors > ACTION_SIZE:
        raise InputError(f"{body} has {motors} motors; an action has places for {ACTION_SIZE}.")
    model = copy.copy(environment.physics.model.ptr)
    return Start(BODY_OF[body], environment.physics, environment.task, model)


@functools.cache
def start_with_mass(body: str, task: str, mass: float) -> Start:
    """Return the result of `start` with a body's `thing` `mass` times as heavy; perturbed worlds share it."""
    plain = start(body, task)
    thing = int(plain.model.body(plain.body.thing).id)
    return replace(plain, model=with_mass(plain.model, [thing], mass))


def original_environment(domain: str, task: str) -> Any:
    """Return dm_control's own environment of a task."""
    with _ALONE, _without_dm_control_renderer():
        return importlib.import_module(f"dm_control.suite.{domain}").SUITE[task]()


@contextlib.contextmanager
def _without_dm_control_renderer() -> Iterator[None]:
    """Keep dm_control from looking for a screen on import: it warns of each renderer that fails."""
    before = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "off"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
        if before is not None:
            os.environ["MUJOCO_GL"] = before


def _position_and_velocity(_: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], Observation]:
    qpos, qvel = data.qpos, data.qvel
    return lambda: np.concatenate([qpos, qvel])


def _cartpole(model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], Observation]:
    qpos, qvel, axes = data.qpos, data.qvel, data.xmat[model.body("pole_1").id]
    return lambda: np.concatenate([qpos[:1], axes[[8, 2]], qvel])


def _camera(distance: float, x: float, z: float, elevation: float = 0.0) -> dict[str, Any]:
    return {
        "distance": distance,
        "azimuth": 90.0,
        "elevation": elevation,
        "lookat": np.array([x, 0.0, z]),
    }


BODY_OF = {
    body.name: body
    for body in (
        Body(
            "point_mass",
            8,
            (0.15, 0.15, 0.1, 0.1),
            "pointmass",
            (0.1, 0.1),
            _camera(0.75, 0.0, 0.0, -90.0),
            _position_and_velocity,
        ),
        Body(
            "cartpole",
            4,
            (0.7, 0.7, 0.7, 2.0, 4.0),
            "pole_1",
            (0.5, 0.5),
            _camera(4.0, 0.0, 1.2),
            _cartpole,
        ),
        Body(
            "ball_in_cup",
            20,
            (0.1, 0.1, 0.15, 0.15, 1.0, 1.0, 1.5, 1.5),
            "ball",
            (0.0, 0.0, 0.3, 0.3),
            _camera(1.2, 0.0, 0.45),
            _position_and_velocity,
        ),
    )
}
