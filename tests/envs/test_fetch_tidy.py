"""The tidy Fetch world: what a task does not need lies in a corner, and a held block is held."""

import numpy as np
import pytest

from clbench.base.entry_points import resolve
from clbench.spec.registry import load_scenario

SCENARIO = load_scenario("clbench/Fetch-v1")
RULES = resolve("clbench.envs.fetch_tidy.rules:TIDY_RULES")
STATE = resolve("clbench.envs.fetch.state:BLOCK"), resolve("clbench.envs.fetch.state:TARGET")
NAMES = [task.name for task in SCENARIO.tasks]


@pytest.fixture(scope="module")
def world():  # type: ignore[no-untyped-def]
    """One world for all tasks."""
    made = resolve(SCENARIO.tasks[0].world)()
    yield made
    made.close()


@pytest.mark.parametrize("name", NAMES)
def test_things_are_where_the_layout_puts_them(name: str, world) -> None:  # type: ignore[no-untyped-def]
    layout, (block, target) = RULES[name].layout, STATE
    for seed in range(5):
        state, _ = world.reset(seed=seed, options={"task": name})
        gripper = state[:3]
        assert (np.linalg.norm(state[block][:2] - (1.12, 1.03)) < 0.001) == layout.block_aside
        assert (np.linalg.norm(state[target] - (1.12, 0.47, 0.425)) < 0.001) == layout.target_aside
        assert (np.linalg.norm(state[block] - gripper) < 0.02) == layout.block_held


def test_a_held_block_stays_in_the_gripper_until_it_opens(world) -> None:  # type: ignore[no-untyped-def]
    for seed in range(3):
        state, _ = world.reset(seed=seed, options={"task": "put_down"})
        for _ in range(10):
            state, *_ = world.step(np.array([0.3, 0.0, 0.5, -1.0], np.float32))
        assert np.linalg.norm(state[STATE[0]] - state[:3]) < 0.02
        for _ in range(10):
            state, *_ = world.step(np.array([0.0, 0.0, 0.0, 1.0], np.float32))
        assert state[STATE[0]][2] < 0.45  # it has fallen


def test_a_block_is_put_down_once_the_gripper_has_let_go_and_left(world) -> None:  # type: ignore[no-untyped-def]
    rule = RULES["put_down"]
    state = [0.0] * 28
    state[0:3], state[3:6], state[9:11] = [1.3, 0.7, 0.5], [1.3, 0.7, 0.425], [0.05, 0.05]
    assert rule.success(state, state)
    for place, value in ((2, 0.47), (9, 0.0), (5, 0.5)):  # too near, not open, in the air
        wrong = [*state]
        wrong[place] = value
        assert not rule.success(wrong, state)


def test_a_held_block_is_raised_once_it_is_8_cm_higher_and_still_held(world) -> None:  # type: ignore[no-untyped-def]
    rule, start = RULES["raise_block"], [0.0] * 28
    start[3:6], start[9:11] = [1.3, 0.7, 0.5], [0.025, 0.025]
    state = [*start]
    state[5] = 0.581
    assert rule.success(state, start)
    for place, value in ((5, 0.579), (9, 0.06), (9, -0.01)):  # too low, let go, slipped
        wrong = [*state]
        wrong[place] = value
        assert not rule.success(wrong, start)
    assert rule.distance(start, start) == pytest.approx(0.08)


def test_a_thing_in_its_corner_never_hinders_the_expert(world) -> None:  # type: ignore[no-untyped-def]
    for name in ("reach", "hover_target"):
        expert = resolve(SCENARIO.task(name).expert)(name)
        state, _ = world.reset(seed=3, options={"task": name})
        before, success = state[STATE[0]].copy(), False
        for _ in range(40):
            state, _, success, *_ = world.step(expert(state))
            if success:
                break
        assert success
        np.testing.assert_allclose(state[STATE[0]], before, atol=1e-3)
