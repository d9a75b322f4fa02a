"""The physics of the Fetch world: many episodes side by side, advanced by threads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.threads import Team
from clbench.worlds.world import Drawable, checked_actions, lane_at

from .rules import RULES, Numbers, Rule
from .scene import CAMERA, Scene, mat2euler, scene, scene_with_mass
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
"""Largest distance in metres of the block in front of the gripper: a push away must end on the table."""
SPREAD = 0.15
"""Half the side in metres of the square around the gripper for block and target, as in FetchPickAndPlace."""
TARGET_HEIGHTS = (0.08, 0.30)
"""Lowest and highest target in the air, in metres above the centre of a block at rest."""
APART = 0.10
"""Smallest distance in metres between block, gripper and target: no task is nearly done at the start."""
NEARBY = 0.20
"""Largest horizontal distance in metres from target to block: over longer ones the block slips away."""

START = 0.025
"""Largest displacement in metres of a perturbed gripper along each axis, 4.3 cm in all. As a target is at
least `APART` away, it stays farther than the 5 cm that count as success."""
SETTLE = 10
"""Steps until the displaced gripper is at rest, as many as FetchPickAndPlace-v4 takes for its own start."""

BLOCK_CORNER, TARGET_CORNER = (1.12, 1.03), (1.48, 0.47)
"""Corners of the table, in metres, for things that a task does not need, out of the gripper's way."""
HELD = 0.0249
"""Position of each finger in metres around the block, which is 0.05 wide."""
GRASP = 3
"""Steps until the fingers hold the block."""

REACH = 0.05
"""Distance in metres along an axis by which an action of 1 moves the goal of the hand."""
HAND_TURN = np.array([1.0, 0.0, 1.0, 0.0])
"""Added by gymnasium-robotics to the quaternion of the hand's goal, to keep the hand pointing down."""

BLOCK_AXES, HAND, HAND_QUATERNION, MARKER = slice(6, 15), slice(15, 18), slice(18, 22), slice(22, 25)
"""Places of these values in a lane's measurements, after the positions of gripper (3,) and block (3,)."""
JOINTS = 25
"""First place of the joint positions in the measurements; the joint speeds follow."""

Vectors = NDArray[np.float64]


class _Lane:
    """The physics of one episode, with views of all arrays that a step reads and sets.

    Each request to MjData for a view takes 0.2 to 0.4 us.
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
        """The measurements: positions of the gripper and the block, the block's axes, position and quaternion
        of the hand, the target, positions and speeds of all joints."""

    def __deepcopy__(self, _: dict[int, Any]) -> _Lane:
        """Return a lane with its own physics and views of it."""
        lane = _Lane(self.number, self.scene)
        mujoco.mj_copyData(lane.data, self.scene.model, self.data)
        lane.rule, lane.start = self.rule, self.start
        lane.target[:] = self.target
        return lane


class FetchVectorWorld:
    """The scene, the physics and the observation of FetchPickAndPlace-v4, with the tasks of `RULES`.

    An action (4,) in [-1, 1] moves the goal of the gripper by up to 5 cm along x, y and z, and opens (+1)
    or closes (-1) the fingers. In a step of 0.04 s the arm covers about 3 cm of the way. The
    reward is minus the metres that the gripper and the block still have to move, plus 1 on success.

    It is a `clbench.worlds.world.VectorWorld`. `Rule.judge` computes the reward. Only success ends an
    episode; the caller counts its steps.

    Args:
        lanes: Number of lanes. A lane allocates its memory at its first reset.
        threads: Number of threads that advance the physics; MuJoCo releases the interpreter lock. Results do
            not depend on their number.
        perturbed: Whether the block is heavier or lighter, and the gripper starts elsewhere.
        rules: Definition of each task by name.
    """

    perturbable: ClassVar[bool] = True

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
        """Measurements of each lane, see `_Lane.parts`."""
        self._jacobians = np.zeros((lanes, 3, 3, model.nv))
        """Jacobians of the gripper's position, the block's position and the block's rotation in each lane."""

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 28).

        The seed alone determines the place of the block, which is the same as in FetchPickAndPlace-v4 if that
        place is within reach.

        Raises:
            UnknownNameError: No task has this name; the error names the nearest one.
        """
        for number, seed, task in zip(lanes, seeds, tasks, strict=True):
            if task not in self._rules:
                raise unknown("task of the Fetch world", task, self._rules)
            perturbation = draw_perturbation(seed) if self._perturbed else None
            lane = self._lane_of(number, scene_with_mass(perturbation.mass) if perturbation else self._scene)
            generator, _ = np_random(seed)
            lane.rule = self._rules[task]
            block = self._place_block(generator)
            lane.target[:] = self._place_target(block, lane.rule, generator)
            layout = lane.rule.layout
            if layout.target_aside:
                lane.target[:] = (*TARGET_CORNER, self._scene.rest_height)
            self._reset_physics(lane, np.array(BLOCK_CORNER) if layout.block_aside else block)
            if layout.block_held:
                self._hold(lane)
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
        """Step each of `lanes` for 0.04 s with its row of the actions (N, 4).

        Returns:
            The states (N, 28), the rewards (N,), and which episodes succeeded (N,).

        Raises:
            InputError: An action has another shape than (4,), or contains a number that is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "Fetch", len(lanes))
        moved = [self._lane(number) for number in lanes]
        self._act(moved, actions)
        self._team.each(self._advance, moved)
        states = self._observe(moved)
        judged = [lane.rule.judge(now, lane.start) for lane, now in zip(moved, states.tolist(), strict=True)]
        rewards, successes = zip(*judged, strict=True)
        return states, np.array(rewards), np.array(successes)

    def drawable(self, lane: int) -> Drawable:
        """Return the scene of a lane with its target marker; the next step does not depend on this call."""
        drawn = self._lane(lane)
        # The place of a site is an output of the physics: the next step computes it again and never reads it.
        drawn.data.site_xpos[drawn.scene.target_site] = drawn.target
        return Drawable(drawn.scene.model, drawn.data, CAMERA)

    def close(self) -> None:
        """End the threads."""
        self._team.close()

    def _lane(self, number: int) -> _Lane:
        return lane_at(self._lanes, number, "Fetch")

    def _lane_of(self, number: int, scene: Scene) -> _Lane:
        """Return a lane with the physics of a scene; make a new lane if the old one had another scene."""
        lane = self._lanes[number]
        if lane is None or lane.scene is not scene:
            self._lanes[number] = lane = _Lane(number, scene)
        return lane

    def _place_block(self, generator: np.random.Generator) -> Vectors:
        """Draw a place (2,) on the table as FetchPickAndPlace-v4 does, but within reach."""
        gripper = self._scene.gripper[:2]
        block = gripper
        while np.linalg.norm(block - gripper) < APART or block[0] > gripper[0] + REACH_AWAY:
            block = gripper + generator.uniform(-SPREAD, SPREAD, size=2)
        return block

    def _place_target(self, block: Vectors, rule: Rule, generator: np.random.Generator) -> Vectors:
        """Draw a place (3,) for the marker, apart from the gripper and from the block (2,)."""
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
        """Reset the physics, with the arm at its start and the block at `block` (2,)."""
        scene, data = lane.scene, lane.data
        # also clears controls, mocap and the warm start of the solver
        mujoco.mj_resetData(scene.model, data)
        data.time = scene.time
        data.qpos[:] = scene.qpos
        data.qvel[:] = scene.qvel
        data.qpos[scene.block_qpos : scene.block_qpos + 2] = block
        mujoco.mj_forward(scene.model, data)
        self._measure(lane)

    def _hold(self, lane: _Lane) -> None:
        """Put the block between the fingers, and close them on it."""
        scene, data = lane.scene, lane.data
        data.qpos[scene.block_qpos : scene.block_qpos + 3] = scene.gripper
        data.qpos[scene.fingers_qpos] = HELD
        mujoco.mj_forward(scene.model, data)
        self._measure(lane)
        for _ in range(GRASP):
            self._act([lane], np.array([[0.0, 0.0, 0.0, -1.0]], np.float32))
            self._advance(lane)

    def _displace(self, lane: _Lane, start: tuple[float, float, float]) -> None:
        """Move the gripper by a share `start` (3,) of `START` along each axis, until it is at rest."""
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
        """Copy the measurements of a lane while they are in the caches of the thread that advanced it."""
        model, number = lane.scene.model, lane.number
        np.concatenate(lane.parts, out=self._measured[number])
        gripper, block, rotation = self._jacobians[number]
        mujoco.mj_jacSite(model, lane.data, gripper, None, lane.scene.gripper_site)
        mujoco.mj_jacSite(model, lane.data, block, rotation, lane.scene.block_site)

    def _observe(self, lanes: Sequence[_Lane]) -> State:
        """Return the states (N, 28), by gymnasium-robotics' arithmetic in double precision, then rounded."""
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
