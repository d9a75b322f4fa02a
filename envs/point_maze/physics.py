"""The physics of the PointMaze world: many episodes side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from clbench.worlds.perturbation import Perturbation, draw_perturbation
from clbench.worlds.world import Drawable, checked_actions, lane_at

from .mazes import MAZES, ROOMS, Place, centre
from .rules import Goal, goal_of
from .scene import CAMERA, SUBSTEPS, TARGET, scene, scene_with_mass
from .state import COLOUR, PLACE, ROOM_AHEAD, SIZE, VELOCITY, State

TOP_SPEED = 5.0
"""Speed limit of the ball along each axis in metres per second, as in PointMaze."""
APART = 3
"""Shortest way from the start to the goal, in cells, so that no task is nearly done at the start."""
SPREAD = 0.25
"""Largest distance in metres from the start to the centre of its cell along each axis, as in PointMaze."""
START = 0.1
"""Largest extra displacement of a perturbed start along each axis, in metres. The ball still fits: its radius
is 0.1 m, and walls are 0.5 m from the centre of a cell."""


class _Lane:
    """The physics of successive episodes in one maze, with a ball of one mass."""

    goal: Goal

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)

    def begin(self, goal: Goal, place: Place) -> None:
        """Reset the physics, with the ball at rest at a place."""
        self.goal = goal
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = place
        mujoco.mj_forward(self.model, self.data)

    def advance(self, action: NDArray[np.float32]) -> None:
        """Move for one step, as PointMaze does when it repeats the action: limit the speed, then step."""
        self.data.ctrl[:] = action
        velocity = self.data.qvel
        for _ in range(SUBSTEPS):
            if max(map(abs, velocity.tolist())) > TOP_SPEED:  # takes a tenth of the time of np.clip
                velocity.clip(-TOP_SPEED, TOP_SPEED, out=velocity)
            mujoco.mj_step(self.model, self.data)

    def observe(self, state: State) -> None:
        """Write the state (11,)."""
        x, y = self.data.qpos.tolist()
        state[PLACE] = x, y
        state[VELOCITY] = self.data.qvel
        state[ROOM_AHEAD] = self.goal.maze.room_ahead((x, y))
        state[COLOUR] = [self.goal.maze.colour == colour for colour in MAZES]


class PointMazeVectorWorld:
    """The ball, the physics and the observation of PointMaze in three mazes, with the tasks of `GOALS`.

    An action (2,) in [-1, 1] pushes the ball to the right and upwards for 0.1 s, by up to 24 m/s^2. The
    reward is minus the length of the way to the goal in metres, through the centres of the cells, plus 1 on
    success.

    It is a `clbench.worlds.world.VectorWorld`. Only success ends an episode; the caller counts its steps.

    Args:
        lanes: Number of lanes. A lane allocates its memory when it first enters a maze.
        threads: Ignored: the steps of a ball are too short to share among threads.
        perturbed: Whether the ball is heavier or lighter, and starts at a displaced place.
    """

    perturbable: ClassVar[bool] = True

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._perturbed = perturbed
        self._lanes: list[_Lane | None] = [None] * lanes

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 11).

        The ball starts anywhere in the task's maze, at least `APART` cells from the goal.

        Raises:
            UnknownNameError: No task has this name; the error names the nearest one.
        """
        for number, seed, task in zip(lanes, seeds, tasks, strict=True):
            goal, lane = goal_of(task), self._lanes[number]
            perturbation = draw_perturbation(seed) if self._perturbed else None
            colour = goal.maze.colour
            model = scene_with_mass(colour, perturbation.mass) if perturbation else scene(colour)
            if lane is None or lane.model is not model:
                self._lanes[number] = lane = _Lane(model)
            lane.begin(goal, _start(goal, seed, perturbation))
        return self._observe(lanes)

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Step each of `lanes` for 0.1 s with its row of the actions (N, 2).

        Returns:
            The states (N, 11), the rewards (N,), and which episodes succeeded (N,).

        Raises:
            InputError: An action has another shape than (2,), or contains a number that is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "PointMaze", len(lanes))
        for number, action in zip(lanes, actions, strict=True):
            self._lane(number).advance(action)
        states = self._observe(lanes)
        judged = [self._lane(number).goal.judge(state) for number, state in zip(lanes, states, strict=True)]
        rewards, successes = zip(*judged, strict=True)
        return states, np.array(rewards), np.array(successes)

    def drawable(self, lane: int) -> Drawable:
        """Return the maze of a lane with the mark at its goal; the next step does not depend on this call."""
        drawn = self._lane(lane)
        # The place of a site is an output of the physics: the next step computes it again and never reads it.
        drawn.data.site(TARGET).xpos[:2] = centre(ROOMS[drawn.goal.room])
        return Drawable(drawn.model, drawn.data, CAMERA)

    def close(self) -> None:
        """Do nothing: there is nothing to free."""

    def _lane(self, number: int) -> _Lane:
        return lane_at(self._lanes, number, "PointMaze")

    def _observe(self, lanes: Sequence[int]) -> State:
        states = np.empty((len(lanes), SIZE), np.float32)
        for number, state in zip(lanes, states, strict=True):
            self._lane(number).observe(state)
        return states


def _start(goal: Goal, seed: int, perturbation: Perturbation | None) -> Place:
    """Return the place where the ball starts."""
    generator, _ = np_random(seed)
    cells = [cell for cell in goal.maze.free if goal.maze.steps(cell, goal.room) >= APART]
    x, y = centre(cells[int(generator.integers(len(cells)))])
    dx, dy = generator.uniform(-SPREAD, SPREAD, size=2).tolist()
    if perturbation:
        dx, dy = dx + START * perturbation.start[0], dy + START * perturbation.start[1]
    return x + dx, y + dy
