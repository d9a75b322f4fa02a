"""The physics of the Fetch world: many episodes side by side, advanced by a pool of threads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.threads import Team
from clbench.worlds.world import checked_actions, no_episode

from .rules import RULES, Numbers, Rule
from .scene import Scene, mat2euler, scene, scene_with_mass
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

START = 0.025
"""Metres along each axis that a perturbed gripper starts beside its place, 4.3 cm at most: the target, from
`APART` on, is still farther away than the 5 cm that count as there."""
SETTLE = 10
"""Steps in which it gets there and comes to rest, as many as FetchPickAndPlace-v4 takes for its own start."""

REACH = 0.05
"""Metres along an axis that an action of 1 moves the goal of the hand."""
HAND_TURN = np.array([1.0, 0.0, 1.0, 0.0])
"""What gymnasium-robotics adds to the hand's quaternion for its goal, which keeps the hand pointing down."""

BLOCK_AXES, HAND, HAND_QUATERNION, MARKER = slice(6, 15), slice(15, 18), slice(18, 22), slice(22, 25)
"""Where they are in what is measured, after the places of the gripper (3,) and the block (3,)."""
JOINTS = 25
"""Where the positions of all joints begin there, which their speeds follow."""

Vectors = NDArray[np.float64]


class _Lane:
    """The physics of one episode, with views of what is read and set at each step.

    Asking MjData for a view costs 0.2 to 0.4 us each time.
    """

    def __init__(self, number: int, scene: Scene) -> None:
        self.number, self.scene = number, scene
        self.data = data = mujoco.MjData(scene.model)
        self.goal, self.goal_quaternion = data.mocap_pos[0], data.mocap_quat[0]
        self.control = data.ctrl
        self.rule: Rule = next(iter(RULES.values()))
        self.start: Numbers = []
        self.target = np.zeros(3)
        gripper, block, hand = scene.gripper_site, scene.block_site, scene.hand_body
        places, axes = (data.site_xpos[gripper], data.site_xpos[block]), data.site_xmat[block]
        self.parts = *places, axes, data.xpos[hand], data.xquat[hand], self.target, data.qpos, data.qvel
        """What is measured: places of the gripper and the block, the block's axes, place and quaternion of
        the hand, the target, positions and speeds of all joints."""

    def __deepcopy__(self, _: dict[int, Any]) -> _Lane:
        """Return a lane whose views are of its own physics."""
        lane = _Lane(self.number, self.scene)
        mujoco.mj_copyData(lane.data, self.scene.model, self.data)
        lane.rule, lane.start = self.rule, self.start
        lane.target[:] = self.target
        return lane


class FetchVectorWorld:
    """The scene, the physics and the observation of FetchPickAndPlace-v4, with the tasks of `RULES`.

    An action (4,) in [-1, 1] moves the gripper by up to 5 cm along x, y and z, of which the arm makes about
    3 cm a step, and opens (+1) or closes (-1) the fingers. The reward is that of `Rule.judge`. An episode
    ends with success only; whoever uses the world counts its steps. It is a `clbench.worlds.world.VectorWorld`.

    Args:
        lanes: Places for episodes. A lane takes its memory when it is first reset.
        threads: Threads that advance the physics; MuJoCo releases the interpreter lock. Results do not depend
            on it.
        perturbed: Whether the block is heavier or lighter, and the gripper starts elsewhere.
        rules: What each task asks for, by name.
    """

    def __init__(
        self, lanes: int, threads: int = 1, perturbed: bool = False, rules: Mapping[str, Rule] = RULES
    ) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._scene = scene()
        self._perturbed, self._rules = perturbed, rules
        self._lanes: list[_Lane | None] = [None] * lanes
        self._team = Team(threads)
        model = self._scene.model
        self._measured = np.zeros((lanes, JOINTS + model.nq + model.nv))
        """What is measured of each lane, see `_Lane.parts`."""
        self._jacobians = np.zeros((lanes, 3, 3, model.nv))
        """Of the gripper's and the block's place, and of the block's rotation, in each lane."""

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 28).

        The place of the block follows from the seed alone; it is that of FetchPickAndPlace-v4 where the block
        lies within reach there.

        Raises:
            LookupError: No task has this name; the nearest one is named.
        """
        for number, seed, task in zip(lanes, seeds, tasks, strict=True):
            if task not in self._rules:
                raise unknown("task of the Fetch world", task, self._rules)
            perturbation = draw_perturbation(seed) if self._perturbed else None
            lane = self._lane_of(number, scene_with_mass(perturbation.mass) if perturbation else self._scene)
            generator, _ = np_random(seed)
            block = self._place_block(generator)
            lane.rule = self._rules[task]
            lane.target[:] = self._place_target(block, lane.rule, generator)
            self._reset_physics(lane, block)
            if perturbation:
                self._displace(lane, perturbation.start)
        begun = [self._lane(number) for number in lanes]
        states = self._observe(begun)
        for lane, state in zip(begun, states.tolist(), strict=True):
            lane.start = state
        return states

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Move each of `lanes` for one step of 0.04 s by its row of actions (N, 4).

        Returns the states (N, 28), the rewards (N,) and which of the episodes succeeded (N,).

        Raises:
            ValueError: An action has another shape than (4,), or a number in it is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "Fetch")
        moved = [self._lane(number) for number in lanes]
        self._act(moved, actions)
        self._team.each(self._advance, moved)
        states = self._observe(moved)
        judged = [lane.rule.judge(now, lane.start) for lane, now in zip(moved, states.tolist(), strict=True)]
        rewards, successes = zip(*judged, strict=True)
        return states, np.array(rewards), np.array(successes)

    def picture_data(self, lane: int) -> mujoco.MjData:
        """Return the physics of a lane, with the target marker at its place, to draw it and no more."""
        data = self._lane(lane).data
        # The place of a site is an output of the physics: the next step computes it again and never reads it.
        data.site_xpos[self._scene.target_site] = self._lane(lane).target
        return data

    def close(self) -> None:
        """End the threads."""
        self._team.close()

    def _lane(self, number: int) -> _Lane:
        lane = self._lanes[number]
        if lane is None:
            raise no_episode(number, "Fetch")
        return lane

    def _lane_of(self, number: int, scene: Scene) -> _Lane:
        """Return a lane that has the physics of a scene; it is made anew if it had that of another one."""
        lane = self._lanes[number]
        if lane is None or lane.scene is not scene:
            self._lanes[number] = lane = _Lane(number, scene)
        return lane

    def _place_block(self, generator: np.random.Generator) -> Vectors:
        """Return a place (2,) on the table, drawn as FetchPickAndPlace-v4 does, but within reach."""
        gripper = self._scene.gripper[:2]
        block = gripper
        while np.linalg.norm(block - gripper) < APART or block[0] > gripper[0] + REACH_AWAY:
            block = gripper + generator.uniform(-SPREAD, SPREAD, size=2)
        return block

    def _place_target(self, block: Vectors, rule: Rule, generator: np.random.Generator) -> Vectors:
        """Return a place (3,) for the marker: apart from the gripper, and beside the block (2,)."""
        gripper = self._scene.gripper
        while True:
            target = gripper + generator.uniform(-SPREAD, SPREAD, size=3)
            target[2] = self._scene.rest_height
            if not rule.target_on_table and generator.uniform() < 0.5:
                target[2] += generator.uniform(*TARGET_HEIGHTS)
            way = float(np.linalg.norm(target[:2] - block))
            if APART <= way <= NEARBY and np.linalg.norm(target - gripper) >= APART:
                return target

    def _reset_physics(self, lane: _Lane, block: Vectors) -> None:
        """Put the arm at its start and the block at `block` (2,), and forget all that was before."""
        scene, data = lane.scene, lane.data
        # Clears controls, mocap, and the solver's warm start too.
        mujoco.mj_resetData(scene.model, data)
        data.time = scene.time
        data.qpos[:] = scene.qpos
        data.qvel[:] = scene.qvel
        data.qpos[scene.block_qpos : scene.block_qpos + 2] = block
        mujoco.mj_forward(scene.model, data)
        self._measure(lane)

    def _displace(self, lane: _Lane, start: tuple[float, float, float]) -> None:
        """Move the gripper by a share `start` of `START` along each axis, and let it come to rest."""
        self._act([lane], np.array([[*(START / REACH * one for one in start), 0.0]], np.float32))
        mujoco.mj_step(lane.scene.model, lane.data, nstep=SETTLE * lane.scene.substeps)
        self._measure(lane)

    def _act(self, lanes: Sequence[_Lane], actions: NDArray[np.float32]) -> None:
        """Set the hands' goals and the fingers' controls, in the arithmetic of gymnasium-robotics."""
        now = self._measured[[lane.number for lane in lanes]]
        hands = now[:, HAND] + actions[:, :3] * np.float32(REACH)
        quaternions = now[:, HAND_QUATERNION] + HAND_TURN
        fingers = now[:, JOINTS + self._scene.actuators_qpos] + actions[:, 3:].astype(float)
        for lane, hand, quaternion, finger in zip(lanes, hands, quaternions, fingers, strict=True):
            lane.goal[:], lane.goal_quaternion[:], lane.control[:] = hand, quaternion, finger

    def _advance(self, lane: _Lane) -> None:
        """Advance the physics of a lane by one step."""
        mujoco.mj_step(lane.scene.model, lane.data, nstep=lane.scene.substeps)
        self._measure(lane)

    def _measure(self, lane: _Lane) -> None:
        """Note all that is read of a lane: a thread that has just advanced it has it in its caches."""
        model, number = lane.scene.model, lane.number
        np.concatenate(lane.parts, out=self._measured[number])
        gripper, block, rotation = self._jacobians[number]
        mujoco.mj_jacSite(model, lane.data, gripper, None, lane.scene.gripper_site)
        mujoco.mj_jacSite(model, lane.data, block, rotation, lane.scene.block_site)

    def _observe(self, lanes: Sequence[_Lane]) -> State:
        """Return the states (N, 28): gymnasium-robotics' arithmetic in double precision, then rounded."""
        scene, seconds = self._scene, self._scene.step_seconds
        numbers = [lane.number for lane in lanes]
        now, jacobians = self._measured[numbers], self._jacobians[numbers]
        gripper, block, speeds = now[:, :3], now[:, 3:6], now[:, JOINTS + scene.model.nq :]
        velocities = (jacobians @ speeds[:, None, :, None])[..., 0] * seconds
        gripper_velocity, block_velocity, block_spin = velocities.swapaxes(0, 1)
        states = np.empty((len(lanes), SIZE), np.float32)
        states[:, GRIPPER] = gripper
        states[:, BLOCK] = block
        states[:, BLOCK_FROM_GRIPPER] = block - gripper
        states[:, FINGERS] = now[:, JOINTS + scene.fingers_qpos]
        states[:, BLOCK_ANGLES] = mat2euler(now[:, BLOCK_AXES].reshape(-1, 3, 3))
        states[:, BLOCK_FROM_GRIPPER_VELOCITY] = block_velocity - gripper_velocity
        states[:, BLOCK_SPIN] = block_spin
        states[:, GRIPPER_VELOCITY] = gripper_velocity
        states[:, FINGERS_VELOCITY] = speeds[:, scene.fingers_qvel] * seconds
        states[:, TARGET] = now[:, MARKER]
        return states
