"""Scenarios as Gymnasium environments, for Gymnasium's own tools and for Stable-Baselines3."""

import dataclasses
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from helpers import back_end_or_skip, scenario_or_skip

from clbench.spec.identifiers import scenario_ids
from clbench.spec.language import encode
from clbench.spec.registry import load_scenario
from clbench.testing import TOY, ToyWorld
from clbench.worlds.scenario_env import ScenarioEnv

FETCH = "clbench/Fetch-v1"


def _toy(**options: Any) -> ScenarioEnv:
    return ScenarioEnv("clbench.testing:TOY", **options)


def test_a_recorded_episode_has_the_speed_of_its_world() -> None:
    assert _toy().metadata["render_fps"] == 10  # Gymnasium's RecordVideo reads it; the class says 25


class Paced(ToyWorld):
    """A world with a rate for each task."""

    def reset(self, **options: Any) -> Any:
        begun = super().reset(**options)
        self.metadata = {**self.metadata, "render_fps": {"left": 5, "up": 50}[self._task]}
        return begun


def test_the_speed_follows_the_task_at_each_reset_and_is_the_environments_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("clbench.testing.ToyWorld", Paced)
    env, other = gymnasium.make("clbench.testing:clbench/Toy-v0"), _toy()
    shown = [env.reset(options={"task": task}) and env.metadata["render_fps"] for task in ("left", "up")]
    assert shown == [5, 50]
    assert (other.metadata["render_fps"], ScenarioEnv.metadata["render_fps"]) == (10, 25)


def test_the_schedule_goes_from_the_skills_to_each_target_and_stays_at_the_last() -> None:
    env = _toy(episodes_per_stage=3)
    schedule = []
    for _ in range(12):
        _, info = env.reset()
        schedule.append((info["stage"], info["task"]))
    skills = [(0, "left"), (0, "up"), (0, "left")]
    assert schedule == skills + [(1, "right")] * 3 + [(2, "down")] * 6


def test_without_skills_the_schedule_begins_with_the_first_target() -> None:
    scenario = dataclasses.replace(TOY, retained=(), scenes=TOY.target)
    env = ScenarioEnv(scenario, episodes_per_stage=2)
    for options in (None, {"stage": 1}):
        schedule = [env.reset(options=options)[1]] + [env.reset()[1] for _ in range(4)]
        found = [(info["stage"], info["task"]) for info in schedule]
        assert found == [(1, "right")] * 2 + [(2, "down")] * 3
    with pytest.raises(ValueError, match="has stages 1 to 2, not 0"):
        env.reset(options={"stage": 0})


@pytest.mark.parametrize(("stage", "tasks"), [(0, ["left", "up"] * 2), (1, ["right"] * 4), (2, ["down"] * 4)])
def test_an_environment_of_one_stage_never_leaves_it(stage: int, tasks: list[str]) -> None:
    env = _toy(stage=stage, episodes_per_stage=1)
    schedule = [env.reset()[1] for _ in range(4)]
    assert [(info["stage"], info["task"]) for info in schedule] == [(stage, task) for task in tasks]
    other = (stage + 1) % 3
    with pytest.raises(ValueError, match=f"stays in stage {stage}: make another for stage {other}"):
        env.reset(options={"stage": other})


@pytest.mark.parametrize("stage", [-1, 3, "1"])
def test_an_environment_of_a_missing_stage_is_refused(stage: Any) -> None:
    with pytest.raises(ValueError, match=f"clbench/Toy-v0 has stages 0 to 2, not {stage!r}"):
        _toy(stage=stage)


def test_a_chosen_task_has_the_stage_that_trains_it_and_is_no_episode_of_the_schedule() -> None:
    env = _toy(episodes_per_stage=2)
    names = ("left", "right", "down", "up_left")
    stages = {name: env.reset(options={"task": name})[1]["stage"] for name in names}
    assert stages == {"left": 0, "right": 1, "down": 2, "up_left": 0}
    assert [env.reset()[1]["task"] for _ in range(3)] == ["left", "up", "right"]


@pytest.mark.parametrize("vector", [False, True])
def test_the_targets_come_in_the_order_that_is_asked_for(vector: bool) -> None:
    if vector:
        envs = gymnasium.make_vec("clbench.testing:clbench/Toy-v0", 2, order=1)
        schedule = [envs.reset(options={"stage": stage})[1]["task"][1] for stage in range(3)]
    else:
        env = gymnasium.make("clbench.testing:clbench/Toy-v0", order=1)
        schedule = [env.reset(options={"stage": stage})[1]["task"] for stage in range(3)]
    assert schedule == ["left", "down", "right"]
    with pytest.raises(ValueError, match="clbench/Toy-v0: 2 targets have orders 0 to 1, not 2"):
        _toy(order=2)


def test_a_seed_begins_the_schedule_anew_and_repeats_it_bit_for_bit() -> None:
    env = _toy(episodes_per_stage=2)

    def schedule() -> list[tuple[str, str, bytes]]:
        states = []
        observation, info = env.reset(seed=5)
        for _ in range(5):
            states.append((info["task"], info["instruction"], observation["state"].tobytes()))
            observation, info = env.reset()
        return states

    first = schedule()
    assert len({state for _, _, state in first}) == 5
    assert schedule() == first


def test_a_seed_draws_the_wording_and_then_the_start_of_each_episode() -> None:
    env, generator, wordings = _toy(), np.random.default_rng(5), set()
    for number in range(8):
        observation, info = env.reset(seed=None if number else 5)
        known = TOY.task(info["task"]).instructions
        assert info["instruction"] == known[generator.integers(len(known))]
        seed = int(generator.integers(2**31))
        state, _ = ToyWorld().reset(seed=seed, options={"task": info["task"]})
        assert np.array_equal(observation["state"], state)
        wordings.add(info["instruction"])
    assert wordings == {words for task in TOY.retained for words in task.instructions}


def test_options_choose_a_task_or_a_stage() -> None:
    env = _toy()
    assert env.reset(options={"task": "up_left"})[1]["task"] == "up_left"
    _, info = env.reset(options={"stage": 2})
    assert (info["stage"], info["task"]) == (2, "down")
    assert env.reset()[1]["stage"] == 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"task": "lefft"}, LookupError, "Did you mean 'left'"),
        ({"stage": 3}, ValueError, "has stages 0 to 2, not 3"),
        ({"stage": 1.0}, ValueError, "has stages 0 to 2, not 1.0"),
        ({"stage": True}, ValueError, "has stages 0 to 2, not True"),
        ({"task": 3}, ValueError, 'The option "task" must be a name, not 3'),
        ({"task": None}, ValueError, 'The option "task" must be a name, not None'),
        ({"task": "left", "stage": 99}, ValueError, "not both"),
        ({"goal": 3}, ValueError, "Options of reset are"),
        ({"task": "up", 7: 1, "goal": 3}, ValueError, "not \\[7, 'goal'\\]"),
    ],
)
def test_wrong_options_are_refused_by_name(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        _toy().reset(options=options)


@pytest.mark.parametrize(
    "options",
    [{"instruction": "audio"}, {"episodes_per_stage": 0}, {"episodes_per_stage": 1.5}, {"stage": 1.0}],
)
def test_wrong_keywords_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        _toy(**options)


def test_an_episode_ends_with_success_or_at_the_horizon() -> None:
    env = _toy()
    env.reset(seed=0, options={"task": "left"})
    results = [env.step(np.array([-1, 0], np.float32)) for _ in range(4)]
    assert [result[2] for result in results] == [False, False, False, True]
    assert results[-1][4]["success"]
    env.reset(seed=0, options={"task": "left"})
    results = [env.step(np.array([1, 0], np.float32)) for _ in range(12)]
    assert [result[3] for result in results] == [False] * 11 + [True]
    assert not any(result[2] for result in results)


class Patient(ToyWorld):
    """A world that judges success only at the horizon, the 12th step."""

    success_at_horizon = True

    def reset(self, **options: Any) -> Any:
        self._steps = 0
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        self._steps += 1
        state, reward, success, _, info = super().step(action)
        success = success and self._steps == 12
        return state, reward, success, False, {**info, "success": success}


@pytest.mark.parametrize(("speed", "success"), [(-0.5, True), (0.0, False)])
def test_an_episode_whose_success_is_judged_at_the_horizon_is_truncated_whatever_it_is(
    speed: float, success: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.testing.ToyWorld", Patient)
    env = _toy(task="left")
    env.reset(seed=0)
    results = [env.step(np.array([speed, 0], np.float32)) for _ in range(12)]
    ends = [(terminated, truncated) for _, _, terminated, truncated, _ in results]
    assert ends == [(False, False)] * 11 + [(False, True)]
    assert [info["success"] for *_, info in results] == [False] * 11 + [success]


def test_steps_add_up_over_episodes_and_the_first_episode_gives_the_time_of_the_start() -> None:
    env, begun = _toy(), []
    assert (env.steps_taken, env.begun_at) == (0, None)
    before = time.perf_counter()
    for _ in range(3):
        env.reset()
        begun.append(env.begun_at)
        for _ in range(4):
            env.step(np.zeros(2, np.float32))
    assert env.steps_taken == 12
    assert begun == [begun[0]] * 3
    assert begun[0] is not None
    assert before <= begun[0] <= time.perf_counter()


def test_observation_and_info_carry_the_instruction() -> None:
    env = gymnasium.make(FETCH, instruction="tokens")
    observation, info = env.reset(seed=0, options={"task": "press"})
    press = load_scenario(FETCH).task("press")
    assert info["instruction"] in press.instructions
    assert np.array_equal(observation["instruction"], encode([info["instruction"]])[0])
    assert set(info) == {"task", "stage", "instruction", "success"}
    assert isinstance(env.unwrapped, ScenarioEnv)
    assert env.unwrapped.scenario is load_scenario(FETCH)


def test_tokens_have_the_length_of_the_longest_text_of_the_scenario() -> None:
    long = "go left and " * 6 + "stop"
    left = dataclasses.replace(TOY.retained[0], instructions=(long,))
    scenario = dataclasses.replace(TOY, retained=(left, TOY.retained[1]))
    env = ScenarioEnv(scenario, instruction="tokens")
    observation, info = env.reset()
    assert info["instruction"] == long
    assert np.array_equal(observation["instruction"], encode([long], 24)[0])
    assert env.observation_space.contains(observation)
    observation, info = env.reset()
    assert np.array_equal(observation["instruction"], encode([info["instruction"]], 24)[0])


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments_step(mode: str) -> None:
    env = gymnasium.make_vec(FETCH, num_envs=2, vectorization_mode=mode, instruction="tokens")
    observation, info = env.reset(seed=0)
    assert observation["state"].shape == (2, 28)
    assert list(info["task"]) == ["reach", "reach"]
    for _ in range(3):
        observation, reward, *_ = env.step(env.action_space.sample())
    assert reward.shape == (2,)
    env.close()


def test_vector_environments_give_text_too() -> None:
    env = gymnasium.make_vec(FETCH, num_envs=2, vectorization_mode="sync")
    observation, _ = env.reset(seed=0)
    assert all(text in load_scenario(FETCH).task("reach").instructions for text in observation["instruction"])
    env.close()


@pytest.mark.long
def test_stable_baselines_checks_and_trains_on_numeric_instructions() -> None:
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_checker import check_env as check_env_of_stable_baselines

    env = gymnasium.make(FETCH, instruction="tokens", episodes_per_stage=10)
    check_env_of_stable_baselines(env)
    agent = SAC(
        "MultiInputPolicy", env, seed=0, learning_starts=100, train_freq=8, buffer_size=2000, device="cpu"
    )
    agent.learn(304)
    assert agent.num_timesteps == 304
    action, _ = agent.predict(env.reset()[0])
    assert env.action_space.contains(action)


@pytest.mark.long
def test_the_scene_renders_without_changing_the_episode() -> None:
    """In a process of its own: a rendering back end that does not work may kill it."""
    code = """
import gymnasium, numpy as np
env = gymnasium.make("clbench:clbench/Fetch-v1", render_mode="rgb_array")
twin = gymnasium.make("clbench/Fetch-v1")
env.reset(seed=0), twin.reset(seed=0)
for action in np.random.default_rng(0).uniform(-1, 1, (20, 4)).astype(np.float32):
    state, other = env.step(action)[0]["state"], twin.step(action)[0]["state"]
    frame = env.render()
    assert (state == other).all()
print(frame.shape, frame.std() > 10)
"""
    environment = {**os.environ, "MUJOCO_GL": back_end_or_skip()}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.stdout.strip() == "(480, 480, 3) True", result.stderr


@pytest.mark.parametrize(("task", "stage"), [("up", 0), ("right", 1), ("up_left", 0)])
def test_an_environment_of_one_task_never_leaves_it(task: str, stage: int) -> None:
    env = gymnasium.make("clbench.testing:clbench/Toy-v0", task=task, episodes_per_stage=1)
    infos = [env.reset(seed=3)[1]] + [env.reset()[1] for _ in range(3)]
    assert [(info["task"], info["stage"]) for info in infos] == [(task, stage)] * 4
    many = gymnasium.make_vec("clbench.testing:clbench/Toy-v0", num_envs=2, task=task, episodes_per_stage=1)
    many.reset(seed=0)
    for _ in range(100):  # episodes end after 12 steps
        *_, info = many.step(np.zeros((2, 2), np.float32))
        assert list(info["task"]) == [task] * 2


def test_one_task_is_a_known_name_and_excludes_a_stage() -> None:
    with pytest.raises(LookupError, match="Did you mean 'left'"):
        _toy(task="lefft")
    with pytest.raises(ValueError, match="stage or task, not both"):
        _toy(task="left", stage=0)
    with pytest.raises(ValueError, match="stays with the task 'left': make another for stage 1"):
        _toy(task="left").reset(options={"stage": 1})


def test_a_step_after_the_end_of_an_episode_is_refused_and_not_counted() -> None:
    env = _toy(task="left")
    env.reset(seed=0)
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(np.array([-1, 0], np.float32))
        ended = terminated or truncated
    steps = env.steps_taken
    with pytest.raises(gymnasium.error.ResetNeeded, match="has ended: call reset"):
        env.step(np.array([-1, 0], np.float32))
    assert env.steps_taken == steps
    env.reset()
    env.step(np.array([-1, 0], np.float32))


@pytest.mark.parametrize("action", [np.zeros(1), 0.0, np.zeros((1, 2)), np.array([np.nan, 0])])
def test_an_action_of_another_shape_or_of_no_numbers_is_refused_for_any_world(action: Any) -> None:
    env = _toy()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="An action of the clbench/Toy-v0 world"):
        env.step(action)
    many = gymnasium.make_vec("clbench.testing:clbench/Toy-v0", num_envs=2)
    many.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        many.step(np.stack([np.zeros(2), np.full(2, np.nan)]))


class Undrawn(ToyWorld):
    """A world that cannot be drawn, and takes no render mode."""

    def __init__(self) -> None:
        super().__init__()


def test_a_world_that_cannot_be_drawn_needs_no_render_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clbench.testing.ToyWorld", Undrawn)
    assert _toy().reset(seed=0)[1]["task"] == "left"


def test_the_space_of_instructions_holds_test_wordings_too() -> None:
    words = ("move 2 the far left side of this large and very empty square plain",)
    tasks = tuple(dataclasses.replace(task, test_instructions=words) for task in TOY.retained)
    env = ScenarioEnv(dataclasses.replace(TOY, retained=tasks))
    assert env.observation_space["instruction"].contains(words[0])  # type: ignore[index]


def test_a_pickled_environment_is_a_new_one_with_the_same_options() -> None:
    env = gymnasium.make("clbench.testing:clbench/Toy-v0", instruction="tokens", stage=1, order=1)
    env.reset(seed=5)
    copy = pickle.loads(pickle.dumps(env))
    assert copy.spec == env.spec
    assert copy.unwrapped.scenario == env.unwrapped.scenario  # type: ignore[attr-defined]
    with pytest.raises(gymnasium.error.ResetNeeded):
        copy.step(np.zeros(2, np.float32))
    for mine, theirs in zip(env.reset(seed=7), copy.reset(seed=7), strict=True):
        assert str(mine) == str(theirs)


DRAW = """
import pickle, sys
import gymnasium, clbench
from gymnasium.wrappers import RecordVideo

name, folder, side_by_side = sys.argv[1:]
def make():
    return gymnasium.make(name, render_mode="rgb_array")

if side_by_side == "yes":  # before this process draws: a fork of one that draws may hang
    envs = gymnasium.vector.AsyncVectorEnv([make] * 2, shared_memory=False)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    assert [picture.shape for picture in envs.render()] == [(480, 480, 3)] * 2
    envs.close()
env = RecordVideo(pickle.loads(pickle.dumps(make())), folder)
env.reset(seed=0)
first = env.render()
for _ in range(5):
    env.step(env.action_space.sample())
assert first.shape == env.render().shape == (480, 480, 3)
assert len({*first.ravel()}) > 10, "it is blank"
env.close()
"""


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["clbench/PointMaze-v1"])
def test_without_a_display_or_a_variable_environments_draw_and_are_recorded(
    scenario: str, tmp_path: Path
) -> None:
    _draw(scenario, tmp_path, "no")


BUILT_IN = [
    name
    for name in scenario_ids()
    if str(gymnasium.registry[name].kwargs["scenario"]).startswith("clbench.envs.")
]
"""Ids of the built-in scenarios; other tests register scenarios of their own."""


@pytest.mark.slow
@pytest.mark.parametrize("scenario", BUILT_IN)
def test_every_scenario_draws_and_is_recorded_alone_and_side_by_side(scenario: str, tmp_path: Path) -> None:
    _draw(scenario, tmp_path, "yes")


def _draw(scenario: str, folder: Path, side_by_side: str) -> None:
    """Draw and record a scenario in a new process that knows nothing of displays."""
    scenario_or_skip(scenario)
    hidden = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-c", DRAW, scenario, str(folder), side_by_side]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    assert [path.suffix for path in folder.iterdir()] == [".mp4"]
