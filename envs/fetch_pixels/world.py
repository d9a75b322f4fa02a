"""The Fetch world of the pixel scenario: the scene with two coloured things, seen by a camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.camera import VIEW_SIZE

from ..fetch.physics import FetchVectorWorld
from ..fetch.rules import RULES, Layout
from ..fetch.state import BLOCK, SIZE, TARGET, State
from ..fetch.world import FetchWorld
from .camera import COLOURS, JOINTS, PIXEL_SIZE, THINGS, FetchCamera

PIXEL_RULES = {
    name: dataclasses.replace(rule, target_on_table=True, layout=Layout())
    for name, rule in RULES.items()
    if not rule.layout.block_held
}
"""The Fetch world's rules with block and target in front of the gripper.

Every target is on the table: one camera does not show the height of a target.
"""

THING_PLACES = np.array([[1.12, 0.52], [1.50, 0.96]])
"""Corners of the area of the table for things, x and y in metres."""
THINGS_APART = 0.10
"""Smallest distance in metres from a thing to the block, the target and the other thing."""

PLAIN = np.zeros((1, VIEW_SIZE), np.float32)
"""The view of an unperturbed camera."""

Vectors = NDArray[np.float64]


class FetchPixelsVectorWorld(FetchVectorWorld):
    """The episodes of `FetchVectorWorld`, with all targets on the table and two things in each episode.

    Actions and rewards are those of `clbench/Fetch-v1`.

    States (N, 56) contain everything that the experts, the questions and the camera need. A policy gets only
    pictures and the numbers that `FetchCamera.proprioception` returns.

    Args:
        lanes: Number of lanes.
        threads: Number of threads that advance the physics.
        perturbed: Whether the block is heavier or lighter, and the gripper starts elsewhere.
    """

    def __init__(self, lanes: int, threads: int = 1, perturbed: bool = False) -> None:
        super().__init__(lanes, threads, perturbed, PIXEL_RULES)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (PIXEL_SIZE,), np.float32)
        self._states = np.zeros((lanes, PIXEL_SIZE), np.float32)

    def reset(self, lanes: Sequence[int], seeds: Sequence[int], tasks: Sequence[str]) -> State:
        """Start an episode in each of `lanes` and return the states (N, 56).

        Raises:
            UnknownNameError: No task has this name; the error names the nearest one.
        """
        states = super().reset(lanes, seeds, tasks)
        for lane, seed, state in zip(lanes, seeds, states, strict=True):
            self._states[lane, THINGS] = _things(state, np.random.default_rng([seed, 2]))
        return self._complete(lanes, states)

    def step(
        self, lanes: Sequence[int], actions: NDArray[np.float32]
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Step each of `lanes` with its row of the actions (N, 4), as `FetchVectorWorld` does."""
        states, rewards, successes = super().step(lanes, actions)
        return self._complete(lanes, states), rewards, successes

    def state(self, lane: int) -> State:
        """Return the current state (56,) of a lane."""
        state: State = self._states[lane]
        return state

    def _complete(self, lanes: Sequence[int], states: State) -> State:
        """Extend the states (N, 28) by joints and things to (N, 56)."""
        for lane, state in zip(lanes, states, strict=True):
            self._states[lane, :SIZE] = state
            self._states[lane, JOINTS] = self._lane(lane).data.qpos
        complete: State = self._states[list(lanes)]
        return complete


def _things(state: State, generator: np.random.Generator) -> Vectors:
    """Return places and colours (6,) of the two things, apart from each other, the block and the target."""
    taken = [state[BLOCK][:2], state[TARGET][:2]]
    things: list[float] = []
    for colour in generator.permutation(len(COLOURS))[:2]:
        while True:
            place = generator.uniform(*THING_PLACES)
            if min(float(np.linalg.norm(place - other)) for other in taken) >= THINGS_APART:
                break
        taken.append(place)
        things += [*place, colour]
    return np.array(things)


class FetchPixelsWorld(FetchWorld):
    """A `FetchPixelsVectorWorld` with one lane; policies see it through `FetchCamera`."""

    vector_world: ClassVar[type[FetchVectorWorld]] = FetchPixelsVectorWorld
    _world: FetchPixelsVectorWorld
    _camera: FetchCamera | None = None

    def picture(self) -> NDArray[np.uint8]:
        """Draw the view of the camera, (480, 480, 3)."""
        if self._camera is None:
            self._camera = FetchCamera(480, scale=1)
        picture: NDArray[np.uint8] = self._camera.draw(self._world.state(0)[None], PLAIN)[0]
        return picture

    def close(self) -> None:
        """Free the camera, if there is one."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
