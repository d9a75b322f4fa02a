"""The Fetch world: a robot arm, a table, a block and a target marker, as one Gymnasium environment."""

from __future__ import annotations

import contextlib
import functools
import io
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer
from numpy.typing import NDArray

from clbench.task import unknown

from .rules import RULES, Rule
from .state import (
    BLOCK,
    BLOCK_ANGLES,
    BLOCK_FROM_GRIPPER,
    BLOCK_FROM_GRIPPER_VELOCITY,
    BLOCK_SPIN,
    FINGERS,
    FINGERS_VELOCITY,
    GRIPPER,
    GRIPPER_VELOCITY,
    SIZE,
    TARGET,
    State,
)

# Else each worker prints a notice about Adroit's hand, which is not used here.
with contextlib.redirect_stderr(io.StringIO()):
    from gymnasium_robotics.envs.fetch.fetch_env import DEFAULT_CAMERA_CONFIG
    from gymnasium_robotics.envs.fetch.pick_and_place import MujocoFetchPickAndPlaceEnv
    from gymnasium_robotics.utils.rotations import mat2euler

REACH_AWAY = 0.09
"""How far in front of the gripper the block may start: else a push away would end beside the table."""
SPREAD = 0.15
"""Half the side of the square around the gripper in which block and target lie, as in FetchPickAndPlace."""
TARGET_HEIGHTS = (0.08, 0.30)
"""How far above the table, from the centre of a block at rest, a target in the air lies."""
APART = 0.10
"""Least distance from block to gripper, and from target to both: no task is nearly done at the start."""


NEARBY = 0.20
"""Most distance from target to block in the plane: on a longer way a block slips sideways off the fingers."""


@dataclass(frozen=True)
class _Scene:
    """The compiled scene and what is fixed in it. All worlds of a process share it and only read."""

    model: mujoco.MjModel
    time: float
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    gripper: NDArray[np.float64]
    """Position of the gripper at the start (3,)."""
    rest_height: float
    step_seconds: float
    substeps: int
    gripper_site: int
    block_site: int
    target_site: int
    hand_body: int
    block_qpos: int
    fingers_qpos: NDArray[np.int64]
    """Addresses of the right and the left finger (2,)."""
    fingers_qvel: NDArray[np.int64]
    actuators_qpos: NDArray[np.int64]
    """Addresses of the joints that the actuators move (2,)."""


@functools.cache
def _scene() -> _Scene:
    """Return the scene of FetchPickAndPlace-v4 with its arm moved to the start: 0.2 s, once per process."""
    original = MujocoFetchPickAndPlaceEnv()
    model = original.model

    def site(name: str) -> int:
        return int(model.site(name).id)

    fingers = [model.joint(f"robot0:{side}_gripper_finger_joint") for side in ("r", "l")]
    return _Scene(
        model=model,
        time=original.initial_time,
        qpos=original.initial_qpos,
        qvel=original.initial_qvel,
        gripper=original.initial_gripper_xpos,
        rest_height=float(original.height_offset),
        step_seconds=original.dt,
        substeps=original.n_substeps,
        gripper_site=site("robot0:grip"),
        block_site=site("object0"),
        target_site=site("target0"),
        hand_body=int(model.body("robot0:gripper_link").id),
        block_qpos=int(model.joint("object0:joint").qposadr[0]),
        fingers_qpos=np.array([finger.qposadr[0] for finger in fingers]),
        fingers_qvel=np.array([finger.dofadr[0] for finger in fingers]),
        actuators_qpos=model.jnt_qposadr[model.actuator_trnid[:, 0]].astype(np.int64),
    )


class FetchWorld(gymnasium.Env[State, NDArray[np.float32]]):
    """The scene, the physics and the observation of FetchPickAndPlace-v4, with the tasks of `RULES`.

    An action (4,) in [-1, 1] moves the gripper by up to 5 cm along x, y and z, of which the arm makes about
    3 cm a step, and opens (+1) or closes (-1) the fingers. The reward is that of `Rule.judge`. An episode
    ends with success only; whoever uses the world counts its steps.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._scene = _scene()
        self._data = mujoco.MjData(self._scene.model)
        self._renderer: MujocoRenderer | None = None
        self._task = next(iter(RULES))
        self._target = np.zeros(3)
        self._start = np.zeros(SIZE, np.float32)
        # Filled anew by each observation: allocating them costs as much as filling them.
        self._jacobian = np.zeros((3, self._scene.model.nv))
        self._rotation_jacobian = np.zeros((3, self._scene.model.nv))

    @property
    def _rule(self) -> Rule:
        return RULES[self._task]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Start an episode of the task `options["task"]`, by default the first.

        The place of the block follows from the seed alone; it is that of FetchPickAndPlace-v4 where the block
        lies within reach there.

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        task = (options or {}).get("task", next(iter(RULES)))
        if task not in RULES:
            raise unknown("task of the Fetch world", task, RULES)
        super().reset(seed=seed)
        self._task = task
        block = self._place_block()
        self._reset_physics(block)
        self._target = self._place_target(block)
        self._start = self._observe()
        return self._start.copy(), {"success": False, "task": self._task}

    def step(self, action: NDArray[np.float32]) -> tuple[State, float, bool, bool, dict[str, Any]]:
        """Move for one step of 0.04 s.

        Raises:
            ValueError: The action has another shape than (4,), or a number in it is not finite.
        """
        action = np.asarray(action, np.float32)
        if action.shape != (4,):
            raise ValueError(f"An action of the Fetch world has shape (4,), not {action.shape}.")
        if not np.isfinite(action).all():
            raise ValueError(f"An action of the Fetch world is finite, not {action.tolist()}.")
        self._act(np.clip(action, -1.0, 1.0))
        mujoco.mj_step(self._scene.model, self._data, nstep=self._scene.substeps)
        state = self._observe()
        reward, success = self._rule.judge(state, self._start)
        return state, reward, success, False, {"success": success, "task": self._task}

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3) of the scene if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = MujocoRenderer(self._scene.model, self._data, DEFAULT_CAMERA_CONFIG, 480, 480)
        # The place of a site is an output of the physics: the next step computes it again and never reads it.
        self._data.site_xpos[self._scene.target_site] = self._target
        picture: NDArray[np.uint8] = self._renderer.render(self.render_mode)
        return picture

    def close(self) -> None:
        """Free the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()  # type: ignore[no-untyped-call]
            self._renderer = None

    def _place_block(self) -> NDArray[np.float64]:
        """Return a place (2,) on the table, drawn as FetchPickAndPlace-v4 does, but within reach."""
        gripper = self._scene.gripper[:2]
        block = gripper
        while np.linalg.norm(block - gripper) < APART or block[0] > gripper[0] + REACH_AWAY:
            block = gripper + self.np_random.uniform(-SPREAD, SPREAD, size=2)
        return block

    def _place_target(self, block: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a place (3,) for the marker: apart from the gripper, and beside the block (2,)."""
        gripper = self._scene.gripper
        while True:
            target = gripper + self.np_random.uniform(-SPREAD, SPREAD, size=3)
            target[2] = self._scene.rest_height
            if not self._rule.target_on_table and self.np_random.uniform() < 0.5:
                target[2] += self.np_random.uniform(*TARGET_HEIGHTS)
            way = float(np.linalg.norm(target[:2] - block))
            if APART <= way <= NEARBY and np.linalg.norm(target - gripper) >= APART:
                return target

    def _reset_physics(self, block: NDArray[np.float64]) -> None:
        """Put the arm at its start and the block at `block` (2,), and forget all that was before."""
        scene, data = self._scene, self._data
        # Clears controls, mocap, and the solver's warm start too.
        mujoco.mj_resetData(scene.model, data)
        data.time = scene.time
        data.qpos[:] = scene.qpos
        data.qvel[:] = scene.qvel
        data.qpos[scene.block_qpos : scene.block_qpos + 2] = block
        mujoco.mj_forward(scene.model, data)

    def _act(self, action: NDArray[np.float32]) -> None:
        """Set the hand's goal and the fingers' controls, in the arithmetic of gymnasium-robotics."""
        scene, data = self._scene, self._data
        data.mocap_pos[0] = data.xpos[scene.hand_body] + action[:3] * np.float32(0.05)
        data.mocap_quat[0] = data.xquat[scene.hand_body] + (1.0, 0.0, 1.0, 0.0)
        data.ctrl[:] = data.qpos[scene.actuators_qpos] + float(action[3])

    def _observe(self) -> State:
        """Return the state (28,), computed as gymnasium-robotics does, in double precision, then rounded."""
        scene, data = self._scene, self._data
        qvel, seconds = data.qvel, scene.step_seconds
        gripper, block = data.site_xpos[scene.gripper_site], data.site_xpos[scene.block_site]
        mujoco.mj_jacSite(scene.model, data, self._jacobian, None, scene.gripper_site)
        gripper_velocity = self._jacobian @ qvel * seconds
        mujoco.mj_jacSite(scene.model, data, self._jacobian, self._rotation_jacobian, scene.block_site)
        state = np.empty(SIZE, np.float32)
        state[GRIPPER] = gripper
        state[BLOCK] = block
        state[BLOCK_FROM_GRIPPER] = block - gripper
        state[FINGERS] = data.qpos[scene.fingers_qpos]
        state[BLOCK_ANGLES] = mat2euler(data.site_xmat[scene.block_site].reshape(3, 3))
        state[BLOCK_FROM_GRIPPER_VELOCITY] = self._jacobian @ qvel * seconds - gripper_velocity
        state[BLOCK_SPIN] = self._rotation_jacobian @ qvel * seconds
        state[GRIPPER_VELOCITY] = gripper_velocity
        state[FINGERS_VELOCITY] = qvel[scene.fingers_qvel] * seconds
        state[TARGET] = self._target
        return state
