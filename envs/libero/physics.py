"""The physics of the LIBERO world: many episodes side by side, of any tasks, advanced by threads."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from clbench.base.errors import InputError
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.threads import Team
from clbench.worlds.world import Drawable, checked_actions, lane_at

from .episode import Episode
from .problem import heavier_problem_of, problem_of
from .scene import Scene
from .state import SIZE, State


class LiberoVectorWorld:
    """LIBERO's tasks with their own physics and success conditions, bit for bit.

    An action (7,) in [-1, 1] displaces the goal of the hand from its place by up to 5 cm along x, y and z and
    by up to 0.5 rad around them, and closes (+1) or opens (-1) the fingers; a step takes 0.05 s. The reward
    is 1 with success, and 0 otherwise.

    It is a `clbench.worlds.world.VectorWorld`. Only success ends an episode; the caller counts its steps.

    Given the same places of fixtures and the same initial state, all trajectories and successes equal those
    of LIBERO. The differences:

    1. The seed alone determines an episode. LIBERO places the fixtures (cabinet, stove, rack) anew in each
       reset, and its initial states do not contain them: one initial state leads to many trajectories.
    2. The state describes the end of a step. LIBERO's observations are from the first 2 ms of the step.

    Args:
        lanes: Number of lanes. The first reset to a task compiles its scene.
        threads: Number of threads that advance the physics; MuJoCo releases the interpreter lock. Results do
            not depend on their number. Each thread but one copies the models that it needs, of 3 MB.
        perturbed: Whether objects are heavier or lighter, and the arm starts elsewhere.
    """

    perturbable: ClassVar[bool] = True

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
        self._perturbed = perturbed
        self._lanes: list[Episode | None] = [None] * lanes
        self._idle: defaultdict[Scene, list[Episode]] = defaultdict(list)
        self._team = Team(threads)

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 213).

        The seeds alone determine them. Seeds below 50 are numbers of LIBERO's initial states; for all others
        LIBERO draws a state.

        Raises:
            UnknownNameError: LIBERO has no task of this name; the error names the nearest one.
        """
        return np.stack([self._begin(*start) for start in zip(lanes, seeds, tasks, strict=True)])

    def _begin(self, lane: int, seed: int, task: str) -> State:
        perturbation = draw_perturbation(seed) if self._perturbed else None
        problem = heavier_problem_of(task, perturbation.mass) if perturbation else problem_of(task)
        before = self._lanes[lane]
        if before is not None:
            self._idle[before.problem.scene].append(before)
        idle = self._idle[problem.scene]
        self._lanes[lane] = episode = idle.pop() if idle else Episode(problem)
        return episode.begin(problem, seed, perturbation.start if perturbation else None)

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Step each of `lanes` for 0.05 s with its row of the actions (N, 7).

        Returns:
            The states (N, 213), the rewards (N,), and which episodes succeeded (N,).

        Raises:
            InputError: An action has another shape than (7,), or contains a number that is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "LIBERO", len(lanes))
        moved = [self._lane(number) for number in lanes]
        for episode, action in zip(moved, actions, strict=True):
            episode.action = action
        self._team.each(Episode.move, moved)
        successes = np.array([episode.is_solved() for episode in moved])
        return np.stack([episode.state() for episode in moved]), successes.astype(np.float64), successes

    @staticmethod
    def recorded_states(task: str, states: NDArray[np.float64], scene: str | None) -> State:
        """Return the states (T, 213) of a demonstration in a file of LIBERO, whose `states` differ in form.

        Args:
            task: Name of the task.
            states: The file's `states` (T, 1 + nq + nv): time, positions and velocities of all joints.
            scene: The file's `model_file`, a scene in MJCF, which alone says where the fixtures are.

        Raises:
            InputError: The states or the scene do not belong to the task, or the scene is missing.
        """
        problem = problem_of(task)
        size = problem.starts.shape[1]
        if states.shape[1] != size:
            raise InputError(f"it has {states.shape[1]} numbers, but a state of LIBERO has {size} in {task}")
        if scene is None:
            raise InputError("there is no model_file beside it, which says where the fixtures are")
        return Episode(problem).recorded(states, problem.places_in(scene))

    def drawable(self, lane: int) -> Drawable:
        """Return the whole scene of a lane, of 210 MB; the next step does not depend on this call.

        Lanes of one scene share it: draw a lane before you ask for another one.
        """
        episode = self._lane(lane)
        return Drawable(*episode.seen(), episode.problem.scene.camera)

    def close(self) -> None:
        """Release all episodes, and end the threads."""
        self._team.close()
        self._lanes = [None] * len(self._lanes)
        self._idle.clear()

    def _lane(self, number: int) -> Episode:
        return lane_at(self._lanes, number, "LIBERO")
