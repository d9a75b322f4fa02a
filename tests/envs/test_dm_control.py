"""The dm_control world: bit for bit dm_control's own physics, with padded states and returns to reach."""

import importlib
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from helpers import back_end_or_skip
from numpy.typing import NDArray

pytest.importorskip("dm_control", reason="dm-control is not for this version of Python")

from clbench.base.entry_points import resolve
from clbench.data.demonstrations import demonstrate
from clbench.exchange.shown import steps_per_second
from clbench.runs.film import frames_per_second
from clbench.spec.language import word_id
from clbench.spec.registry import load_scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import vector_world
from clbench.worlds.perturbation import draw_perturbation
from clbench.worlds.world import World

SCENARIO = load_scenario("clbench:clbench/DMControl-v0")
experts, questions, rules, scene, state, symmetry = (
    importlib.import_module(f"clbench.envs.dm_control.{name}")
    for name in ("experts", "questions", "rules", "scene", "state", "expert_training.symmetry")
)
RULES, HORIZON = rules.RULES, rules.HORIZON
NAMES = [task.name for task in SCENARIO.tasks]
OURS = [name for name in NAMES if name.removeprefix(f"{RULES[name].body}_") == RULES[name].start]
"""dm_control's own tasks."""


def world() -> World:
    made: World = resolve(SCENARIO.tasks[0].world)()
    return made


def dm_control_environment(task: str, seed: int) -> Any:
    """Return dm_control's own environment of a task, with steps as long as ours."""
    from dm_control.rl import control

    rule = RULES[task]
    made = importlib.import_module(f"dm_control.suite.{rule.body}").SUITE[rule.start](random=seed)
    substeps = scene.BODY_OF[rule.body].substeps
    return control.Environment(made.physics, made.task, n_sub_steps=substeps)


def observed(observation: Any) -> NDArray[np.float64]:
    return np.concatenate([np.ravel(value) for value in observation.values()])


def play(
    task: Task, seed: int, actions: NDArray[np.float32]
) -> tuple[NDArray[np.float32], list[float], bool]:
    """Return the states, the rewards and the end of an episode of the plain world."""
    plain = world()
    states, rewards, success = [plain.reset(seed=seed, options={"task": task.name})[0]], [], False
    for action in actions:
        observation, reward, success, _, _ = plain.step(action)
        states.append(observation)
        rewards.append(float(reward))
    plain.close()
    return np.array(states), rewards, success


def test_the_scenario_is_built_of_three_bodies_and_has_tasks_enough() -> None:
    assert len(SCENARIO.retained) >= 5
    assert len(SCENARIO.target) >= 4
    assert {RULES[task.name].body for task in SCENARIO.retained} == set(state.BODIES)
    assert len(OURS) == 4


@pytest.mark.long
@pytest.mark.parametrize("task", OURS)
def test_states_and_rewards_are_dm_controls_bit_for_bit(task: str) -> None:
    generator = np.random.default_rng(1)
    for seed in range(2):
        original = dm_control_environment(task, seed)
        steps = [original.reset()]
        actions = generator.uniform(-1, 1, (HORIZON, state.ACTION_SIZE)).astype(np.float32)
        steps += [original.step(action[: original.action_spec().shape[0]]) for action in actions]
        states, rewards, _ = play(SCENARIO.task(task), seed, actions)
        for ours, theirs in zip(states, steps, strict=True):
            expected = state.padded(RULES[task].body, observed(theirs.observation))
            np.testing.assert_array_equal(ours, expected)
        assert rewards == [step.reward for step in steps[1:]]


@pytest.mark.long
def test_lanes_of_any_bodies_in_any_company_give_the_plain_worlds_bits() -> None:
    generator = np.random.default_rng(2)
    actions = generator.uniform(-1, 1, (len(NAMES), HORIZON, state.ACTION_SIZE)).astype(np.float32)
    alone = [play(SCENARIO.task(name), 5, actions[row]) for row, name in enumerate(NAMES)]
    for threads in (1, 3):
        together = vector_world(SCENARIO.tasks[0].world, len(NAMES), threads)
        lanes = list(range(len(NAMES)))
        together.reset(lanes, [0] * len(NAMES), NAMES[::-1])  # other bodies used the lanes before
        together.step(lanes, actions[:, 0])
        states = [together.reset(lanes, [5] * len(NAMES), NAMES)]
        rewards, successes = [], np.zeros(len(NAMES), np.bool_)
        for step in range(HORIZON):
            after, reward, successes = together.step(lanes, actions[:, step])
            states.append(after)
            rewards.append(reward)
        together.close()
        for row, (lone_states, lone_rewards, lone_success) in enumerate(alone):
            np.testing.assert_array_equal(np.array(states)[:, row], lone_states)
            assert np.array(rewards)[:, row].tolist() == lone_rewards
            assert bool(successes[row]) == lone_success


def test_a_body_that_does_not_fit_is_refused_and_never_cut() -> None:
    with pytest.raises(ValueError, match=r"walker is observed in 24 numbers; a state has places for 8\."):
        scene.start("walker", "stand")
    with pytest.raises(ValueError, match=r"point_mass is observed in 9 numbers; a state has places for 8\."):
        state.padded("point_mass", np.zeros(9))


@pytest.mark.long
def test_every_number_of_a_body_is_in_the_state_and_the_rest_is_masked() -> None:
    for task in SCENARIO.retained:
        body = RULES[task.name].body
        size = len(observed(dm_control_environment(task.name, 0).reset().observation))
        first = world().reset(seed=0, options={"task": task.name})[0]
        padding = state.OBSERVATION_SIZE - size
        assert first[8:16].tolist() == [1.0] * size + [0.0] * padding
        assert not first[size:8].any()
        assert first[16:].tolist() == [float(body == name) for name in state.BODIES]


def test_a_motor_that_a_body_lacks_is_ignored() -> None:
    actions = np.random.default_rng(3).uniform(-1, 1, (20, 2)).astype(np.float32)
    other = actions * np.array([1, -1], np.float32)
    task = SCENARIO.task("cartpole_balance")
    np.testing.assert_array_equal(play(task, 0, actions)[0], play(task, 0, other)[0])


def test_success_is_the_return_of_the_whole_episode_and_comes_at_its_last_step() -> None:
    task = SCENARIO.task("cartpole_balance")
    act = experts.expert(task.name)
    plain = world()
    observation, _ = plain.reset(seed=0, options={"task": task.name})
    total, ends = 0.0, []
    for _ in range(task.horizon):
        observation, reward, terminated, _, info = plain.step(act(observation))
        total += float(reward)
        ends.append(terminated)
        assert info["success"] == terminated
    assert total >= rules.SUCCESS_SHARE * experts.expert_return(task.name)
    assert ends == [False] * (task.horizon - 1) + [True]
    _, rewards, success = play(task, 0, np.zeros((task.horizon, 2), np.float32))
    assert success == (sum(rewards) >= rules.SUCCESS_SHARE * experts.expert_return(task.name))


def test_the_environment_calls_a_success_at_the_horizon_truncated() -> None:
    env = gymnasium.make("clbench/DMControl-v0", task="point_mass_easy")
    act, observation = experts.expert("point_mass_easy"), env.reset(seed=0)[0]
    ends = []
    for _ in range(SCENARIO.task("point_mass_easy").horizon):
        observation, _, terminated, truncated, info = env.step(act(observation["state"]))
        ends.append((terminated, truncated, info["success"]))
    assert ends == [(False, False, False)] * (len(ends) - 1) + [(False, True, True)]
    assert env.metadata["render_fps"] == 6.25


@pytest.mark.parametrize("task", SCENARIO.tasks, ids=NAMES)
def test_every_expert_did_its_task_in_nine_of_ten_episodes(task: Task) -> None:
    card = json.loads((experts.FOLDER / f"{task.name}.json").read_text(encoding="utf-8"))
    assert card["success"] >= 0.9
    assert card["episodes"] == 100


def test_experts_of_retained_tasks_do_no_target_task_by_chance() -> None:
    """Only the instruction distinguishes tasks of one body: the expert of another task fails."""
    plain = world()
    for target in SCENARIO.target:
        for task in SCENARIO.retained:
            if RULES[task.name].body == RULES[target.name].body:
                observation, _ = plain.reset(seed=3, options={"task": target.name})
                act, success = experts.expert(task.name), False
                for _ in range(HORIZON):
                    observation, _, success, _, _ = plain.step(act(observation))
                assert not success, f"the expert of {task.name} does {target.name}"


def test_the_weights_are_small_and_come_with_the_command_and_versions_that_made_them() -> None:
    files = sorted(experts.FOLDER.iterdir())
    assert {path.suffix for path in files} == {".json", ".safetensors"}
    assert sum(path.stat().st_size for path in files) < 10e6
    for task in NAMES:
        card = json.loads((experts.FOLDER / f"{task}.json").read_text(encoding="utf-8"))
        assert card["command"].startswith(f"clbench experts train {task} ")
        assert {"dm-control", "mujoco", "stable-baselines3", "torch"} <= set(card["versions"])
        assert card["symmetric_to"] == (symmetry.SYMMETRIES[task].of if task in symmetry.SYMMETRIES else None)


def copy_of_an_expert(folder: Path) -> tuple[Path, Path, dict[str, Any]]:
    for name in ("cartpole_left.safetensors", "cartpole_left.json"):
        (folder / name).write_bytes((experts.FOLDER / name).read_bytes())
    card = folder / "cartpole_left.json"
    return folder / "cartpole_left.safetensors", card, json.loads(card.read_text(encoding="utf-8"))


def test_wrong_files_of_an_expert_are_refused_by_name_with_the_way_out(tmp_path: Path) -> None:
    weights, card, said = copy_of_an_expert(tmp_path)
    whole = weights.read_bytes()
    assert experts.read_expert(tmp_path, "cartpole_left")[1] == said["return"]

    def refused(why: str) -> None:
        with pytest.raises(experts.ExpertError, match=why) as caught:
            experts.read_expert(tmp_path, "cartpole_left")
        assert str(weights) in str(caught.value)
        assert "clbench experts train cartpole_left" in str(caught.value)

    weights.write_bytes(whole[:-8])
    refused("another hash than its JSON states")
    weights.write_bytes(whole)
    card.write_text(json.dumps(said | {"sizes": [5, 32, 64, 1]}), encoding="utf-8")
    refused("float32 of .* are expected")
    card.write_text(json.dumps(said | {"task": "cartpole_right"}), encoding="utf-8")
    refused("belongs to the task 'cartpole_right'")
    card.write_text("{", encoding="utf-8")
    refused("cannot be read as JSON")
    card.unlink()
    refused("cannot be read")


def test_questions_are_answered_in_known_words_and_only_where_they_apply() -> None:
    assert len(questions.QUESTIONS) >= 8
    plain = world()
    rows = {}
    for task in SCENARIO.retained:
        rows[task.name] = demonstrate(plain, task, 0, noisy=True).state
    for kind in questions.QUESTIONS:
        assert all(word_id(word) > 0 for word in kind.answers)
        given = {name: set(kind.answer(states).tolist()) for name, states in rows.items()}
        assert set().union(*given.values()) <= {-1, *range(len(kind.answers))}
        bodies = {RULES[name].body for name, answers in given.items() if answers != {-1}}
        assert len(bodies) == (len(state.BODIES) if kind.name == "body" else 1), kind.name


def test_questions_describe_a_scene_correctly() -> None:
    cartpole = state.padded("cartpole", np.array([-0.5, 0.9, 0.3, 0.0, 0.0]))[None]
    said = {
        kind.name: kind.answers[answer]
        for kind in questions.QUESTIONS
        if (answer := int(kind.answer(cartpole)[0])) >= 0
    }
    assert said == {"body": "cart", "pole_up": "up", "pole_side": "right", "cart_side": "left"}


@pytest.mark.long
def test_the_world_is_drawn_with_the_target_of_its_task() -> None:
    back_end_or_skip()
    drawn: World = resolve(SCENARIO.tasks[0].world)(render_mode="rgb_array")
    pictures = []
    for task in ("point_mass_easy", "point_mass_right", "cartpole_balance", "ball_in_cup_catch"):
        drawn.reset(seed=0, options={"task": task})
        picture = drawn.render()
        assert isinstance(picture, np.ndarray)
        assert picture.shape == (480, 480, 3)
        pictures.append(picture)
    drawn.close()
    # the same state, except the mark
    differing = (pictures[0] != pictures[1]).any(axis=2)
    assert 0 < differing.mean() < 0.02


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="Lane 0"):
        world().step(np.zeros(2, np.float32))


THINGS = {"point_mass": "pointmass", "cartpole": "pole_1", "ball_in_cup": "ball"}


@pytest.mark.parametrize("name", ["point_mass_easy", "cartpole_swingup", "ball_in_cup_catch"])
def test_in_a_perturbed_episode_a_thing_is_heavier_and_the_body_in_motion(name: str) -> None:
    worlds = [vector_world(SCENARIO.tasks[0].world, 1, 1, perturbed) for perturbed in (False, True)]
    body = scene.BODY_OF[RULES[name].body]
    for seed in range(4):
        for made in worlds:
            made.reset([0], [seed], [name])
        drawables = [made.drawable(0) for made in worlds]  # type: ignore[attr-defined]
        (plain, before, _), (perturbed, after, _) = drawables
        drawn = draw_perturbation(seed)
        thing = THINGS[body.name]
        assert perturbed.body(thing).mass == drawn.mass * plain.body(thing).mass
        assert perturbed.body_mass.sum() - plain.body_mass.sum() == pytest.approx(
            (drawn.mass - 1) * plain.body(thing).mass[0]
        )
        np.testing.assert_array_equal(after.qpos, before.qpos)
        pushed = [speed * drawn.start[joint % 2] for joint, speed in enumerate(body.starts)]
        np.testing.assert_allclose(after.qvel - before.qvel, pushed, rtol=1e-12, atol=1e-12)
        assert np.any(pushed)


@pytest.mark.parametrize(("task", "rate"), [("point_mass_easy", 6.25), ("cartpole_balance", 25.0)])
def test_data_sets_and_films_have_the_rate_of_the_body(task: str, rate: float) -> None:
    assert 1 / dm_control_environment(task, 0).control_timestep() == pytest.approx(rate)
    assert steps_per_second(SCENARIO.task(task)) == rate
    assert frames_per_second(SCENARIO.task(task)) == int(rate)
