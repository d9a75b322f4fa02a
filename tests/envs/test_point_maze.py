"""The PointMaze world, its mazes, tasks, expert and questions."""

import dataclasses
import importlib
import itertools
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from helpers import back_end_or_skip, expert_succeeds
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.seeding import derive_seed
from clbench.data import demonstrations, expert_rates
from clbench.data.questions import load_questions, scored_questions
from clbench.spec.language import word_id
from clbench.spec.registry import load_scenario, registered_scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import vector_world
from clbench.worlds.perturbation import draw_perturbation

mazes = importlib.import_module("clbench.envs.point_maze.mazes")
scene = resolve("clbench.envs.point_maze.scene:scene")

MAZES, ROOMS, centre = mazes.MAZES, mazes.ROOMS, mazes.centre
SCENARIO = load_scenario("clbench:clbench/PointMaze-v1")
NAMES = [task.name for task in SCENARIO.tasks]
World = resolve(SCENARIO.tasks[0].world)
QUESTIONS = {kind.name: kind for kind in resolve(SCENARIO.questions)}

State = NDArray[np.float32]


def random_actions(seed: int, steps: int) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 2)).astype(np.float32)


def state(
    x: float = 0.0, y: float = 0.0, vx: float = 0.0, vy: float = 0.0, colour: str = "red", **ahead: float
) -> State:
    """Return a state (1, 11) made by hand; walls are 0.5 m away unless `ahead` gives a distance."""
    ways = [ahead.get(direction, 0.5) for direction in ("right", "left", "above", "below")]
    return np.array([[x, y, vx, vy, *ways, *(colour == name for name in MAZES)]], np.float32)


def test_the_scenario_has_the_promised_parts() -> None:
    assert [len(group) for group in (SCENARIO.retained, SCENARIO.target, SCENARIO.held_out)] == [2, 4, 2]
    assert len(QUESTIONS) >= 8
    world = World()
    assert world.observation_space.shape == (11,)
    assert world.action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)


def test_every_target_is_in_a_maze_that_the_policy_knows_and_shares_its_states() -> None:
    mazes = {task.name.partition("_")[0] for task in SCENARIO.pretrained}
    assert mazes == set(MAZES)
    starts = {name: World().reset(seed=3, options={"task": name})[0] for name in NAMES}
    for task in SCENARIO.tasks:
        colour = task.name.partition("_")[0]
        assert [bool(flag) for flag in starts[task.name][8:]] == [colour == maze for maze in MAZES]


# gymnasium-robotics writes the map into a file and leaves it behind
@pytest.mark.parametrize("maze", MAZES.values(), ids=list(MAZES))
def test_physics_and_observation_equal_point_maze(
    maze: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gymnasium_robotics.envs.maze.point_maze import PointMazeEnv

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    wall = [1] * 7
    drawn = [[1, *(int(character == " ") for character in line), 1] for line in maze.drawing]
    original = PointMazeEnv(maze_map=[wall, *drawn, wall]).point_env
    world = World.vector_world(lanes=1)
    first = world.reset([0], [0], [f"{maze.colour}_middle"])[0]
    original.reset(seed=0)
    original.set_state(world.drawable(0).data.qpos, np.zeros(2))
    # repeated actions bring the ball to its top speed and against the walls
    actions = np.repeat(random_actions(1, 30), 5, axis=0)
    got, speeds = [], []
    for action in actions:
        got.append(world.step([0], action[None])[0][0, :4])
        for _ in range(10):
            observation, *_ = original.step(action)
        np.testing.assert_array_equal(got[-1], observation.astype(np.float32))
        speeds.append(abs(observation[2:]).max())
    assert max(speeds) > 4.9
    assert np.ptp(np.stack(got)[:, :2], axis=0).min() > 2.0
    assert not np.array_equal(first[:4], got[-1])
    original.close()


@pytest.mark.parametrize("maze", MAZES.values(), ids=list(MAZES))
def test_the_distances_to_the_walls_equal_ray_casts(maze: Any) -> None:
    model = scene(maze.colour)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    generator = np.random.default_rng(0)
    for cell in maze.free:
        x, y = np.add(centre(cell), generator.uniform(-0.4, 0.4, 2))
        found = []
        for row, column in mazes.DIRECTIONS:
            hit = np.zeros(1, np.int32)
            ray = np.array([column, -row, 0.0])
            # walls alone: they are fixed, and begin at the floor
            found.append(mujoco.mj_ray(model, data, np.array([x, y, 0.2]), ray, None, 1, 1, hit))
        np.testing.assert_allclose(maze.room_ahead((x, y)), found, atol=1e-9)


@pytest.mark.parametrize(
    ("colour", "start", "goal", "steps"),
    [
        ("red", "upper_left", "upper_right", 4),
        ("red", "upper_left", "lower_left", 8),
        ("blue", "upper_left", "lower_left", 4),
        ("blue", "upper_left", "upper_right", 8),
        ("green", "upper_left", "lower_left", 8),
        ("green", "left", "left", 0),
    ],
)
def test_ways_are_the_shortest(colour: str, start: str, goal: str, steps: int) -> None:
    maze = MAZES[colour]
    assert maze.steps(ROOMS[start], goal) == steps
    point, metres = maze.way(centre(ROOMS[start]), goal)
    assert metres == steps
    assert sum(abs(a - b) for a, b in zip(point, centre(ROOMS[start]), strict=True)) == min(steps, 1)


def test_every_room_of_every_maze_can_be_reached() -> None:
    for maze, room in itertools.product(MAZES.values(), ROOMS):
        assert all(maze.steps(cell, room) <= 8 for cell in maze.free)


def test_the_ball_starts_anywhere_that_is_three_cells_from_the_goal() -> None:
    world, maze = World(), MAZES["blue"]
    starts = set()
    for seed in range(200):
        first, _ = world.reset(seed=seed, options={"task": "blue_upper"})
        x, y = first[:2].tolist()
        assert abs(x - round(x)) <= 0.25
        assert abs(y - round(y)) <= 0.25
        starts.add(maze.cell((x, y)))
        np.testing.assert_array_equal(first[2:4], 0.0)
    assert starts == {cell for cell in maze.free if maze.steps(cell, "upper") >= 3}


@pytest.mark.parametrize("task", SCENARIO.tasks, ids=NAMES)
def test_the_expert_recovers_from_random_actions(task: Task) -> None:
    # they can carry the ball to the other end: one episode may lack time for the way back
    assert sum(expert_succeeds(task, seed, random_actions(seed, 5)) for seed in range(100, 104)) >= 3


def test_the_reward_grows_while_the_expert_acts_and_is_highest_at_success() -> None:
    for task in SCENARIO.tasks:
        world, expert = World(), resolve(task.expert)(task.name)
        current, _ = world.reset(seed=100, options={"task": task.name})
        rewards, terminated = [], False
        while not terminated:
            current, reward, terminated, *_ = world.step(expert(current))
            rewards.append(reward)
        assert rewards[-1] > 0.5 > -2.0 > rewards[0]
        assert rewards == sorted(rewards)


def test_experts_of_retained_tasks_do_no_target_task_by_chance() -> None:
    world = World()
    for known, task in itertools.product(SCENARIO.retained, SCENARIO.target):
        expert, successes = resolve(known.expert)(known.name), 0
        for seed in range(200, 204):
            current, _ = world.reset(seed=seed, options={"task": task.name})
            for _ in range(40):
                current, _, terminated, *_ = world.step(expert(current))
                successes += terminated
                if terminated:
                    break
        same_room = known.name.partition("_")[2] == task.name.partition("_")[2]
        assert successes == 4 * same_room, f"the expert of {known.name} does {task.name}"


def test_passing_through_the_room_without_a_stop_is_no_success() -> None:
    world = World()
    current, _ = world.reset(seed=0, options={"task": "red_upper"})
    # from the hub up, at full speed through the room against its wall
    expert = resolve(SCENARIO.tasks[0].expert)("red_upper")
    while abs(current[0]) > 0.05 or current[1] < 0.5:
        current, *_ = world.step(expert(current))
    inside = []
    for _ in range(6):
        current, _, terminated, *_ = world.step(np.array([0.0, 1.0], np.float32))
        inside.append(bool(np.hypot(current[0], current[1] - 2.0) < 0.45))
        if inside[-1] and np.hypot(*current[2:4]) > 0.5:
            assert not terminated
    assert any(inside)


@pytest.mark.parametrize(
    ("kind", "expected", "seen"),
    [
        ("side", "left", state(x=-1.0)),
        ("side", "right", state(x=1.0)),
        ("side", None, state(x=0.2)),
        ("height", "upper", state(y=1.0)),
        ("height", "lower", state(y=-1.0)),
        ("height", None, state()),
        ("middle", "yes", state(x=0.4)),
        ("middle", "no", state(x=1.0, y=1.0)),
        ("middle", None, state(x=1.0)),
        ("edge", "left", state(x=-2.0, y=1.0)),
        ("edge", "right", state(x=2.0, y=1.0)),
        ("edge", "top", state(x=-1.0, y=2.0)),
        ("edge", "bottom", state(x=-1.0, y=-2.0)),
        ("edge", None, state(x=-2.0, y=-2.1)),
        ("part", "room", state(x=2.1, y=-1.8)),
        ("part", "corridor", state(x=1.1, y=2.0)),
        ("part", None, state(x=1.45, y=2.0)),
        ("colour", "red", state(colour="red")),
        ("colour", "blue", state(colour="blue")),
        ("colour", "green", state(colour="green")),
        ("moving", "yes", state(vx=-1.0)),
        ("moving", "no", state()),
        ("moving", None, state(vy=0.3)),
        ("pace", "fast", state(vx=-2.5)),
        ("pace", "slow", state(vx=1.0)),
        ("pace", None, state(vx=1.7)),
        ("heading_side", "left", state(vx=-1.0)),
        ("heading_side", "right", state(vx=1.0)),
        ("heading_side", None, state(vy=2.0)),
        ("heading_height", "up", state(vy=1.0)),
        ("heading_height", "down", state(vy=-1.0)),
        ("heading_height", None, state(vx=2.0)),
        ("way_right", "open", state(right=1.5)),
        ("way_right", "closed", state(left=1.5)),
        ("way_right", None, state(right=1.0)),
        ("way_left", "open", state(left=1.5)),
        ("way_left", "closed", state(right=1.5)),
        ("way_left", None, state(left=1.0)),
        ("way_up", "open", state(above=1.5)),
        ("way_up", "closed", state(below=1.5)),
        ("way_up", None, state(above=1.0)),
        ("way_down", "open", state(below=1.5)),
        ("way_down", "closed", state(above=1.5)),
        ("way_down", None, state(below=1.0)),
        ("nearer_side_wall", "left", state(right=1.5)),
        ("nearer_side_wall", "right", state(left=1.5)),
        ("nearer_side_wall", None, state(right=0.6)),
        ("nearer_height_wall", "above", state(below=1.5)),
        ("nearer_height_wall", "below", state(above=1.5)),
        ("nearer_height_wall", None, state(above=0.6)),
    ],
)
def test_answers_match_the_scene(kind: str, expected: str | None, seen: State) -> None:
    question = QUESTIONS[kind]
    (index,) = question.answer(seen)
    assert (None if index == -1 else question.answers[index]) == expected


def test_questions_have_balanced_answers_for_training_and_test() -> None:
    few = dataclasses.replace(SCENARIO, budget=dataclasses.replace(SCENARIO.budget, question_episodes=48))
    for questions in load_questions(few):
        kind, batch = scored_questions(questions, 1600)
        assert torch.bincount(kind).tolist() == [100] * 16
        for index, entry in enumerate(questions.kinds):
            for answer in entry.answers:
                share = float((batch.answer[kind == index] == word_id(answer)).float().mean())
                assert share == pytest.approx(1 / len(entry.answers), abs=0.2)


@pytest.mark.long
def test_pictures_show_the_maze_of_the_task_and_leave_the_episode_alone() -> None:
    """Draw in another process, which a broken rendering back end may kill."""
    code = """
import numpy as np
from clbench.envs.point_maze.world import PointMazeWorld
world, twin = PointMazeWorld(render_mode="rgb_array"), PointMazeWorld()
for channel, task in ((0, "red_left"), (2, "blue_left"), (1, "green_left"), (0, "red_left")):
    for one in (world, twin):
        one.reset(seed=0, options={"task": task})
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 2)).astype(np.float32):
        assert (world.step(action)[0] == twin.step(action)[0]).all()
        picture = world.render()
    assert picture.shape == (480, 480, 3)
    assert picture[10:470, 20:60].mean(axis=(0, 1)).argmax() == channel
world.close()
print("drawn")
"""
    environment = {**os.environ, "MUJOCO_GL": back_end_or_skip()}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "drawn", result.stderr


@pytest.mark.parametrize("seed", range(4))
def test_in_a_perturbed_episode_the_ball_is_heavier_and_displaced(seed: int) -> None:
    worlds = [vector_world(SCENARIO.tasks[0].world, 1, 1, perturbed) for perturbed in (False, True)]
    (plain,), (perturbed,) = (world.reset([0], [seed], [NAMES[0]]) for world in worlds)
    models = [world.drawable(0).model for world in worlds]  # type: ignore[attr-defined]
    drawn = draw_perturbation(seed)
    assert models[1].body("particle").mass == drawn.mass * models[0].body("particle").mass
    np.testing.assert_allclose(perturbed[:2] - plain[:2], 0.1 * np.array(drawn.start[:2]), atol=1e-6)
    pushed = [world.step([0], np.ones((1, 2), np.float32))[0][0, 2] for world in worlds]
    assert (pushed[1] > pushed[0]) == (drawn.mass < 1)


def test_a_perturbed_ball_never_starts_in_a_wall() -> None:
    world = vector_world(SCENARIO.tasks[0].world, 1, 1, perturbed=True)
    for seed, name in enumerate(NAMES * 20):
        ahead = world.reset([0], [seed], [name])[0, 4:8]
        assert ahead.min() > 0.1  # its radius


def test_seeds_and_data_set_ids_keep_the_old_spelling_of_the_suite(monkeypatch: pytest.MonkeyPatch) -> None:
    task = SCENARIO.task("red_left")
    assert task.suite == "point_maze"
    assert task.dataset_id == "clbench/point-maze/red-left-v0"
    assert derive_seed("demonstration", task.dataset_id, 0) == 1484796457
    assert derive_seed("picture", task.seed_suite, task.name) == 242747921
    seeds = []

    def note_seed(world: gymnasium.Env[Any, Any], task: Task, seed: int, noisy: bool) -> Any:
        seeds.append(seed)
        return demonstrations.demonstrate(world, task, seed, noisy=noisy)

    monkeypatch.setattr(expert_rates, "demonstrate", note_seed)
    expert_rates.measure(SCENARIO, [task], episodes=2)
    assert seeds == [1642424505, 688404758]


def test_suites_have_one_spelling_and_seeds_keep_the_old_one() -> None:
    names = ("Fetch-v1", "FetchPixels-v0", "DMControl-v0", "MetaWorld-v1", "MetaWorldCW-v0")
    scenarios = [registered_scenario(f"clbench:clbench/{name}") for name in names]
    spellings = [{task.seed_suite for task in scenario.target} for scenario in scenarios]
    assert spellings == [{"fetch_tidy"}, {"fetch-pixels"}, {"dm_control"}, {"metaworld"}, {"metaworld-cw"}]
    suites = [{task.suite for task in scenario.tasks} for scenario in scenarios]
    assert suites == [{"fetch"}, {"fetch_pixels"}, {"dm_control"}, {"metaworld"}, {"metaworld_cw"}]
