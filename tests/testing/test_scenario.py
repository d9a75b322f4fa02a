"""`check_scenario`: it accepts sound scenarios, and names the first fault of others."""

import dataclasses
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from clbench.base.errors import InputError, UnknownNameError
from clbench.data.questions import QuestionKind
from clbench.spec.scenario import Scenario
from clbench.testing import TOY, TOY_QUESTIONS, ScenarioError, ToyWorld, check_scenario, toy_expert
from clbench.testing.seen_toy import SEEN_TOY
from clbench.testing.toy_camera import ToyCamera
from clbench.worlds.gl_backend import RenderingError
from clbench.worlds.lanes import PlainVectorWorld

HERE = f"{__name__}:"


class Rounded(ToyWorld):
    """Its states have another type than their space."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        state, info = super().reset(**options)
        return state.astype(np.float64), info


class Remembering(ToyWorld):
    """Its episodes depend on the number of earlier episodes."""

    episodes = 0

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        state, info = super().reset(**options)
        self.episodes += 1
        state[3] += self.episodes
        return state, info


class Broken(ToyWorld):
    """It cannot be built."""

    def __init__(self, **options: Any) -> None:
        raise FileNotFoundError("scene.xml")


class Stuck(ToyWorld):
    """It fails in its first step."""

    def step(self, action: Any) -> Any:
        raise KeyError("gripper")


class Alike(ToyWorld):
    """Its initial state does not depend on the seed."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed=0, options=options)


class Reusing(ToyWorld):
    """It has one array for all states of an episode."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self.shown, info = super().reset(**options)
        return self.shown, info

    def step(self, action: Any) -> Any:
        self.shown[:], *others = super().step(action)
        return self.shown, *others


class Mute(ToyWorld):
    """Its info does not report success."""

    def step(self, action: Any) -> Any:
        return *super().step(action)[:4], {}


class Giving(ToyWorld):
    """It succeeds with any action."""

    def step(self, action: Any) -> Any:
        state, reward, *_ = super().step(action)
        return state, reward, True, False, {"success": True}


class Lost(ToyWorld):
    """Its rewards are not numbers."""

    def step(self, action: Any) -> Any:
        state, _, *rest = super().step(action)
        return state, float("nan"), *rest


class Unpaid(ToyWorld):
    """It gives no rewards."""

    def step(self, action: Any) -> Any:
        state, _, *rest = super().step(action)
        return state, None, *rest


class Listing(ToyWorld):
    """Its states are lists."""

    def reset(self, **options: Any) -> Any:
        state, info = super().reset(**options)
        return state.tolist(), info


class Hasty(ToyWorld):
    """It says that it judges success only at the horizon, but succeeds before."""

    success_at_horizon = True


class Limited(ToyWorld):
    """It ends its episodes by itself, after three steps."""

    steps = 0

    def reset(self, **options: Any) -> Any:
        self.steps = 0
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        self.steps += 1
        state, reward, success, _, info = super().step(action)
        return state, reward, success, self.steps == 3, info


class Strong(ToyWorld):
    """Its actions go beyond 1."""

    action_space = spaces.Box(-2.0, 2.0, (2,), np.float32)


class Framed(ToyWorld):
    """Its observation is a dictionary."""

    observation_space = spaces.Dict({"state": ToyWorld.observation_space})  # type: ignore[assignment]


class Wide(ToyWorld):
    """Its states are longer than the toy's."""

    observation_space = spaces.Box(-np.inf, np.inf, (5,), np.float32)

    def reset(self, **options: Any) -> Any:
        state, info = super().reset(**options)
        return np.append(state, np.float32(0)), info

    def step(self, action: Any) -> Any:
        state, *rest = super().step(action)
        return np.append(state, np.float32(0)), *rest


class Askew(ToyWorld):
    """Its episodes differ side by side."""

    @staticmethod
    def vector_world(lanes: int, threads: int) -> PlainVectorWorld:
        return PlainVectorWorld(Remembering, lanes)


class Wavering(ToyWorld):
    """Its rewards depend on the number of earlier steps of all episodes."""

    steps = 0

    def step(self, action: Any) -> Any:
        self.steps += 1
        state, reward, *rest = super().step(action)
        return state, reward + self.steps, *rest


class Without(PlainVectorWorld):
    """In its lanes no episode succeeds."""

    def step(self, lanes: Any, actions: Any) -> Any:
        states, rewards, successes = super().step(lanes, actions)
        return states, rewards, np.zeros_like(successes)


class Barred(ToyWorld):
    """Its episodes never succeed side by side."""

    @staticmethod
    def vector_world(lanes: int, threads: int) -> PlainVectorWorld:
        return Without(ToyWorld, lanes)


class Paid(ToyWorld):
    """Its rewards differ side by side, where every state and success is the same."""

    @staticmethod
    def vector_world(lanes: int, threads: int) -> PlainVectorWorld:
        return PlainVectorWorld(Wavering, lanes)


def lazy(task: str) -> Callable[[Any], Any]:
    return lambda _: np.zeros(2, np.float32)


def long(task: str) -> Callable[[Any], Any]:
    return lambda _: np.zeros(3, np.float32)


def undefined(task: str) -> Callable[[Any], Any]:
    return lambda _: np.full(2, np.nan, np.float32)


def broken(task: str) -> Callable[[Any], Any]:
    return lambda _: 1 // 0


def careless(task: str) -> Callable[[Any], Any]:
    """It cannot go down."""
    return toy_expert("up" if task == "down" else task)


def fractions(states: Any) -> Any:
    """Answer with a fraction."""
    return np.zeros(len(states))


NO_QUESTIONS: tuple[QuestionKind, ...] = ()
NO_TUPLE = TOY_QUESTIONS[0]
TWICE = TOY_QUESTIONS[:1] * 2
ONE_ANSWER = (dataclasses.replace(TOY_QUESTIONS[0], answers=("left",)),)
LONG_ANSWER = (dataclasses.replace(TOY_QUESTIONS[0], answers=("left", "to the right")),)
STRANGE_WORD = (dataclasses.replace(TOY_QUESTIONS[0], wordings=("где is it",)),)
THIRD_ANSWER = (dataclasses.replace(TOY_QUESTIONS[0], answers=("left", "right", "up")),)
TOO_HIGH = (dataclasses.replace(TOY_QUESTIONS[0], answer=lambda states: np.full(len(states), 2)),)
BROKEN = (
    dataclasses.replace(TOY_QUESTIONS[0], answer=lambda states: np.full(len(states), [0, 1][len(states)])),
)
FLOATS = (dataclasses.replace(TOY_QUESTIONS[0], answer=fractions),)


def with_parts(**parts: str) -> Scenario:
    """Return the toy with the world or the expert of all tasks replaced."""
    groups: dict[str, Any] = {
        group: tuple(
            dataclasses.replace(task, **{name: HERE + part for name, part in parts.items()})
            for task in getattr(TOY, group)
        )
        for group in ("retained", "target", "held_out")
    }
    return dataclasses.replace(TOY, **groups)


def test_the_toy_passes() -> None:
    check_scenario(TOY)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ("Rounded", r"task left, step 0: the state is not in .*: it is float64 of shape \(4,\)"),
        ("Broken", r":Broken: FileNotFoundError: scene\.xml"),
        ("Stuck", "task left: KeyError: 'gripper'"),
        ("Remembering", "the same seed and actions give a different episode after other episodes"),
        ("Wavering", "the same seed and actions give a different episode after other episodes"),
        ("Alike", "all seeds have the same initial state"),
        ("Reusing", "step 0: the world changed its last state in place and returned it: return a copy"),
        ("Mute", r'terminated is True, info\["success"\] is None'),
        ("Giving", "doing nothing completes it"),
        ("Lost", "step 0: the reward is nan"),
        ("Unpaid", "step 0: the reward is None, but must be a finite number"),
        ("Listing", r"step 0: the state is not in .*: it is list of shape \(4,\)"),
        ("Hasty", r"Hasty declares success_at_horizon, but an episode succeeds after \d+ of 12 steps"),
        ("Limited", "step 2: the world truncates, but only the task's horizon may do so"),
        ("Strong", "actions must go from -1 to 1"),
        ("Framed", "observation space must be a Box of one axis"),
        ("Askew", "its episodes in parallel lanes differ from its episodes in a single"),
        ("Barred", "its episodes in parallel lanes differ from its episodes in a single"),
        ("Paid", "its episodes in parallel lanes differ from its episodes in a single"),
    ],
)
def test_a_faulty_world_is_named(world: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        check_scenario(with_parts(world=world), episodes=3)


@pytest.mark.parametrize(
    ("expert", "message"),
    [
        ("lazy", "expert .*:lazy succeeds in 0% of 3 episodes, not in 90%"),
        ("careless", "task down: its expert .* succeeds in 0%"),
        ("broken", "task left: ZeroDivisionError: integer division or modulo by zero"),
        ("long", "the action of .*:long must be in Box"),
        ("undefined", r"step 0: the action of .*:undefined must be .*, without NaN, not \[nan nan\]"),
    ],
)
def test_an_expert_that_cannot_do_its_task_is_named(expert: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        check_scenario(with_parts(expert=expert), episodes=3)


def test_the_expert_of_a_background_task_is_checked_too() -> None:
    task = dataclasses.replace(
        TOY.held_out[0], name="right", instructions=("go far right",), expert=f"{HERE}lazy"
    )
    task = dataclasses.replace(task, test_instructions=())
    scenario = dataclasses.replace(TOY, target=TOY.target[1:], background=(task,))
    with pytest.raises(ScenarioError, match=r"task right: its expert .*:lazy succeeds in 0%"):
        check_scenario(scenario, episodes=3)


@pytest.mark.parametrize(
    ("questions", "message"),
    [
        ("NO_QUESTIONS", "there must be questions"),
        ("NO_TUPLE", r":NO_TUPLE must be a tuple of QuestionKinds, not QuestionKind\(name='side'"),
        ("TWICE", "each kind with its own name"),
        ("ONE_ANSWER", "must have two answers or more"),
        ("LONG_ANSWER", "The word 'to the right' is not in the vocabulary"),
        ("STRANGE_WORD", "'где' in 'где is it' cannot be spelled with English letters"),
        ("THIRD_ANSWER", "'up' is never the answer"),
        ("TOO_HIGH", "answers must be from -1 to 1"),
        ("BROKEN", "question side: IndexError: list index out of range"),
        ("FLOATS", "must be whole numbers"),
    ],
)
def test_questions_that_cannot_be_asked_are_named(questions: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        check_scenario(dataclasses.replace(TOY, questions=HERE + questions), episodes=3)


def test_worlds_of_different_sizes_are_named() -> None:
    wide = dataclasses.replace(TOY.held_out[0], world=f"{HERE}Wide")
    with pytest.raises(
        ScenarioError, match=r"one size in all worlds, not .*ToyWorld \(4, 2\), .*Wide \(5, 2\)"
    ):
        check_scenario(dataclasses.replace(TOY, held_out=(wide,)), episodes=3)


class Small(ToyCamera):
    """Its pictures are smaller than it says."""

    def draw(self, states: Any, views: Any) -> Any:
        return super().draw(states, views)[:, :8, :8]


class Blurred(ToyCamera):
    """It shows a policy no numbers."""

    @staticmethod
    def proprioception(states: Any) -> Any:
        raise KeyError("gripper")


@pytest.mark.parametrize(
    ("camera", "error", "message"),
    [
        ("Small", RenderingError, r":Small has ended: .*draw\(\) must return \(1, 16, 16, 3\) of uint8, not"),
        ("Blurred", ScenarioError, "camera .*:Blurred: KeyError: 'gripper'"),
    ],
)
def test_a_camera_that_does_not_draw_is_named(camera: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        check_scenario(with_parts(camera=camera), episodes=3)


def test_a_scenario_with_a_camera_passes() -> None:
    check_scenario(SEEN_TOY, episodes=3)


def test_a_missing_entry_point_is_named() -> None:
    with pytest.raises(LookupError, match=r"has no 'Giveing'\. Did you mean 'Giving'"):
        check_scenario(with_parts(world="Giveing"))


def test_two_tasks_that_no_instruction_tells_apart_are_named() -> None:
    alike = dataclasses.replace(TOY.target[0], instructions=("go there", *TOY.retained[0].instructions[:1]))
    with pytest.raises(ScenarioError, match="left and right share the instruction 'go left'"):
        check_scenario(dataclasses.replace(TOY, target=(alike, *TOY.target[1:])))


def test_instructions_that_differ_in_case_and_punctuation_alone_are_the_same() -> None:
    alike = dataclasses.replace(TOY.target[0], instructions=("Go left!",))
    with pytest.raises(ScenarioError, match="left and right share the instruction 'Go left!'"):
        check_scenario(dataclasses.replace(TOY, target=(alike, *TOY.target[1:])))


def test_a_scenario_without_a_target_is_named() -> None:
    with pytest.raises(ScenarioError, match="no target to learn"):
        check_scenario(dataclasses.replace(TOY, target=()))


@pytest.mark.parametrize("episodes", [0, 2.5, None])
def test_a_check_needs_a_whole_number_of_episodes(episodes: Any) -> None:
    with pytest.raises(InputError, match=f"episodes must be a whole number from 1, not {episodes}"):
        check_scenario(TOY, episodes=episodes)


AIMLESS = dataclasses.replace(TOY, id="me/Aimless-v0", target=())


def test_a_scenario_may_be_named_by_its_id(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = EnvSpec(AIMLESS.id, kwargs={"scenario": f"{HERE}AIMLESS"})
    monkeypatch.setitem(gymnasium.registry, AIMLESS.id, spec)
    with pytest.raises(ScenarioError, match="me/Aimless-v0: there is no target to learn"):
        check_scenario(AIMLESS.id)
    with pytest.raises(UnknownNameError, match="Did you mean 'clbench/Fetch-v1'"):
        check_scenario("clbench/fetch-v1")
