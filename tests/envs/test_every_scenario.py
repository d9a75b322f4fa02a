"""Tests of every built-in scenario: registering a new one is enough to test it.

A scenario that lacks an extra or a renderer here is skipped with the reason.
"""

import copy
import dataclasses
import itertools
import re
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers import back_end_or_skip, expert_succeeds, output_of
from numpy.typing import NDArray

from clbench.base.dependencies import require_packages
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, MissingPackageError
from clbench.data.questions import load_questions
from clbench.spec.identifiers import scenario_ids
from clbench.spec.language import spelled_words
from clbench.spec.registry import registered_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import Lanes, check_perturbable, vector_world
from clbench.worlds.scenario_env import ScenarioEnv
from clbench.worlds.world import World

BUILT_IN = [
    scenario_id
    for scenario_id in scenario_ids()
    if str(gymnasium.registry[scenario_id].kwargs["scenario"]).startswith("clbench.envs.")
]
every_scenario = pytest.mark.parametrize(
    "scenario", [registered_scenario(name) for name in BUILT_IN], ids=BUILT_IN
)
TASKS = {(task.world, task.name): task for name in BUILT_IN for task in registered_scenario(name).tasks}
every_task = pytest.mark.parametrize("task", TASKS.values(), ids=[name for _, name in TASKS])

QUICK = ("clbench/Fetch-v1", "clbench/MetaWorld-v1")
"""Scenarios that a test in a process of its own tries by default."""

Rows = NDArray[np.float64]


def make(task: Task) -> World:
    """Return the world of a task, or skip the test where a package that it needs is not installed."""
    try:
        require_packages(task.packages, f"the suite {task.suite}")
    except MissingPackageError as error:
        pytest.skip(str(error))
    world: World = resolve(task.world)()
    return world


def make_environment(scenario: Scenario, **options: Any) -> ScenarioEnv:
    make(scenario.tasks[0]).close()
    if scenario.tasks[0].camera is not None:
        back_end_or_skip()
    environment = gymnasium.make(scenario.id, **options).unwrapped
    assert isinstance(environment, ScenarioEnv)
    return environment


def check(environment: gymnasium.Env[Any, Any]) -> None:
    with warnings.catch_warnings():
        # the checker prefers bounded boxes; measurements of a simulator have no bound
        warnings.filterwarnings("ignore", message=r".*A Box observation space (minimum|maximum) value is")
        check_env(environment, skip_render_check=True)


def actions(world: World, seed: int, steps: int) -> NDArray[np.float32]:
    assert isinstance(world.action_space, gymnasium.spaces.Box)
    generator = np.random.default_rng(seed)
    return generator.uniform(-1.0, 1.0, (steps, *world.action_space.shape)).astype(np.float32)


def rollout(world: World, task: str, seed: int, steps: int = 20) -> Rows:
    """Return the states and rewards (steps + 1, S + 1) of an episode of random actions."""
    state, _ = world.reset(seed=seed, options={"task": task})
    return np.stack([np.append(state, 0.0), *moved(world, actions(world, seed, steps))])


def moved(world: World, by: NDArray[np.float32]) -> Rows:
    """Return the states and rewards (steps, S + 1) after some actions (steps, A)."""
    rows = []
    for action in by:
        state, reward, *_ = world.step(action)
        rows.append(np.append(state, float(reward)))
    return np.stack(rows)


def first_task_of_each_world(scenario: Scenario) -> list[Task]:
    worlds: dict[str, Task] = {}
    for task in scenario.tasks:
        worlds.setdefault(task.world, task)
    return list(worlds.values())


@pytest.mark.long
def test_the_data_of_all_scenarios_load_no_simulator() -> None:
    simulators = "{'mujoco', 'gymnasium_robotics', 'dm_control', 'libero', 'metaworld'}"
    code = (
        "import clbench.spec.task, sys\n"
        f"for name in {BUILT_IN}: clbench.spec.registry.registered_scenario(name)\n"
        f"print({simulators} & set(sys.modules))"
    )
    assert output_of(code) == "set()"


@pytest.mark.long
@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(registered_scenario(name), id=name, marks=[] if name in QUICK else [pytest.mark.slow])
        for name in BUILT_IN
    ],
)
def test_an_outsiders_script_makes_it_without_an_import_and_without_pytorch(scenario: Scenario) -> None:
    make_environment(scenario).close()
    shown = output_of(
        "import gymnasium, sys\n"
        f"environment = gymnasium.make('clbench:{scenario.id}')\n"
        "environment.reset(seed=0)\n"
        "environment.step(environment.action_space.sample())\n"
        "print(environment.unwrapped.scenario.id, 'torch' in sys.modules)"  # it takes seconds to import
    )
    assert shown.splitlines()[-1] == f"{scenario.id} False"


@pytest.mark.parametrize("instruction", ["text", "tokens"])
@every_scenario
def test_gymnasiums_own_check_passes(scenario: Scenario, instruction: str) -> None:
    check(make_environment(scenario, instruction=instruction))


@every_scenario
def test_gymnasiums_own_check_passes_for_its_worlds(scenario: Scenario) -> None:
    for task in first_task_of_each_world(scenario):
        check(make(task))


@every_scenario
def test_it_takes_two_hundred_random_steps(scenario: Scenario) -> None:
    environment = make_environment(scenario, instruction="tokens", episodes_per_stage=1)
    environment.reset(seed=0)
    environment.action_space.seed(0)
    for _ in range(200):
        observation, reward, terminated, truncated, info = environment.step(environment.action_space.sample())
        assert environment.observation_space.contains(observation)
        assert np.isfinite(observation["state"]).all()
        assert np.isfinite(reward)
        assert info["success"] == terminated
        if terminated or truncated:
            environment.reset()
    environment.close()


@every_task
def test_an_episode_repeats_itself_whatever_ran_before(task: Task) -> None:
    world, expected = make(task), rollout(make(task), task.name, seed=7)
    others = [name for entry_point, name in TASKS if entry_point == task.world and name != task.name][-2:]
    for other, seed in (*zip(others, (1, 7), strict=False), (task.name, 2)):
        rollout(world, other, seed, steps=31)
        np.testing.assert_array_equal(rollout(world, task.name, seed=7), expected)
    assert not np.array_equal(rollout(world, task.name, seed=8), expected)


@every_task
def test_a_copy_of_a_world_goes_on_as_the_world_does_and_leaves_it_alone(task: Task) -> None:
    world, expected = make(task), rollout(make(task), task.name, seed=2)
    world.reset(seed=2, options={"task": task.name})
    chosen = actions(world, 2, 20)
    moved(world, chosen[:10])
    for one in (copy.deepcopy(world), world):
        np.testing.assert_array_equal(moved(one, chosen[10:]), expected[11:])


@every_task
def test_global_generators_have_no_part_in_it_and_are_left_alone(task: Task) -> None:
    expected = rollout(make(task), task.name, seed=3)
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    np.testing.assert_array_equal(rollout(make(task), task.name, seed=3), expected)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # type: ignore[index]  # noqa: NPY002


@every_scenario
def test_an_episode_without_a_seed_continues_the_random_numbers(scenario: Scenario) -> None:
    world = make(scenario.tasks[0])
    first, second = world.reset(seed=5)[0], world.reset()[0]
    assert not np.array_equal(first, second)
    world.reset(seed=5)
    np.testing.assert_array_equal(world.reset()[0], second)


@every_scenario
def test_episodes_side_by_side_equal_the_plain_world_bit_for_bit(scenario: Scenario) -> None:
    tasks = [*scenario.tasks[:2], *scenario.tasks[-3:]]
    plain, lanes = [make(task) for task in tasks], Lanes(5, threads=3)
    states = lanes.reset([4, 2, 0], [4, 2, 0], [tasks[4], tasks[2], tasks[0]])
    for row, lane in enumerate([4, 2, 0]):
        state, _ = plain[lane].reset(seed=lane, options={"task": tasks[lane].name})
        assert states[row].tobytes() == state.tobytes()
    acts = np.stack([actions(plain[lane], lane, 20) for lane in range(5)], axis=1)
    for step, moving in zip(range(20), itertools.cycle([[4, 2, 0], [0], [2, 4], [0, 4]])):
        states, rewards, successes = lanes.step(moving, acts[step, moving])
        for row, lane in enumerate(moving):
            state, reward, success, *_ = plain[lane].step(acts[step, lane])
            assert states[row].tobytes() == state.tobytes()
            assert (rewards[row], successes[row]) == (reward, success)
        if step == 10:
            lanes.reset([1, 3], [9, 9], [tasks[1], tasks[3]])
    lanes.close()


def steps(
    lanes: Lanes, lane: int, task: Task, seed: int, perturbed: bool, count: int = 12
) -> NDArray[np.float32]:
    """Return the states (count + 1, S) of an episode of random actions in a lane."""
    world = lanes.world(task, perturbed)
    states = [lanes.reset([lane], [seed], [task], [perturbed])[0]]
    space = world.single_action_space
    for action in np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 1, *space.shape)):
        states.append(lanes.step([lane], action.astype(np.float32))[0][0])
    return np.stack(states)


@every_scenario
def test_a_perturbed_episode_follows_from_its_seed_in_any_lane_and_changes_no_plain_one(
    scenario: Scenario,
) -> None:
    for task in first_task_of_each_world(scenario):
        make(task).close()
    check_perturbable(scenario.tasks)
    for task in (*scenario.tasks[:1], *scenario.tasks[-2:]):
        plain, perturbed = (steps(Lanes(1), 0, task, 7, flag) for flag in (False, True))
        assert np.isfinite(perturbed).all()
        assert not np.array_equal(plain[0], perturbed[0])
        lanes = Lanes(3, threads=2)
        for lane, seed, flag in ((2, 1, True), (2, 7, True), (0, 2, False), (0, 7, True), (2, 3, True)):
            found = steps(lanes, lane, task, seed, flag)
            if seed == 7:
                np.testing.assert_array_equal(found, perturbed)
        np.testing.assert_array_equal(steps(lanes, 2, task, 7, False), plain)
        starts = lanes.reset([0, 1, 2], [7, 7, 7], [task] * 3, [True, False, True])
        np.testing.assert_array_equal(starts, [perturbed[0], plain[0], perturbed[0]])
        still = np.zeros((1, *lanes.world(task).single_action_space.shape), np.float32)
        assert not any(lanes.step([lane], still)[2][0] for lane in range(3))
        lanes.close()


@every_task
def test_the_expert_does_its_task(task: Task) -> None:
    make(task).close()
    # LIBERO's experts succeed in 96 % of their episodes or more, all others in these four for certain
    least = 3 if "libero" in task.world else 4
    assert sum(expert_succeeds(task, seed) for seed in range(100, 104)) >= least


HARD_IF_PERTURBED = {
    "carry_back": 0.5,  # the hand relaxes while it moves to its start, and drops the heavier block
    "peg_unplug_side": 0.6,  # Meta-World's expert flicks the peg, which moves it too little if it is heavier
    "stick_pull": 0.7,
    "cartpole_left": 0.75,
    "cartpole_right": 0.75,
}
"""Least success of experts that fail in over a tenth of the perturbed episodes; docs/guide/statistics.md."""


@pytest.mark.slow
@every_scenario
def test_experts_do_the_tasks_in_perturbed_worlds_too(scenario: Scenario) -> None:
    episodes = 40
    for task in (*scenario.retained, *scenario.target):
        make(task).close()
        expert, lanes = resolve(task.expert)(task.name), Lanes(episodes)
        going, done = list(range(episodes)), 0
        states = lanes.reset(going, list(range(episodes)), [task] * episodes, [True] * episodes)
        for _ in range(task.horizon):
            actions = np.stack([expert(state) for state in states])
            states, _, successes = lanes.step(going, actions)
            going = [lane for lane, success in zip(going, successes, strict=True) if not success]
            done, states = done + int(successes.sum()), states[~successes]
            if not going:
                break
        assert done >= HARD_IF_PERTURBED.get(task.name, 0.9) * episodes, f"{task.name}: {done} of {episodes}"
        lanes.close()


@every_scenario
def test_worlds_that_threads_use_at_the_same_time_change_nothing(
    scenario: Scenario,
) -> None:
    make(scenario.tasks[0]).close()
    tasks = [task for task in scenario.tasks if task.world == scenario.tasks[0].world]

    def states(number: int) -> list[NDArray[np.float32]]:
        world, found = vector_world(tasks[0].world, 1), []
        for seed in (*range(50 * number, 50 * number + 20), 2**32):
            found.append(world.reset([0], [seed], [tasks[seed // 5 % len(tasks)].name]))
            pushes = np.random.default_rng(seed).uniform(-1.0, 1.0, (3, *world.single_action_space.shape))
            found += [world.step([0], push[None])[0] for push in pushes]
        world.close()
        return found

    expected = [states(number) for number in range(3)]
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(3) as pool:
            for number, found in enumerate(pool.map(states, range(3))):
                np.testing.assert_array_equal(found, expected[number])
    finally:
        sys.setswitchinterval(before)


@every_scenario
def test_no_task_is_done_at_the_start(scenario: Scenario) -> None:
    worlds = {task.world: make(task) for task in scenario.tasks}
    for task in scenario.tasks:
        world = worlds[task.world]
        for seed in range(20):
            _, info = world.reset(seed=seed, options={"task": task.name})
            assert info == {"success": False, "task": task.name}
            assert not world.step(np.zeros_like(actions(world, 0, 1)[0]))[2]


@every_scenario
def test_an_unknown_task_is_an_error_that_names_the_nearest(scenario: Scenario) -> None:
    task = scenario.tasks[0]
    message = f"{task.name}x'.* Did you mean '{task.name}'"
    with pytest.raises(LookupError, match=message):
        make(task).reset(options={"task": f"{task.name}x"})
    with pytest.raises(LookupError, match=message):
        vector_world(task.world, 1).reset([0], [0], [f"{task.name}x"])
    with pytest.raises(LookupError, match=message):
        resolve(task.expert)(f"{task.name}x")


@every_scenario
def test_an_impossible_action_is_an_error_that_names_it(scenario: Scenario) -> None:
    for task in first_task_of_each_world(scenario):
        plain, lanes = make(task), Lanes(2)
        plain.reset(seed=0, options={"task": task.name})
        lanes.reset([0, 1], [0, 1], [task, task])
        good = actions(plain, 0, 1)[0] * 0
        size = len(good)
        for number in (np.nan, np.inf, -np.inf):
            bad = good.copy()
            bad[-1] = number
            message = re.escape(f"must be finite, not {bad.tolist()}")
            with pytest.raises(ValueError, match=message):
                plain.step(bad)
            with pytest.raises(ValueError, match=message):
                lanes.step([0, 1], np.stack([good, bad]))
        longer = np.zeros(size + 1, np.float32)
        message = re.escape(f"must have shape ({size},), not ({size + 1},)")
        with pytest.raises(ValueError, match=message):
            plain.step(longer)
        with pytest.raises(ValueError, match=message):
            lanes.step([0, 1], np.stack([longer, longer]))
        with pytest.raises(ValueError, match=re.escape(f"must have shape ({size},), not (1, {size})")):
            plain.step(good[None])
        for rows in (1, 3):  # NumPy would repeat the one, and leave out the third
            message = f"2 lanes of the .* world need one action each, not {rows} in total"
            with pytest.raises(ValueError, match=message):
                lanes.step([0, 1], np.stack([good] * rows))


@every_scenario
def test_actions_beyond_the_bounds_are_cut(scenario: Scenario) -> None:
    for task in first_task_of_each_world(scenario):
        world, states = make(task), []
        for far in (1.0, 9.0, 1e300):  # the last is finite, but too large for a number of 32 bits
            world.reset(seed=0, options={"task": task.name})
            action = np.full(world.action_space.shape or (), far)
            action[1::2] *= -1
            states.append(world.step(action)[0])
        np.testing.assert_array_equal(states[0], states[1])
        np.testing.assert_array_equal(states[0], states[2])


@every_scenario
def test_a_lane_without_an_episode_is_named(scenario: Scenario) -> None:
    for task in first_task_of_each_world(scenario):
        action = actions(make(task), 0, 1)[0]
        world = vector_world(task.world, 2)
        world.reset([0], [0], [task.name])
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"Lane 1 of the .* has no episode: reset it"):
            world.step([0, 1], np.stack([action, action]))
        world.close()


@every_scenario
def test_instructions_and_questions_are_plain_words_of_the_vocabulary(scenario: Scenario) -> None:
    sentences = []
    tasks = (*scenario.tasks, *scenario.background)
    for texts in (
        # a wording of test episodes must be no wording of training, of its own task or of another
        *((*task.instructions, *task.test_instructions) for task in tasks),
        *(kind.wordings for kind in resolve(scenario.questions)),
    ):
        assert len(set(texts)) == len(texts) >= 3
        sentences += texts
    assert len(set(sentences)) == len(sentences), "a sentence means two things"
    sentences += [answer for kind in resolve(scenario.questions) for answer in kind.answers]
    assert all(word.isalpha() and word.islower() for sentence in sentences for word in sentence.split(" "))
    assert spelled_words(sentences) == []


@every_scenario
def test_questions_answer_many_states_as_they_answer_each(scenario: Scenario) -> None:
    episodes = [rollout(make(task), task.name, seed=3) for task in scenario.scene_tasks[:2]]
    states = np.concatenate(episodes)[:, :-1].astype(np.float32)
    for kind in resolve(scenario.questions):
        answers = kind.answer(states)
        assert answers.shape == (len(states),)
        assert answers.dtype == np.int64
        assert set(answers.tolist()) <= set(range(-1, len(kind.answers)))
        np.testing.assert_array_equal(answers, [kind.answer(state[None])[0] for state in states])


@pytest.mark.slow
def test_scenes_of_background_tasks_give_the_answers_that_retained_skills_lack() -> None:
    scenario = registered_scenario("clbench/MetaWorld-v1")
    make(scenario.tasks[0]).close()
    few = dataclasses.replace(scenario, budget=dataclasses.replace(scenario.budget, question_episodes=64))
    assert all(questions.kinds for questions in load_questions(few))
    with pytest.raises(
        InputError, match="No state gives the answer 'left' to the question 'target_side_of_object'"
    ):
        load_questions(dataclasses.replace(few, scenes=()))
