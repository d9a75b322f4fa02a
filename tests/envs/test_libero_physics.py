"""The physics of LIBERO, compared bit for bit with LIBERO's own environment."""

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from helpers import back_end_or_skip
from numpy.typing import NDArray

pytest.importorskip("libero", reason="pip install 'clbench[libero]'")

from clbench.base.entry_points import resolve
from clbench.base.errors import UnknownNameError

ORIGINAL = "clbench.envs.libero.original"
TASKS = resolve(f"{ORIGINAL}:TASKS")
Episode = resolve("clbench.envs.libero.episode:Episode")
problem_of = resolve("clbench.envs.libero.problem:problem_of")
place_of = resolve("clbench.envs.libero.state:thing")
goal_of = resolve("clbench.envs.libero.rules:goal_of")
ONE_OF_EACH_SUITE = {suite: task for task, suite in TASKS.items()}


@functools.cache
def libero(task: str) -> Any:
    """LIBERO's own environment of a task."""
    from libero.libero.envs.env_wrapper import ControlEnv

    file = str(resolve(f"{ORIGINAL}:problem_file")(task))
    return ControlEnv(
        bddl_file_name=file, has_offscreen_renderer=False, use_camera_obs=False, ignore_done=True
    )


def random_actions(seed: int, steps: int) -> NDArray[np.float32]:
    """Random actions (steps, 7) that tend down to the things; some of them do not turn the hand."""
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 7)).astype(np.float32)
    actions[:, 2] = np.maximum(actions[:, 2] - 0.2, -1.0)
    actions[::9, 3:6] = 0.0
    return actions


def begin_both(task: str, seed: int) -> tuple[Any, Any]:
    """An episode of ours, and LIBERO's environment with its fixtures and its initial state."""
    problem = problem_of(task)
    ours, theirs = Episode(problem), libero(task)
    ours.begin(problem, seed)
    theirs.seed(seed)
    theirs.reset()
    state, places = problem.start(seed)
    model = theirs.sim.model
    model.body_pos[:], model.body_quat[:] = places
    theirs.set_init_state(state)
    return ours, theirs


def check_equal_steps(task: str, seed: int, steps: int) -> None:
    ours, theirs = begin_both(task, seed)
    for action in random_actions(seed, steps):
        ours.action = action
        ours.move()
        theirs.step(action)
        for name in ("qpos", "qvel", "ctrl", "xpos", "qacc_warmstart"):
            np.testing.assert_array_equal(getattr(ours.data, name), getattr(theirs.sim.data, name), name)
        assert ours.is_solved() == theirs.check_success()


@pytest.mark.parametrize("task", ONE_OF_EACH_SUITE.values(), ids=ONE_OF_EACH_SUITE)
def test_random_steps_equal_liberos(task: str) -> None:
    check_equal_steps(task, seed=3, steps=40)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_two_hundred_random_steps_of_each_task_equal_liberos(task: str) -> None:
    for seed in (0, 61):
        check_equal_steps(task, seed, steps=200)


@pytest.mark.parametrize("task", ONE_OF_EACH_SUITE.values(), ids=ONE_OF_EACH_SUITE)
def test_a_first_state_has_liberos_numbers_of_the_hand_the_fingers_and_a_thing(task: str) -> None:
    ours, theirs = begin_both(task, seed=61)
    state, seen = ours.state(), theirs.env._get_observations(force_update=True)
    thing = next(iter(theirs.env.objects_dict))
    for name, numbers in (
        ("robot0_eef_pos", state[0:3]),
        ("robot0_eef_quat", state[[4, 5, 6, 3]]),
        ("robot0_gripper_qpos", state[7:9]),
        (f"{thing}_pos", state[0:3] + state[place_of(thing)][:3]),
    ):
        np.testing.assert_allclose(numbers, seen[name], atol=1e-6, err_msg=name)


PICTURES = """
import sys
import mujoco, numpy as np
from clbench.envs.libero.original import problem_file
from clbench.envs.libero.problem import problem_of
from clbench.worlds.lanes import vector_world
from libero.libero.envs.env_wrapper import OffScreenRenderEnv

task, angle = sys.argv[1], float(sys.argv[2])
world = vector_world("clbench.envs.libero.world:LiberoWorld", 1)
world.reset([0], [3], [task])
libero = OffScreenRenderEnv(bddl_file_name=str(problem_file(task)), camera_heights=64, camera_widths=64)
state, (positions, quaternions) = problem_of(task).start(3)
libero.reset()
libero.sim.model.body_pos[:], libero.sim.model.body_quat[:] = positions, quaternions
if angle:
    address = int(problem_of(task).scene.model.joint("flat_stove_1_button").qposadr[0])
    state[1 + address] = world._lane(0).data.qpos[address] = angle
libero.set_init_state(state)
seen = libero.env._get_observations(force_update=True)
model, data, _ = world.drawable(0)
with mujoco.Renderer(model, height=64, width=64) as renderer:
    for camera in ("agentview", "robot0_eye_in_hand"):
        renderer.update_scene(data, camera=camera)
        picture = renderer.render()
        assert picture.std() > 10
        np.testing.assert_array_equal(picture[::-1], seen[f"{camera}_image"])
print("equal")
"""


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_pictures_equal_liberos_upside_down(angle: float) -> None:
    environment = {**os.environ, "MUJOCO_GL": back_end_or_skip()}
    command = [sys.executable, "-c", PICTURES, "turn_on_the_stove", str(angle)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.endswith("equal\n"), done.stderr


# ---- goals -----------------------------------------------------------------------------------------------

GOALS = [
    ("on", "akita_black_bowl_1", "plate_1"),
    ("on", "akita_black_bowl_1", "flat_stove_1_cook_region"),
    ("on", "akita_black_bowl_1", "wooden_cabinet_1_top_side"),
    ("on", "plate_1", "main_table_stove_front_region"),
    ("on", "cream_cheese_1", "akita_black_bowl_1"),
    ("on", "wine_bottle_1", "wine_rack_1_top_region"),
    ("on", "wine_bottle_1", "wooden_cabinet_1_top_side"),
    ("in", "akita_black_bowl_1", "wooden_cabinet_1_top_region"),
    ("open", "wooden_cabinet_1_middle_region"),
    ("open", "wooden_cabinet_1"),
    ("close", "wooden_cabinet_1_middle_region"),
    ("turnon", "flat_stove_1"),
    ("turnoff", "flat_stove_1"),
]
"""All goals of libero_goal, whose tasks share a scene, and the opposite predicates."""


def scatter(theirs: Any, goal: Sequence[str], generator: np.random.Generator) -> None:
    """Put the first thing of a goal near the second, and all drawers and knobs anywhere."""
    sim, env = theirs.sim, theirs.env
    model, data = sim.model._model, sim.data._data
    for name in env.fixtures_dict.values():
        for joint in name.joints:
            low, high = model.joint(joint).range
            data.joint(joint).qpos[:] = generator.uniform(low - 0.1, high + 0.1)
    if len(goal) == 3:
        sim.forward()
        _, thing, support = goal
        region = support in env.object_sites_dict
        place = data.site(support).xpos if region else data.body(env.get_object(support).root_body).xpos
        near = generator.uniform((-0.06, -0.06, -0.04), (0.06, 0.06, 0.1))
        data.joint(env.get_object(thing).joints[0]).qpos[:3] = place + near
    sim.forward()


def outcomes(task: str, goal: Sequence[str], attempts: int) -> list[bool]:
    """Success with a goal in scattered scenes, the same in LIBERO and in ours."""
    theirs = libero(task)
    theirs.env.parsed_problem["goal_state"] = [list(goal)]
    predicates, generator = goal_of(theirs.env, theirs.sim.model._model), np.random.default_rng(0)
    found = []
    for _ in range(attempts):
        scatter(theirs, goal, generator)
        found.append(all(predicate(theirs.sim.data._data) for predicate in predicates))
        assert found[-1] == theirs.check_success()
    return found


@pytest.mark.parametrize("goal", GOALS, ids=" ".join)
def test_goals_hold_where_they_hold_in_libero(goal: Sequence[str]) -> None:
    assert set(outcomes("put_the_bowl_on_the_plate", goal, 60)) == {True, False}


def test_a_thing_is_in_the_basket_where_it_is_in_libero() -> None:
    goal = "in", "milk_1", "basket_1_contain_region"
    assert set(outcomes("pick_up_the_milk_and_place_it_in_the_basket", goal, 60)) == {True, False}


def test_an_unknown_predicate_names_the_nearest_one() -> None:
    with pytest.raises(UnknownNameError, match="turnon"):
        outcomes("put_the_bowl_on_the_plate", ("turnedon", "flat_stove_1"), 1)
