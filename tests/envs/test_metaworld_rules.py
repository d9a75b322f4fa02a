"""Computations for many episodes at once, compared bit for bit with Meta-World's own steps."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.spec.registry import load_scenario
from clbench.worlds.lanes import vector_world
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.world import VectorWorld

SCENARIOS = [load_scenario(f"clbench:clbench/{name}") for name in ("MetaWorld-v1", "MetaWorldCW-v0")]
TASKS = [
    *{task.name: task for one in SCENARIOS for task in one.tasks + one.background},
    "reach",
    "pick_place",
]
WORLD = SCENARIOS[0].tasks[0].world
RULES = resolve("clbench.envs.metaworld.rules:RULES")
new_episode = resolve("clbench.envs.metaworld.episode:new_episode")
expert = resolve(SCENARIOS[0].tasks[0].expert)

State = NDArray[np.float32]


class Peer:
    """One lane of a vector world, with an episode that takes Meta-World's own steps."""

    def __init__(self, world: VectorWorld, lane: int, task: str, perturbed: bool) -> None:
        self.world, self.lane, self.task, self.perturbed = world, lane, task, perturbed
        self.act = expert(task)
        self.left = 0

    def begin(self, generator: np.random.Generator) -> None:
        """Begin both anew with one seed."""
        seed, self.left = int(generator.integers(2**31)), int(generator.integers(50, 140))
        drawn = draw_perturbation(seed) if self.perturbed else None
        self.episode = new_episode(self.task, drawn.mass if drawn else None)
        self.state = self.episode.begin(seed, drawn.start if drawn else None)
        (state,) = self.world.reset([self.lane], [seed], [self.task])
        assert state.tobytes() == self.state.tobytes()

    def follow(self, action: State, state: State, reward: float, success: bool) -> None:
        """Repeat the lane's step in the episode, and compare the results."""
        self.state, expected, succeeded = self.episode.advance(action.clip(-1.0, 1.0))
        assert state.tobytes() == self.state.tobytes()
        assert (reward, success) == (expected, succeeded)
        self.left = 0 if success else self.left - 1

    def check_physics(self) -> None:
        """Compare everything that the next step depends on."""
        data = self.world.drawable(self.lane).data  # type: ignore[attr-defined]
        for name in ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat", "ctrl", "time"):
            np.testing.assert_array_equal(getattr(data, name), getattr(self.episode.data, name))


def compare(tasks: Sequence[str], steps: int, threads: int = 1, perturbed: bool = False) -> int:
    """Compare `steps` steps of a lane for each of `tasks`, and return how many episodes succeeded.

    Expert and random actions take turns; an episode begins anew after success, or at a random age. If lanes
    have several tasks, three quarters of them take each step, in any order.
    """
    world = vector_world(WORLD, len(tasks), threads, perturbed)
    peers = [Peer(world, lane, task, perturbed) for lane, task in enumerate(tasks)]
    generator = np.random.default_rng([len(tasks), *tasks[0].encode()])
    successes = 0
    for step in range(steps):
        for peer in peers:
            if peer.left <= 0:
                peer.begin(generator)
        some = len(tasks) if len(set(tasks)) == 1 else -(-3 * len(tasks) // 4)
        moving = [peers[lane] for lane in generator.permutation(len(tasks))[:some]]
        actions = generator.uniform(-1.2, 1.2, (some, 4)).astype(np.float32)
        for row, peer in enumerate(moving):
            if (step // 6 + peer.lane) % 6:
                actions[row] = peer.act(peer.state)
        outcomes = zip(*world.step([peer.lane for peer in moving], actions), strict=True)
        for peer, action, outcome in zip(moving, actions, outcomes, strict=True):
            peer.follow(action, *outcome)
            successes += int(outcome[2])
    for peer in peers:
        peer.check_physics()
    world.close()
    return successes


def test_all_tasks_that_are_learned_or_kept_have_a_rule() -> None:
    assert set(TASKS) == set(RULES)


@pytest.mark.parametrize("task", TASKS)
def test_lanes_of_a_task_equal_meta_worlds_own_steps(task: str) -> None:
    compare([task] * 3, steps=60)


@pytest.mark.long
def test_lanes_of_all_tasks_do_so_in_any_order_on_three_threads_with_and_without_rules() -> None:
    compare([*TASKS, *TASKS[::3], "stick_push", "dial_turn"], steps=40, threads=3)


@pytest.mark.long
def test_perturbed_lanes_of_all_tasks_do_so() -> None:
    compare([*TASKS, *TASKS[::3]], steps=20, perturbed=True)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_lanes_of_a_task_do_so_over_ten_thousand_steps(task: str) -> None:
    assert compare([task] * 8, steps=1250) > 5


@pytest.mark.slow
def test_lanes_of_all_tasks_do_so_over_ten_thousand_steps() -> None:
    assert compare([*TASKS, *TASKS, "stick_push"], steps=320, threads=2) > 5
