"""The physics of the dm_control world: many episodes of any bodies side by side, advanced by threads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.threads import Team
from clbench.worlds.world import Drawable, checked_actions, lane_at, rows_by_task

from .episode import Episode
from .experts import expert_return
from .rules import HORIZON, RULES, SUCCESS_SHARE
from .state import ACTION_SIZE, SIZE, Observation, State, padded


class _Lane:
    """An episode with its return so far."""

    def __init__(self) -> None:
        self.episode = Episode()
        self.steps, self.total, self.needed = 0, 0.0, 0.0

    def count(self, reward: float) -> bool:
        """Add a step with its reward, and return whether the episode has succeeded with it."""
        self.steps, self.total = self.steps + 1, self.total + reward
        return self.steps == HORIZON and self.total >= self.needed


class DMControlVectorWorld:
    """Bodies of dm_control with the tasks of `RULES`; the module `state` documents the layout of states.

    An action (2,) in [-1, 1] sets the motors for one step of 0.04 s, or 0.16 s for the point mass; a body
    with one motor ignores the second number. An episode succeeds at its last step, the 100th, if its return
    is at least 0.8 of the mean return of the expert's episodes.

    It is a `clbench.worlds.world.VectorWorld`.

    Args:
        lanes: Number of lanes. A lane allocates its memory when it first has a body.
        threads: Number of threads that advance the physics; MuJoCo releases the interpreter lock. Results do
            not depend on their number.
        perturbed: Whether the body, its pole or its ball is heavier or lighter, and starts in motion.
    """

    perturbable: ClassVar[bool] = True

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)
        self._lanes: list[_Lane | None] = [None] * lanes
        self._team = Team(threads)
        self._perturbed = perturbed

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 19).

        The initial state is dm_control's own for the seed.

        Raises:
            UnknownNameError: No task has this name; the error names the nearest one.
        """
        states = np.empty((len(lanes), SIZE), np.float32)
        for row, (number, seed, task) in enumerate(zip(lanes, seeds, tasks, strict=True)):
            lane = self._lanes[number] or _Lane()
            perturbation = draw_perturbation(seed) if self._perturbed else None
            observation = lane.episode.reset(task, seed, perturbation)
            lane.steps, lane.total = 0, 0.0
            lane.needed = SUCCESS_SHARE * expert_return(task)
            self._lanes[number] = lane
            states[row] = padded(lane.episode.rule.body, observation)
        return states

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Step each of `lanes` with its row of the actions (N, 2).

        Returns:
            The states (N, 19), the rewards (N,) in [0, 1], and which episodes succeeded (N,).

        Raises:
            InputError: An action has another shape than (2,), or contains a number that is not finite.
        """
        actions = checked_actions(actions, self.single_action_space, "dm_control", len(lanes))
        moved = [self._lane(number) for number in lanes]
        observations = self._advance(moved, actions)
        states, rewards = np.empty((len(lanes), SIZE), np.float32), np.empty(len(lanes))
        for task, rows in rows_by_task(lane.episode.task for lane in moved).items():
            rule, observed = RULES[task], np.stack([observations[row] for row in rows])
            controls = np.stack([moved[row].episode.control for row in rows])
            rewards[rows], states[rows] = rule.rewards(observed, controls), padded(rule.body, observed)
        successes = [lane.count(reward) for lane, reward in zip(moved, rewards.tolist(), strict=True)]
        return states, rewards, np.array(successes)

    def drawable(self, lane: int) -> Drawable:
        """Return the body of a lane with its target in place; the next step does not depend on this call."""
        episode = self._lane(lane).episode
        model, mark = episode.start.model, episode.rule.mark
        if mark is not None:
            # The place of a mark is an output of the physics: the next step computes it again.
            episode.data.geom_xpos[model.geom("target").id][:2] = mark
        return Drawable(model, episode.data, episode.start.body.camera)

    def steps_per_second(self, lane: int) -> float:
        """Return the control rate of a lane's body: 25, or 6.25 for the point mass."""
        start = self._lane(lane).episode.start
        return round(1 / float(start.model.opt.timestep * start.body.substeps), 6)

    def close(self) -> None:
        """End the threads."""
        self._team.close()

    def _lane(self, number: int) -> _Lane:
        return lane_at(self._lanes, number, "dm_control")

    def _advance(self, lanes: Sequence[_Lane], actions: NDArray[np.float32]) -> list[Observation]:
        """Move each lane by its action and return the observations."""
        observations: list[Observation] = [np.empty(0)] * len(lanes)

        def move(row: int) -> None:
            observations[row] = lanes[row].episode.step(actions[row])

        self._team.each(move, range(len(lanes)))
        return observations
