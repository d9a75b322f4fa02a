"""The physics of Fetch, compared bit for bit with the plain world and with gymnasium-robotics."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.spec.registry import load_scenario
from clbench.worlds.lanes import vector_world
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.world import VectorWorld

SCENARIO = load_scenario("clbench:clbench/Fetch-v1")
NAMES = [task.name for task in SCENARIO.tasks]
PlainWorld = resolve(SCENARIO.tasks[0].world)
RULES = resolve("clbench.envs.fetch.rules:RULES")
GRIPPER_VELOCITY = resolve("clbench.envs.fetch.state:GRIPPER_VELOCITY")
LONGEST = 80
"""Steps after which an unfinished episode begins anew: more than the horizon."""

State = NDArray[np.float32]


def fetch(lanes: int, threads: int = 1) -> VectorWorld:
    return vector_world(SCENARIO.tasks[0].world, lanes, threads)


class Peer:
    """One episode of gymnasium-robotics and one of our plain world, step by step."""

    def __init__(self, original: Any) -> None:
        self.plain, self.original = PlainWorld(), original
        self.follows = False

    def reset(self, seed: int, task: str) -> State:
        state, _ = self.plain.reset(seed=seed, options={"task": task})
        observation = self.original.reset(seed=seed)[0]["observation"].astype(np.float32)
        # if its block is out of our reach, ours is placed again, and the episodes differ
        self.follows = bool((observation == state[:25]).all())
        return state  # type: ignore[no-any-return]

    def step(self, action: NDArray[np.float32]) -> tuple[State, float, bool]:
        state, reward, success, _, _ = self.plain.step(action)
        if self.follows:
            observation = self.original.step(action)[0]["observation"].astype(np.float32)
            np.testing.assert_array_equal(observation, state[:25])
        return state, reward, success


def compare(task: str, steps: int, threads: int, lanes: int = 8) -> tuple[int, int]:
    """Compare `steps` steps of a task; return the numbers of followed steps and of successes.

    Expert and random actions take turns; an episode begins anew after success, or at a random age.
    """
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    originals = [
        gymnasium.make("FetchPickAndPlace-v4", max_episode_steps=10**6, disable_env_checker=True)
        for _ in range(lanes)
    ]
    world, peers = fetch(lanes, threads), [Peer(original) for original in originals]
    generator = np.random.default_rng([7, NAMES.index(task)])
    expert = resolve(SCENARIO.task(task).expert)(task)
    states = np.zeros((lanes, 28), np.float32)
    left, numbers = np.zeros(lanes, np.int64), list(range(lanes))
    followed = successes = 0
    for step in range(-(-steps // lanes)):
        beginning = [lane for lane in numbers if left[lane] <= 0]
        seeds = generator.integers(2**31, size=len(beginning)).tolist()
        if beginning:
            states[beginning] = world.reset(beginning, seeds, [task] * len(beginning))
            left[beginning] = generator.integers(20, LONGEST, size=len(beginning))
        for lane, seed in zip(beginning, seeds, strict=True):
            np.testing.assert_array_equal(peers[lane].reset(seed, task), states[lane])
        actions = generator.uniform(-1.2, 1.2, (lanes, 4)).astype(np.float32)
        for lane in numbers:
            if (step // 12 + lane) % 3:
                actions[lane] = expert(states[lane])
        states, rewards, ended = world.step(numbers, actions)
        for lane, peer in enumerate(peers):
            state, reward, success = peer.step(actions[lane])
            np.testing.assert_array_equal(state, states[lane])
            assert (reward, success) == (rewards[lane], ended[lane])
        followed += sum(peer.follows for peer in peers)
        successes += int(ended.sum())
        left = np.where(ended, 0, left - 1)
    for original in originals:
        original.close()
    world.close()
    return followed, successes


@pytest.mark.long
@pytest.mark.parametrize("task", ["pick_and_place", "push_right"])
def test_it_is_the_plain_world_and_gymnasium_robotics_bit_for_bit(task: str) -> None:
    followed, successes = compare(task, steps=400, threads=2)
    assert followed > 200
    assert successes > 2


@pytest.mark.slow
@pytest.mark.parametrize("task", NAMES)
def test_it_stays_so_over_ten_thousand_steps_of_each_task(task: str) -> None:
    followed, successes = compare(task, steps=10_000, threads=2)
    layout = RULES[task].layout
    # gymnasium-robotics has its block in front of the gripper
    assert followed > 5_000 or layout.block_aside or layout.block_held
    assert successes > 50


@pytest.mark.parametrize("seed", range(4))
def test_in_a_perturbed_episode_the_block_is_heavier_and_the_gripper_elsewhere_and_at_rest(seed: int) -> None:
    plain, perturbed = (vector_world(SCENARIO.tasks[0].world, 2, 1, flag) for flag in (False, True))
    states = [world.reset([1], [seed], ["push"])[0] for world in (plain, perturbed)]
    models = [world.drawable(1).model for world in (plain, perturbed)]  # type: ignore[attr-defined]
    drawn = draw_perturbation(seed)
    np.testing.assert_array_equal(models[1].body_mass, models[0].body_mass * heavier(models[0], drawn.mass))
    moved = states[1] - states[0]
    np.testing.assert_allclose(moved[:3], 0.025 * np.array(drawn.start), atol=0.006)
    assert np.abs(moved[GRIPPER_VELOCITY]).max() < 1e-3
    np.testing.assert_allclose(moved[[3, 4, 5, -3, -2, -1]], 0, atol=1e-3)  # block and target stay in place


def heavier(model: Any, mass: float) -> NDArray[np.float64]:
    """Return the factors on the masses of the bodies."""
    factors = np.ones(model.nbody)
    factors[model.body("object0").id] = mass
    return factors
