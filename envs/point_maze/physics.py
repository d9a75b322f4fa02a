"""The physics of the PointMaze world: many episodes side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gymnasium
import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from numpy.typing import NDArray

from clbench.worlds.perturbation import Perturbation, draw_perturbation
from clbench.worlds.world import checked_actions, no_episode

from .mazes import MAZES, ROOMS, Goal, Place, centre, goal_of
from .scene import SUBSTEPS, TARGET, scene, scene_with_mass
from .state import COLOUR, PLACE, ROOM_AHEAD, SIZE, VELOCITY, State

TOP_SPEED = 5.0
"""Metres per second that PointMaze allows the ball along an axis."""
APART = 3
"""Least way from the start to the goal, in cells: no task is nearly done at the start."""
SPREAD = 0.25
"""How far from the centre of a cell the ball may start along an axis, as in PointMaze."""
START = 0.1
"""How much farther a perturbed ball may start: its radius is 0.1 m, and walls are 0.5 m from the centre."""
NEAR = 0.45
"""How near to the centre of the room the ball counts as there, as in PointMaze."""
SLOW = 0.5
"""Metres per second below which the ball stops: who only passes through a room does not."""
SUCCESS_BONUS = 1.0
"""Added to the reward of the step that succeeds; the rest of the reward is minus the metres to go."""


class _Lane:
    """The physics of one episode after the other in one maze, with a ball of one mass."""

    goal: Goal

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(model)

    def begin(self, goal: Goal, place: Place) -> None:
        """Put the ball at rest at a place, and forget all that was before."""
        self.goal = goal
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = place
        mujoco.mj_forward(self.model, self.data)

    def advance(self, action: NDArray[np.float32]) -> None:
        """Move for one step as PointMaze does that repeats the action: it limits the speed, then steps."""
        self.data.ctrl[:] = action
        velocity = self.data.qvel
        for _ in range(SUBSTEPS):
            if max(map(abs, velocity.tolist())) > TOP_SPEED:  # to ask takes a tenth of the time of np.clip
                velocity.clip(-TOP_SPEED, TOP_SPEED, out=velocity)
            mujoco.mj_step(self.model, self.data)

    def observe(self, state: State) -> None:
        """Write the state (11,)."""
        x, y = self.data.qpos.tolist()
        state[PLACE] = x, y
        state[VELOCITY] = self.data.qvel
        state[ROOM_AHEAD] = self.goal.maze.room_ahead((x, y))
        state[COLOUR] = [self.goal.maze.colour == colour for colour in MAZES]

    def judge(self, state: State) -> tuple[float, bool]:
        """Return the reward in a state, and whether the ball has stopped in the room."""
        x, y = state[PLACE].tolist()
        there = math.dist((x, y), centre(ROOMS[self.goal.room])) < NEAR
        success = there and math.hypot(*state[VELOCITY].tolist()) < SLOW
        _, metres = self.goal.maze.way((x, y), self.goal.room)
        return SUCCESS_BONUS * success - metres, success


class PointMazeVectorWorld:
    """The ball, the physics and the observation of PointMaze, in three mazes, with the tasks of `GOALS`.

    An action (2,) in [-1, 1] pushes the ball to the right and upwards for 0.1 s, by up to 24 m/s^2. The
    reward is minus the metres to go by the shortest way, and `SUCCESS_BONUS` more on success. An episode
    ends with success only; whoever uses the world counts its steps. It is a `clbench.worlds.world.VectorWorld`.

    Args:
        lanes: Places for episodes. A lane takes its memory when it is reset into another maze than before.
        threads: Not used: the steps of a ball are too short to share out.
        perturbed: Whether the ball is heavier or lighter, and starts beside its place.
    """

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._perturbed = perturbed
        self._lanes: list[_Lane | None] = [None] * lanes

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 11).

        The ball starts anywhere in the task's maze that is `APART` cells or more from the goal.

        Raises:
            LookupError: No task has this name; the nearest one is named.
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
        """Move each of `lanes` for one step of 0.1 s by its row of actions (N, 2).

        Returns the states (N, 11), the rewards (N,) and which of the episodes succeeded (N,).

        Raises:
            ValueError: An action has another shape than (2,), or a number in it is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "PointMaze")
        for number, action in zip(lanes, actions, strict=True):
            self._lane(number).advance(action)
        states = self._observe(lanes)
        judged = [self._lane(number).judge(state) for number, state in zip(lanes, states, strict=True)]
        rewards, successes = zip(*judged, strict=True)
        return states, np.array(rewards), np.array(successes)

    def picture_data(self, lane: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return scene and physics of a lane, with the mark at its goal, to draw them and no more."""
        drawn = self._lane(lane)
        # The place of a site is an output of the physics: the next step computes it again and never reads it.
        drawn.data.site(TARGET).xpos[:2] = centre(ROOMS[drawn.goal.room])
        return drawn.model, drawn.data

    def close(self) -> None:
        """Do nothing: there is nothing to free."""

    def _lane(self, number: int) -> _Lane:
        lane = self._lanes[number]
        if lane is None:
            raise no_episode(number, "PointMaze")
        return lane

    def _observe(self, lanes: Sequence[int]) -> State:
        states = np.empty((len(lanes), SIZE), np.float32)
        for number, state in zip(lanes, states, strict=True):
            self._lane(number).observe(state)
        return states


def _start(goal: Goal, seed: int, perturbation: Perturbation | None) -> Place:
    """Return the place at which the ball starts."""
    generator, _ = np_random(seed)
    cells = [cell for cell in goal.maze.free if goal.maze.steps(cell, goal.room) >= APART]
    x, y = centre(cells[int(generator.integers(len(cells)))])
    dx, dy = generator.uniform(-SPREAD, SPREAD, size=2).tolist()
    if perturbation:
        dx, dy = dx + START * perturbation.start[0], dy + START * perturbation.start[1]
    return x + dx, y + dy
