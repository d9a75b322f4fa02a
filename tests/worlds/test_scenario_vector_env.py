"""The vector environments of scenarios, against Gymnasium's own vector of plain environments."""

import pickle
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

from clbench.base.errors import InputError, UnknownNameError
from clbench.testing import ToyWorld
from clbench.worlds.lanes import PlainVectorWorld
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv

FETCH = "clbench/Fetch-v1"
TOY = "clbench.testing:clbench/Toy-v0"


def _same(first: Any, second: Any) -> None:
    """Assert that two results are the same in type, shape and every bit."""
    assert type(first) is type(second)
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for name, value in first.items():
            _same(value, second[name])
    elif isinstance(first, tuple):
        for value, other in zip(first, second, strict=True):
            _same(value, other)
    elif isinstance(first, np.ndarray) and first.dtype == object:
        _same(tuple(first), tuple(second))
    elif isinstance(first, np.ndarray):
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)
    else:
        assert first == second


def _run_together(scenario: str, steps: int, towards: float, mode: str = "NextStep", **options: Any) -> int:
    """Step ours and Gymnasium's in turn, and return how many episodes ended."""
    ours: VectorEnv[Any, Any, Any] = gymnasium.make_vec(
        scenario, num_envs=3, threads=2, autoreset_mode=mode, **options
    )
    plain = gymnasium.make_vec(
        scenario, num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options
    )
    assert isinstance(ours, ScenarioVectorEnv)
    assert ours.metadata["autoreset_mode"] is plain.metadata["autoreset_mode"]
    assert ours.observation_space == plain.observation_space
    assert ours.action_space == plain.action_space
    generator, ended = np.random.default_rng(0), 0
    _same(ours.reset(seed=7), plain.reset(seed=7))
    for _ in range(steps):
        actions = generator.uniform(-1.0, 1.0, ours.action_space.shape).astype(np.float32)
        actions[:, 0] -= towards
        outcome = ours.step(actions)
        _same(outcome, plain.step(actions))
        assert outcome[0] in ours.observation_space
        mask = outcome[2] | outcome[3]
        ended += int(mask.sum())
        if mode == "Disabled" and mask.any():
            masks = [{"reset_mask": mask.copy()} for _ in range(2)]
            _same(ours.reset(options=masks[0]), plain.reset(options=masks[1]))
    _same(ours.reset(), plain.reset())
    ours.close()
    plain.close()
    return ended


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("instruction", ["text", "tokens"])
def test_it_equals_gymnasiums_own_over_the_whole_schedule(instruction: str, mode: str) -> None:
    assert _run_together(TOY, 120, 0.5, mode, instruction=instruction, episodes_per_stage=2) > 20


def test_it_does_so_where_success_is_judged_at_the_horizon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ToyWorld, "success_at_horizon", True, raising=False)
    assert _run_together(TOY, 60, 0.5, "SameStep") > 10


@pytest.mark.long
def test_it_does_so_with_the_suites_own_vector_world() -> None:
    assert _run_together(FETCH, 130, 0.0, instruction="tokens", episodes_per_stage=2) >= 6


def test_each_environment_may_have_a_task_of_its_own() -> None:
    tasks = ["right", "left", "down"]
    ours = gymnasium.make_vec(TOY, num_envs=3, task=tasks)
    plain = gymnasium.vector.SyncVectorEnv([partial(gymnasium.make, TOY, task=task) for task in tasks])
    _same(ours.reset(seed=7), plain.reset(seed=7))
    for _ in range(30):
        actions = ours.action_space.sample()
        outcome = ours.step(actions)
        _same(outcome, plain.step(actions))
        assert list(outcome[-1]["task"]) == tasks
    ours.close()
    plain.close()


def test_as_many_tasks_as_environments_are_needed() -> None:
    with pytest.raises(InputError, match="2 environments need as many tasks, or one for all, not 1"):
        _toy(task=["left"])
    with pytest.raises(UnknownNameError, match=r"'lift'.*Did you mean 'left'"):
        _toy(task=["left", "lift"])


def _toy(**options: Any) -> ScenarioVectorEnv:
    return ScenarioVectorEnv("clbench.testing:TOY", num_envs=2, **options)


@pytest.mark.parametrize(("cores", "threads", "expected"), [(128, None, 2), (1, None, 1), (128, 3, 2)])
def test_no_more_threads_step_than_there_are_environments(
    cores: int, threads: int | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made_with: list[int] = []

    class Recorded(PlainVectorWorld):
        def __init__(self, lanes: int, threads: int) -> None:
            super().__init__(ToyWorld, lanes)
            made_with.append(threads)

    monkeypatch.setattr(ToyWorld, "vector_world", Recorded, raising=False)
    monkeypatch.setattr("clbench.worlds.scenario_vector_env.cores", lambda: cores)
    _toy(threads=threads).reset(seed=0)
    assert made_with == [expected]


def test_options_choose_for_all_and_seeds_for_each() -> None:
    env = _toy()
    first, info = env.reset(seed=[4, 5], options={"task": "up_left"})
    assert list(info["task"]) == ["up_left", "up_left"]
    second, _ = env.reset(seed=4, options={"task": "up_left"})
    _same(first, second)
    env.reset(seed=[4, None])
    third, info = env.reset(options={"stage": 2})
    assert list(info["stage"]) == [2, 2]
    assert not np.array_equal(third["state"], first["state"])


def test_steps_of_all_environments_add_up_without_those_that_only_begin_an_episode() -> None:
    env, expected, ended = _toy(), 0, np.zeros(2, np.bool_)
    env.reset(seed=0, options={"task": "left"})
    begun = env.begun_at
    assert begun is not None
    # to the left the first environment succeeds where its task is left; the second one never does
    actions = np.array([[-1.0, 0.0], [1.0, 0.0]], np.float32)
    for _ in range(30):
        expected += int((~ended).sum())
        _, _, terminated, truncated, _ = env.step(actions)
        ended = terminated | truncated
    assert 30 < expected < 60
    assert env.steps_taken == expected
    env.reset()
    assert (env.steps_taken, env.begun_at) == (expected, begun)


@pytest.mark.parametrize("seed", [None, 5, [7, None], [None, 8]])
def test_generators_and_their_seeds_are_those_of_gymnasiums_own(seed: Any) -> None:
    found = []
    envs: list[Any] = [_toy(), gymnasium.make_vec(TOY, num_envs=2, vectorization_mode="sync")]
    for env in envs:
        env.reset(seed=[3, 4])
        env.reset(seed=seed)
        states = [generator.bit_generator.state for generator in env.np_random]
        found.append((type(env.np_random), env.np_random_seed, states))
    assert found[0] == found[1]


def test_a_seed_with_a_mask_restarts_the_chosen_environments_alone() -> None:
    mask = np.array([False, True])
    outcomes: list[Any] = []
    for env in (_toy(), gymnasium.make_vec(TOY, num_envs=2, vectorization_mode="sync")):
        env.reset(seed=0)
        env.step(np.zeros((2, 2), np.float32))
        again = env.reset(seed=9, options={"reset_mask": mask.copy(), "task": "up"})
        outcomes.append((again, env.np_random_seed, env.step(np.zeros((2, 2), np.float32))))
    _same(*outcomes)
    assert outcomes[0][1] == (0, 10)


@pytest.mark.parametrize(
    "mask", [[True, False], np.array([1, 0]), np.array([True]), np.array([False, False]), True]
)
def test_a_mask_that_chooses_no_environments_is_refused(mask: Any) -> None:
    env = _toy(autoreset_mode="Disabled")
    with pytest.raises(gymnasium.error.ResetNeeded, match="first reset all"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r'The option "reset_mask" must be an array \(2,\) of bool'):
        env.reset(options={"reset_mask": mask})


def test_without_autoreset_a_step_after_the_end_is_refused_with_what_to_do() -> None:
    env = _toy(autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0, options={"task": "left"})
    actions = np.array([[-1.0, 0.0], [1.0, 0.0]], np.float32)
    while not env.step(actions)[2].any():
        pass
    with pytest.raises(gymnasium.error.ResetNeeded, match=r'in the environments \[0\]: .*"reset_mask"'):
        env.step(actions)
    with pytest.raises(
        ValueError, match='must be an AutoresetMode or one of "NextStep", "SameStep", "Disabled"'
    ):
        _toy(autoreset_mode="same")


def test_after_a_reset_no_episode_that_had_ended_begins_once_more() -> None:
    envs = [_toy(), gymnasium.make_vec(TOY, num_envs=2, vectorization_mode="sync")]
    actions = np.array([[-1.0, 0.0], [1.0, 0.0]], np.float32)
    outcomes: list[Any] = []
    for env in envs:
        env.reset(seed=0, options={"task": "left"})
        while not env.step(actions)[2].any():
            pass
        outcomes.append([env.reset(), env.step(actions), env.step(actions)])
    for ours, plain in zip(*outcomes, strict=True):
        _same(ours, plain)


@pytest.mark.parametrize("seed", [np.int64(4), [np.int32(4), 5], np.array([4, 5])])
def test_a_seed_may_be_any_whole_number(seed: Any) -> None:
    env = _toy()
    _same(env.reset(seed=seed), env.reset(seed=4))


@pytest.mark.parametrize("seed", [1.5, True, "ab", [1, 1.5], [1, True], np.array(1.5)])
def test_a_seed_that_is_no_whole_number_is_refused(seed: Any) -> None:
    with pytest.raises(TypeError, match="seed must be a whole number, or one per environment, not "):
        _toy().reset(seed=seed)


def test_a_copy_by_pickle_is_a_new_vector_with_the_same_arguments() -> None:
    same_step = AutoresetMode.SAME_STEP
    env: Any = gymnasium.make_vec(TOY, 2, instruction="tokens", stage=1, autoreset_mode=same_step)
    first = env.reset(seed=3)
    copy = pickle.loads(pickle.dumps(env))
    assert (copy.spec, copy.num_envs, copy.stage) == (env.spec, 2, 1)
    assert copy.metadata["autoreset_mode"] is same_step
    with pytest.raises(gymnasium.error.ResetNeeded):
        copy.step(copy.action_space.sample())
    _same(copy.reset(seed=3), first)


def test_drawing_many_environments_is_refused_with_what_draws() -> None:
    with pytest.raises(ValueError, match=r"vectorization_mode=.sync"):
        gymnasium.make_vec(TOY, num_envs=2, render_mode="rgb_array")


def test_wrong_calls_are_refused_by_name() -> None:
    env = _toy()
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.step(env.action_space.sample())
    with pytest.raises(ValueError, match="2 environments need as many seeds, not 3"):
        env.reset(seed=[1, 2, 3])
    env.reset(seed=0)
    for actions in (env.single_action_space.sample(), env.action_space.sample()[:1]):
        message = r"The actions must have shape \(2, 2\), not .*: one row per environment"
        with pytest.raises(ValueError, match=message):
            env.step(actions)
    with pytest.raises(LookupError, match="Did you mean 'left'"):
        env.reset(options={"task": "lefft"})
    with pytest.raises(ValueError, match="episodes_per_stage"):
        _toy(episodes_per_stage=0)


def test_returned_arrays_do_not_change_later() -> None:
    env = _toy(instruction="tokens")
    observation, _ = env.reset(seed=0)
    state, tokens = observation["state"].copy(), observation["instruction"].copy()
    ended = env.step(env.action_space.sample())[2]
    before = ended.copy()
    for _ in range(20):
        env.step(env.action_space.sample())
    np.testing.assert_array_equal(observation["state"], state)
    np.testing.assert_array_equal(observation["instruction"], tokens)
    np.testing.assert_array_equal(ended, before)


def test_it_closes_with_the_options_of_gymnasiums_own() -> None:
    env = ScenarioVectorEnv("clbench.testing:TOY", num_envs=2)
    env.reset(seed=0)
    env.close(timeout=1)
    with pytest.raises(ValueError, match="num_envs must be at least 1, not 0"):
        ScenarioVectorEnv("clbench.testing:TOY", num_envs=0)
