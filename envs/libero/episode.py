"""One episode of LIBERO: its physics, on a model that all episodes of a scene share."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .arm import JOINTS as ARM_JOINTS
from .arm import Arm
from .problem import Problem
from .scene import HIDDEN, SEEN, Places, Scene
from .state import CLOSE_BY, FINGERS, HAND, HAND_QUATERNION, JOINTS, PLACES, REACH, SIZE, State

FINGER_JOINTS = slice(ARM_JOINTS, ARM_JOINTS + 2)
ROBOT_JOINTS = slice(0, ARM_JOINTS + 2)
DISPLACED = [0, 1, 3]
"""Joints of the arm that move the hand to the side, forward and up."""
START = 0.1
"""Largest displacement of these joints in a perturbed episode, in radians: five times the spread of LIBERO's
starts, and 5 to 8 cm of the hand."""
FALL = 250
"""Steps of 2 ms in which things come to rest: LIBERO drops some from 18 cm."""
HAND_BODY, HAND_SITE = "robot0_right_hand", "gripper0_grip_site"


class Episode:
    """Runs episodes of any tasks in one scene, one after the other.

    Args:
        problem: Problem of the first task; `begin` takes others in the same scene.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.data = data = mujoco.MjData(problem.scene.model)
        self.action = np.zeros(7, np.float32)
        """The action of the next `move`, (7,)."""
        self._arm = Arm(problem.scene.model, data)
        self._places = problem.scene.places
        self._hand = data.site(HAND_SITE).xpos, data.body(HAND_BODY).xquat, data.qpos[FINGER_JOINTS]

    def begin(
        self, problem: Problem, seed: int, displaced: tuple[float, float, float] | None = None
    ) -> State:
        """Begin an episode, and return its first state (213,).

        Args:
            problem: Problem in the same scene.
            seed: Number of an initial state of LIBERO, or seed of a drawn one.
            displaced: Displacement of the arm in a perturbed episode, as shares of `START` from -1 to 1;
                None in a plain episode.
        """
        self.problem = problem
        start, self._places = problem.start(seed)
        self._set(start)
        if displaced is not None:
            self._fall(start)
            self.data.qpos[DISPLACED] += START * np.array(displaced)
        self.forward()
        self._arm.begin(problem.scene.rest)
        return self.state()

    def _set(self, start: NDArray[np.float64]) -> None:
        """Set time, positions and velocities (1 + nq + nv,), and forget everything before."""
        model, data = self.problem.scene.model, self.data
        mujoco.mj_resetData(model, data)  # also clears controls and the warm start of the solver
        data.time = start[0]
        data.qpos[:], data.qvel[:] = np.split(start[1:], [model.nq])

    def _fall(self, start: NDArray[np.float64]) -> None:
        """Let things come to rest with their own mass, while the robot stands still as in `start`.

        The bowl that LIBERO drops onto the ramekin stays on its rim, but one twice as heavy bounces off.
        """
        model, data = self._placed(self.problem.plain), self.data
        for _ in range(FALL):
            mujoco.mj_step(model, data)
            data.qpos[ROBOT_JOINTS], data.qvel[ROBOT_JOINTS] = start[1:][ROBOT_JOINTS], 0.0
        self.problem.plain.models.give_back(model)
        self._set(np.concatenate((start[:1], data.qpos, np.zeros(model.nv))))

    def recorded(self, states: NDArray[np.float64], places: Places) -> NDArray[np.float32]:
        """Return the states (T, 213) of a recorded episode.

        Args:
            states: LIBERO's states (T, 1 + nq + nv): time, positions and velocities of the joints.
            places: Places of all bodies in that episode.
        """
        model, data, self._places = self.problem.scene.model, self.data, places
        found = []
        for row in states:
            joints, speeds = np.split(row[1:], [model.nq])
            data.qpos[:] = joints
            # after a step, bodies are where they were before its last 2 ms
            mujoco.mj_integratePos(model, data.qpos, speeds, -model.opt.timestep)
            self.forward()
            data.qpos[:] = joints
            found.append(self.state())
        return np.stack(found)

    def forward(self) -> None:
        """Compute everything that follows from the joints; the next step does not depend on this call."""
        model = self._placed(self.problem.scene)
        mujoco.mj_forward(model, self.data)
        self.problem.scene.models.give_back(model)

    def _placed(self, scene: Scene) -> mujoco.MjModel:
        """Take one of the models of a scene, and move its fixtures to their places."""
        model = scene.models.take()
        model.body_pos[:], model.body_quat[:] = self._places
        return model

    def seen(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the whole scene as it is now, for a picture; the next step does not depend on this call."""
        model, data = self.problem.scene.seen
        model.body_pos[:], model.body_quat[:] = self._places
        data.qpos[:] = self.data.qpos
        mujoco.mj_forward(model, data)
        for site, is_on in self.problem.lights.items():
            model.site_group[site] = SEEN if is_on(self.data) else HIDDEN
        return model, data

    def move(self) -> None:
        """Advance the physics by `action`; several threads may do so at once, each for another episode."""
        model = self._placed(self.problem.scene)
        self._arm.move(model, self.action)
        self.problem.scene.models.give_back(model)

    def state(self) -> State:
        """Return the state (213,)."""
        state, data, problem = np.zeros(SIZE, np.float32), self.data, self.problem
        state[HAND], state[HAND_QUATERNION], state[FINGERS] = self._hand
        positions, turns = data.xpos[problem.things] - self._hand[0], data.xquat[problem.things]
        state[PLACES].reshape(-1, 7)[problem.slots] = np.concatenate((positions, turns), axis=1)
        state[CLOSE_BY].reshape(-1, 3)[problem.slots] = np.clip(positions, -REACH, REACH)
        state[JOINTS][: problem.parts.size] = data.qpos[problem.parts]
        return state

    def is_solved(self) -> bool:
        """Return whether the goal of the task holds."""
        return self.problem.is_solved(self.data)

    def __deepcopy__(self, _: dict[int, Any]) -> Episode:
        """Return an episode with its own physics, in the same state."""
        copied = Episode(self.problem)
        mujoco.mj_copyData(copied.data, self.problem.scene.model, self.data)
        copied._places = self._places
        copied._arm.follow(self._arm)
        return copied
