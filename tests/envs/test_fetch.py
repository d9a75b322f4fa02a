"""The Fetch world, its tasks, experts and questions."""

import itertools

import gymnasium
import numpy as np
import pytest
from helpers import expert_succeeds
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.spec.registry import load_scenario
from clbench.spec.task import Task

SCENARIO = load_scenario("clbench:clbench/Fetch-v1")
NAMES = [task.name for task in SCENARIO.tasks]
World = resolve(SCENARIO.tasks[0].world)
RULES = resolve("clbench.envs.fetch.rules:RULES")
BLOCK, TARGET = (resolve(f"clbench.envs.fetch.state:{name}") for name in ("BLOCK", "TARGET"))
IN_FRONT = [name for name in NAMES if not (RULES[name].layout.block_aside or RULES[name].layout.block_held)]
"""Tasks whose block is on the table in front of the gripper."""
QUESTIONS = {kind.name: kind for kind in resolve(SCENARIO.questions)}

State = NDArray[np.float32]


def random_actions(seed: int, steps: int) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 4)).astype(np.float32)


def scene(
    gripper: tuple[float, float, float] = (1.30, 0.75, 0.535),
    block: tuple[float, float, float] = (1.30, 0.75, 0.425),
    target: tuple[float, float, float] = (1.30, 0.75, 0.425),
    fingers: float = 0.0,
    gripper_velocity: float = 0.0,
    block_velocity: float = 0.0,
) -> State:
    """Return a state (1, 28) made by hand; the velocities are along y."""
    state = np.zeros((1, 28), np.float32)
    state[0, 0:3], state[0, 3:6], state[0, 25:28] = gripper, block, target
    state[0, 6:9] = np.subtract(block, gripper)
    state[0, 9:11] = fingers
    state[0, 15] = block_velocity - gripper_velocity
    state[0, 21] = gripper_velocity
    return state


def test_states_have_28_numbers_and_actions_4() -> None:
    world = World()
    assert world.observation_space.shape == (28,)
    assert world.action_space == gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)


# in these episodes of FetchPickAndPlace the block is within reach, so our world does not place it again
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_physics_and_observation_equal_fetch_pick_and_place(seed: int) -> None:
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    original = gymnasium.make("FetchPickAndPlace-v4", max_episode_steps=10**6, disable_env_checker=True)
    world = World()
    expected = [original.reset(seed=seed)[0]["observation"]]
    got = [world.reset(seed=seed, options={"task": "push"})[0]]
    # the expert for grasping touches the block, and the random actions knock it about
    expert = resolve(SCENARIO.task("pick_and_place").expert)("pick_and_place")
    noise = random_actions(seed, 200)
    for step in range(200):
        action = noise[step] if step % 40 >= 20 else expert(got[-1])
        expected.append(original.step(action)[0]["observation"])
        got.append(world.step(action)[0])
    original.close()
    assert np.ptp(np.stack(got)[:, 3:6], axis=0).min() > 0.01, "the block never moved"
    np.testing.assert_array_equal(np.stack(got)[:, :25], np.stack(expected).astype(np.float32))


@pytest.mark.parametrize("task", NAMES)
def test_a_block_starts_in_the_gripper_or_apart_from_it(task: str) -> None:
    world = World()
    for seed in range(20):
        state, _ = world.reset(seed=seed, options={"task": task})
        assert RULES[task].layout.block_held or np.linalg.norm(state[6:8]) >= 0.099


def test_a_block_in_front_starts_in_the_same_place_for_every_task() -> None:
    world = World()
    blocks = [world.reset(seed=11, options={"task": name})[0][:25] for name in IN_FRONT]
    for block in blocks[1:]:
        np.testing.assert_array_equal(block, blocks[0])


@pytest.mark.parametrize("name", NAMES)
def test_things_are_where_the_layout_puts_them(name: str) -> None:
    world, layout = World(), RULES[name].layout
    for seed in range(5):
        state, _ = world.reset(seed=seed, options={"task": name})
        gripper = state[:3]
        assert (np.linalg.norm(state[BLOCK][:2] - (1.12, 1.03)) < 0.001) == layout.block_aside
        assert (np.linalg.norm(state[TARGET] - (1.48, 0.47, 0.425)) < 0.001) == layout.target_aside
        assert (np.linalg.norm(state[BLOCK] - gripper) < 0.02) == layout.block_held


def test_a_held_block_stays_in_the_gripper_until_it_opens() -> None:
    world = World()
    for seed in range(3):
        state, _ = world.reset(seed=seed, options={"task": "carry_back"})
        for _ in range(10):
            state, *_ = world.step(np.array([0.3, 0.0, 0.5, -1.0], np.float32))
        assert np.linalg.norm(state[BLOCK] - state[:3]) < 0.02
        for _ in range(10):
            state, *_ = world.step(np.array([0.0, 0.0, 0.0, 1.0], np.float32))
        assert state[BLOCK][2] < 0.45  # it has fallen


def test_a_held_block_is_carried_back_once_it_is_10_cm_nearer_and_still_held() -> None:
    rule, start = RULES["carry_back"], [0.0] * 28
    start[3:6], start[9:11] = [1.3, 0.7, 0.5], [0.025, 0.025]
    state = [*start]
    state[3] = 1.199
    assert rule.success(state, start)
    for place, value in ((3, 1.201), (9, 0.06), (9, -0.01)):  # too far, let go, slipped
        wrong = [*state]
        wrong[place] = value
        assert not rule.success(wrong, start)
    assert rule.distance(start, start) == pytest.approx(0.10)


def test_a_thing_in_its_corner_never_hinders_the_expert() -> None:
    world = World()
    for name in ("reach", "hover_target"):
        expert = resolve(SCENARIO.task(name).expert)(name)
        state, _ = world.reset(seed=3, options={"task": name})
        before, success = state[BLOCK].copy(), False
        for _ in range(40):
            state, _, success, *_ = world.step(expert(state))
            if success:
                break
        assert success
        np.testing.assert_allclose(state[BLOCK], before, atol=1e-3)


@pytest.mark.parametrize("task", SCENARIO.tasks, ids=NAMES)
def test_the_expert_recovers_from_random_actions(task: Task) -> None:
    # they can knock the block off a straight way: one episode of four may fail
    assert sum(expert_succeeds(task, seed, random_actions(seed, 5)) for seed in range(100, 104)) >= 3


def test_the_reward_grows_while_the_expert_acts_and_is_highest_at_success() -> None:
    for task in SCENARIO.tasks:
        world, expert = World(), resolve(task.expert)(task.name)
        state, _ = world.reset(seed=100, options={"task": task.name})
        rewards, terminated = [], False
        while not terminated:
            state, reward, terminated, *_ = world.step(expert(state))
            rewards.append(reward)
        assert rewards[-1] > 0.7 > 0.0 > rewards[0]
        assert rewards[-1] == max(rewards)


@pytest.mark.long
def test_experts_of_retained_tasks_do_no_target_task_by_chance() -> None:
    world = World()
    for known, task in itertools.product(SCENARIO.retained, SCENARIO.target):
        expert, successes = resolve(known.expert)(known.name), 0
        for seed in (200, 201):
            state, _ = world.reset(seed=seed, options={"task": task.name})
            for _ in range(25):
                state, _, terminated, *_ = world.step(expert(state))
                successes += terminated
                if terminated:
                    break
        assert successes <= 1, f"the expert of {known.name} does {task.name}"


@pytest.mark.parametrize(
    ("kind", "expected", "state"),
    [
        ("block_side", "left", scene(block=(1.30, 0.80, 0.425))),
        ("block_side", "right", scene(block=(1.30, 0.70, 0.425))),
        ("block_side", None, scene(block=(1.30, 0.76, 0.425))),
        ("block_depth", "nearer", scene(block=(1.25, 0.75, 0.425))),
        ("block_depth", "farther", scene(block=(1.35, 0.75, 0.425))),
        ("block_depth", None, scene()),
        ("gripper_above", "yes", scene(gripper=(1.30, 0.75, 0.535))),
        ("gripper_above", "no", scene(gripper=(1.30, 0.75, 0.43))),
        ("gripper_above", None, scene(gripper=(1.30, 0.75, 0.485))),
        ("gripper_opening", "open", scene(fingers=0.05)),
        ("gripper_opening", "closed", scene(fingers=0.0)),
        ("gripper_opening", None, scene(fingers=0.025)),
        ("gripper_holding", "yes", scene(gripper=(1.30, 0.75, 0.43), fingers=0.0245)),
        ("gripper_holding", "no", scene(fingers=0.0245)),
        ("gripper_holding", None, scene(gripper=(1.30, 0.75, 0.43), fingers=0.05)),
        ("gripper_moving", "yes", scene(gripper_velocity=-0.02)),
        ("gripper_moving", "no", scene(gripper_velocity=0.0)),
        ("gripper_moving", None, scene(gripper_velocity=0.006)),
        ("block_place", "air", scene(block=(1.30, 0.75, 0.50))),
        ("block_place", "table", scene(block=(1.30, 0.75, 0.425))),
        ("block_place", None, scene(block=(1.30, 0.75, 0.44))),
        ("block_moving", "yes", scene(block_velocity=0.01)),
        ("block_moving", "no", scene(block_velocity=0.0, gripper_velocity=0.02)),
        ("block_moving", None, scene(block_velocity=0.002)),
        ("target_side", "left", scene(target=(1.30, 0.80, 0.425))),
        ("target_side", "right", scene(target=(1.30, 0.70, 0.425))),
        ("target_side", None, scene()),
        ("target_side_of_gripper", "left", scene(target=(1.30, 0.80, 0.425))),
        ("target_side_of_gripper", "right", scene(target=(1.30, 0.70, 0.425))),
        ("target_side_of_gripper", None, scene()),
        ("target_place", "air", scene(target=(1.30, 0.75, 0.60))),
        ("target_place", "table", scene()),
        ("target_place", None, scene(target=(1.30, 0.75, 0.44))),
        ("target_higher", "yes", scene(target=(1.30, 0.75, 0.60))),
        ("target_higher", "no", scene(block=(1.30, 0.75, 0.60))),
        ("target_higher", None, scene(target=(1.30, 0.75, 0.447))),
        ("nearest", "block", scene(target=(1.40, 0.75, 0.425))),
        ("nearest", "target", scene(block=(1.40, 0.75, 0.425))),
        ("nearest", None, scene()),
        ("farthest", "block", scene(block=(1.40, 0.75, 0.425))),
        ("farthest", "target", scene(target=(1.40, 0.75, 0.425))),
        ("farthest", None, scene()),
    ],
)
def test_answers_match_the_scene(kind: str, expected: str | None, state: State) -> None:
    question = QUESTIONS[kind]
    (index,) = question.answer(state)
    assert (None if index == -1 else question.answers[index]) == expected
