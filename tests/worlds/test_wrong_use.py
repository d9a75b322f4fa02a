"""Wrong uses of a scenario's environments, single and vector: refused by name, and without a trace."""

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from clbench.base.errors import InputError, UnknownNameError
from clbench.spec.scenario import Scenario
from clbench.testing import TOY, ToyWorld
from clbench.worlds.lanes import PlainVectorWorld
from clbench.worlds.scenario_env import ScenarioEnv
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv
from clbench.worlds.threads import Team

Make = Callable[..., Any]


def _single(scenario: Any = TOY, **options: Any) -> ScenarioEnv:
    return ScenarioEnv(scenario, **options)


def _vector(scenario: Any = TOY, **options: Any) -> ScenarioVectorEnv:
    return ScenarioVectorEnv(scenario, **{"num_envs": 2, **options})


BOTH = pytest.mark.parametrize("make", [_single, _vector])


def _with_targets_in(world: str) -> Scenario:
    targets = tuple(dataclasses.replace(task, world=f"{__name__}:{world}") for task in TOY.target)
    return dataclasses.replace(TOY, target=targets)


def _told(env: Any, **arguments: Any) -> str:
    """Return what a reset shows, as text."""
    return str(env.reset(**arguments))


@BOTH
def test_a_refused_reset_neither_seeds_nor_restarts_the_schedule(make: Make) -> None:
    env, twin = make(), make()
    assert _told(env, seed=5) == _told(twin, seed=5)
    for options in ({"task": "lefft"}, {"stage": 9}, {"goal": 1}):
        with pytest.raises((InputError, UnknownNameError)):
            env.reset(seed=9, options=options)
    assert _told(env) == _told(twin)


def test_a_refused_seed_changes_no_environment_of_a_vector() -> None:
    env, twin = _vector(), _vector()
    assert _told(env, seed=5) == _told(twin, seed=5)
    with pytest.raises(gymnasium.error.Error, match="Seed must be greater or equal to zero"):
        env.reset(seed=[9, -1])
    assert _told(env) == _told(twin)


class Fragile(ToyWorld):
    """Its episodes of the task "down" cannot begin."""

    def reset(self, **options: Any) -> Any:
        begun = super().reset(**options)
        if self._task == "down":
            raise RuntimeError("the simulator broke")
        return begun


@BOTH
@pytest.mark.parametrize("first", ["left", None])
def test_after_an_error_of_the_world_in_a_reset_there_is_no_episode(make: Make, first: str | None) -> None:
    env = make(_with_targets_in("Fragile"))
    if first is not None:
        env.reset(seed=0, options={"task": first})
    with pytest.raises(RuntimeError, match="the simulator broke"):
        env.reset(options={"task": "down"})
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\)"):
        env.step(np.zeros(env.action_space.shape, np.float32))
    env.reset(options={"task": "right"})
    env.step(np.zeros(env.action_space.shape, np.float32))


class Wide(ToyWorld):
    """Its states are longer than the toy's."""

    observation_space = spaces.Box(-np.inf, np.inf, (5,), np.float32)


class Long(ToyWorld):
    """Its actions are longer than the toy's."""

    action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)


class Discrete(ToyWorld):
    """Its actions are numbers of choices."""

    action_space = spaces.Discrete(3)  # type: ignore[assignment]


@BOTH
@pytest.mark.parametrize(
    ("world", "shapes"), [("Wide", r"\(5,\) and \(2,\)"), ("Long", r"\(4,\) and \(3,\)")]
)
def test_worlds_of_different_sizes_are_both_named(make: Make, world: str, shapes: str) -> None:
    env = make(_with_targets_in(world))
    env.reset(seed=0)
    with pytest.raises(InputError, match=rf"testing:ToyWorld has \(4,\) and .*:{world} has {shapes}"):
        env.reset(options={"stage": 1})


@BOTH
def test_a_world_whose_actions_are_no_box_is_named(make: Make) -> None:
    with pytest.raises(InputError, match=r"action space of .*:Discrete must be a Box, not Discrete\(3\)"):
        make(dataclasses.replace(_with_targets_in("Discrete"), retained=(), scenes=TOY.retained))


class Second(ToyWorld):
    """The toy world once more."""


def test_where_worlds_differ_a_refused_action_moves_no_lane() -> None:
    scenario = _with_targets_in("Second")
    env, twin = (_vector(scenario, task=["left", "right"]) for _ in range(2))
    assert _told(env, seed=0) == _told(twin, seed=0)
    actions = np.array([[0.5, 0.5], [np.nan, 0.0]], np.float32)
    with pytest.raises(InputError, match="must be finite"):
        env.step(actions)
    assert env.steps_taken == 0
    assert str(env.step(np.zeros((2, 2), np.float32))) == str(twin.step(np.zeros((2, 2), np.float32)))


@BOTH
def test_actions_that_are_no_numbers_are_refused(make: Make) -> None:
    env = make()
    env.reset(seed=0)
    words = np.full(env.action_space.shape, "left")
    with pytest.raises(InputError, match=r"world must be numbers, not \['left', 'left'\]"):
        env.step(words)


@BOTH
@pytest.mark.parametrize("order", [True, 1.0, "1", None])
def test_an_order_that_is_no_whole_number_is_refused(make: Make, order: Any) -> None:
    with pytest.raises(InputError, match=f"2 targets have orders 0 to 1, not {order!r}"):
        make(order=order)


@BOTH
@pytest.mark.parametrize("scenario", [None, TOY.tasks])
def test_what_is_neither_a_scenario_nor_an_entry_point_is_refused(make: Make, scenario: Any) -> None:
    with pytest.raises(TypeError, match="A Scenario or its entry point 'module:name' is needed, not "):
        make(scenario)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"threads": -1}, ValueError, "threads must be a whole number from 1, not -1"),
        ({"threads": 1.5}, ValueError, "threads must be a whole number from 1, not 1.5"),
        ({"num_envs": 2.0}, TypeError, "num_envs must be a whole number, not 2.0"),
        ({"num_envs": True}, TypeError, "num_envs must be a whole number, not True"),
        ({"task": 3}, ValueError, 'The option "task" must be a name, not 3'),
    ],
)
def test_wrong_arguments_of_a_vector_are_refused(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        _vector(**options)


def test_a_shorter_episode_is_refused_with_the_vector_that_has_it() -> None:
    name = "clbench.testing:clbench/Toy-v0"
    with pytest.raises(InputError, match=r'no max_episode_steps: .* vectorization_mode="sync"'):
        gymnasium.make_vec(name, 2, max_episode_steps=5)
    env = gymnasium.make_vec(name, 2, vectorization_mode="sync", max_episode_steps=5)
    env.reset(seed=0)
    ends = [env.step(np.zeros((2, 2), np.float32))[3].all() for _ in range(5)]
    assert ends == [False] * 4 + [True]
    env.close()


@BOTH
def test_after_closing_there_is_no_episode_until_the_next_reset(make: Make) -> None:
    env, twin = make(), make()
    assert _told(env, seed=5) == _told(twin, seed=5)
    env.close()
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"has no episodes?: call reset\(\)"):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert _told(env) == _told(twin)


class Threaded(PlainVectorWorld):
    """A vector world with threads."""

    def __init__(self, lanes: int, threads: int) -> None:
        super().__init__(ToyWorld, lanes)
        self._team = Team(threads)
        self._team.each(lambda _: None, range(threads))  # starts them

    def close(self) -> None:
        self._team.close()
        super().close()


def test_a_vector_that_is_used_again_after_closing_can_be_closed_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ToyWorld, "vector_world", Threaded, raising=False)
    before, env = threading.active_count(), _vector(threads=2)
    for _ in range(2):
        env.reset(seed=0)
        assert threading.active_count() == before + 1
        env.close()
        assert threading.active_count() == before
