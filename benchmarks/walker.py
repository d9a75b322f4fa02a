"""dm_control's walker, with episodes side by side as in our scenarios.

No scenario includes it: its six motors and 24 numbers do not fit the shared spaces of `DMControl-v0`. The
benchmarks use it because it is the usual body for measuring vector environments.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from itertools import chain
from typing import Any

import mujoco
import numpy as np
from dm_control.utils.rewards import tolerance
from gymnasium import spaces
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

import clbench
from clbench.base.entry_points import resolve
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.threads import Team
from clbench.worlds.world import OneLaneWorld, Outcomes, States, checked_actions

ID = "walker/Walker-v0"
SUBSTEPS, SECONDS = 10, 0.025
"""Physics steps per action, and their duration: dm_control's own."""


@functools.cache
def _start() -> Any:
    """Return the start of episodes, in the same type as our scenario's bodies."""
    scene = "clbench.envs.dm_control.scene"
    environment = resolve(f"{scene}:original_environment")("walker", "walk")
    body = resolve(f"{scene}:Body")("walker", SUBSTEPS, (), "torso", (), {}, _views)
    physics = environment.physics
    return resolve(f"{scene}:Start")(body, physics, environment.task, physics.model.ptr)


def _views(model: mujoco.MjModel, data: mujoco.MjData) -> Any:
    """Return views of the observation and of the inputs of the reward."""
    torso, speed = model.body("torso").id, model.sensor("torso_subtreelinvel").adr[0]
    height, velocity = data.xpos[torso][2:], data.sensordata[speed : speed + 1]
    return data.xmat[1:].reshape(-1), height, data.qvel, data.xmat[torso][8:], velocity


class WalkerVectorWorld:
    """Walkers with dm_control's physics, observations and rewards; no episode ends with success.

    It is a `clbench.worlds.world.VectorWorld`; an action (6,) sets the motors for one step.

    Args:
        lanes: Number of lanes.
        threads: Number of threads that advance the physics.
    """

    def __init__(self, lanes: int, threads: int = 1) -> None:
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (24,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self._data = [mujoco.MjData(_start().model) for _ in range(lanes)]
        self._controls = [data.ctrl for data in self._data]
        self._views = [_views(_start().model, data) for data in self._data]
        self._team = Team(threads)

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> States:
        """Start an episode in each of `lanes`, and return the states (N, 24)."""
        for lane, seed in zip(lanes, seeds, strict=True):
            _start().begin(seed, self._data[lane])
        return self._observe(lanes)[0]

    def step(self, lanes: Sequence[int], actions: NDArray[np.float32]) -> Outcomes:
        """Move each of `lanes` by its row of actions (N, 6)."""
        actions = checked_actions(actions, self.single_action_space, "walker", len(lanes))
        for lane, action in zip(lanes, actions, strict=True):
            self._controls[lane][:] = action
        self._team.each(_start().advance, [self._data[lane] for lane in lanes])
        states, (height, upright, velocity) = self._observe(lanes)
        standing = tolerance(height, bounds=(1.2, np.inf), margin=0.6)
        walking = tolerance(velocity, (1.0, np.inf), margin=0.5, value_at_margin=0.5, sigmoid="linear")
        rewards = (3 * standing + (1 + upright) / 2) / 4 * (5 * walking + 1) / 6
        return states, rewards, np.zeros(len(lanes), np.bool_)

    def picture(self, lane: int) -> NDArray[np.uint8]:
        """Draw the walker of a lane, (480, 480, 3)."""
        renderer = MujocoRenderer(_start().model, self._data[lane], None, 480, 480, camera_id=0)
        picture: NDArray[np.uint8] = renderer.render("rgb_array")
        renderer.close()  # type: ignore[no-untyped-call]
        return picture

    def _observe(self, lanes: Sequence[int]) -> tuple[States, NDArray[np.float64]]:
        """Return the states (N, 24), and height, uprightness and velocity of each torso (3, N)."""
        views = [self._views[lane] for lane in lanes]
        numbers = np.concatenate([*chain.from_iterable(views)]).reshape(len(lanes), -1)
        axes, rest = numbers[:, :63].reshape(len(lanes), -1, 9), numbers[:, 63:-2]
        states = np.concatenate([axes[:, :, [0, 2]].reshape(len(lanes), -1), rest], axis=1, dtype=np.float32)
        return states, numbers[:, [63, -2, -1]].T

    def close(self) -> None:
        """End the threads."""
        self._team.close()


class WalkerWorld(OneLaneWorld):
    """A `WalkerVectorWorld` with one lane."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 40}  # noqa: RUF012
    vector_world = WalkerVectorWorld
    first_task = "walk"

    def picture(self) -> NDArray[np.uint8]:
        """Draw the walker, (480, 480, 3)."""
        picture: NDArray[np.uint8] = self._world.picture(0)
        return picture


QUESTIONS = ()
"""No questions are asked, but the length of texts depends on questions, too."""
WALK = Task("walk", "dm_control", ("walk",), 100, "walker:WalkerWorld", "walker:nobody")
SCENARIO = Scenario(
    id=ID,
    description="A walker walks.",
    retained=(),
    target=(WALK,),
    held_out=(),
    questions="walker:QUESTIONS",
    scenes=(WALK,),
)
clbench.register(ID, "walker:SCENARIO")
