"""The Meta-World world, its tasks, experts and questions."""

import importlib.metadata
import re
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.cli.catalogue import list_
from clbench.cli.data import demonstrations
from clbench.cli.film import film
from clbench.cli.runs import run
from clbench.cli.tune import tune
from clbench.spec.registry import load_scenario
from clbench.spec.task import Task

SCENARIOS = {name: load_scenario(f"clbench:clbench/{name}") for name in ("MetaWorld-v1", "MetaWorldCW-v0")}
SCENARIO = SCENARIOS["MetaWorld-v1"]
TASKS = list({task.name: task for one in SCENARIOS.values() for task in one.tasks}.values())
World = resolve(TASKS[0].world)
QUESTIONS = {kind.name: kind for kind in resolve(SCENARIO.questions)}

State = NDArray[np.float32]


def scene(
    hand: tuple[float, float, float] = (0.0, 0.6, 0.15),
    thing: tuple[float, float, float] = (0.0, 0.6, 0.15),
    goal: tuple[float, float, float] = (0.0, 0.6, 0.15),
    opening: float = 1.0,
    hand_moved: tuple[float, float, float] = (0.0, 0.0, 0.0),
    thing_moved: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> State:
    """Return a state (1, 39) made by hand."""
    state = np.zeros((1, 39), np.float32)
    state[0, 0:3], state[0, 3], state[0, 4:7], state[0, 36:39] = hand, opening, thing, goal
    state[0, 18:21], state[0, 22:25] = np.subtract(hand, hand_moved), np.subtract(thing, thing_moved)
    return state


@pytest.fixture
def _without_metaworld(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the package metaworld from this process."""
    installed = importlib.metadata.version

    def version(package: str) -> str:
        if package == "metaworld":
            raise importlib.metadata.PackageNotFoundError(package)
        return installed(package)

    monkeypatch.setattr(importlib.metadata, "version", version)


@pytest.mark.usefixtures("_without_metaworld")
@pytest.mark.parametrize("name", list(SCENARIOS))
def test_without_the_package_every_user_of_it_names_the_extra_to_install(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = f"clbench/{name} needs the package metaworld: pip install 'clbench[metaworld]'"
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(LookupError, match=re.escape(message)):
            make(f"clbench/{name}")
    commands: tuple[Callable[[], None], ...] = (
        lambda: run(f"clbench/{name}", "sft", records=tmp_path),
        lambda: tune(f"clbench/{name}", "consft", values={"kappa": "1"}, records=tmp_path),
        lambda: film(f"clbench/{name}", "sft"),
        lambda: demonstrations(f"clbench/{name}"),
    )
    for command in commands:
        with pytest.raises(SystemExit) as end:
            command()
        assert end.value.code == 2
        assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("_without_metaworld")
def test_without_the_package_the_scenarios_are_listed_all_the_same(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    list_()
    listed = capsys.readouterr().out
    assert all(f"clbench/{name}" in listed for name in SCENARIOS)


def test_the_ten_tasks_are_continual_worlds_in_their_order() -> None:
    # Wolczyk et al. 2021, arXiv 2105.10919, CW10
    names = (
        "hammer push_wall faucet_close push_back stick_pull handle_press_side push shelf_place window_close"
    )
    scenario = SCENARIOS["MetaWorldCW-v0"]
    assert [task.name for task in scenario.target] == [*names.split(), "peg_unplug_side"]
    assert not scenario.retained
    assert not {task.name for task in scenario.scenes} & {task.name for task in scenario.tasks}


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_nothing_moves_in_the_first_state_and_objects_have_new_places_each_time(task: Task) -> None:
    world, states = World(), []
    for seed in range(5):
        states.append(world.reset(seed=seed, options={"task": task.name})[0])
        np.testing.assert_array_equal(states[-1][:18], states[-1][18:36])
    assert np.ptp(np.array(states)[:, [*range(4, 18), 36, 37, 38]], axis=0).max() > 0.02


@pytest.mark.parametrize(
    ("kind", "expected", "state"),
    [
        ("object_side", "right", scene(thing=(0.05, 0.6, 0.15))),
        ("object_side", "left", scene(thing=(-0.05, 0.6, 0.15))),
        ("object_side", None, scene(thing=(0.01, 0.6, 0.15))),
        ("object_depth", "farther", scene(thing=(0.0, 0.7, 0.15))),
        ("object_depth", "nearer", scene(thing=(0.0, 0.5, 0.15))),
        ("object_depth", None, scene()),
        ("object_level", "above", scene(thing=(0.0, 0.6, 0.25))),
        ("object_level", "below", scene(thing=(0.0, 0.6, 0.02))),
        ("object_level", None, scene()),
        ("target_side", "right", scene(goal=(0.05, 0.6, 0.15))),
        ("target_side", "left", scene(goal=(-0.05, 0.6, 0.15))),
        ("target_side", None, scene()),
        ("target_depth", "farther", scene(goal=(0.0, 0.7, 0.15))),
        ("target_depth", "nearer", scene(goal=(0.0, 0.5, 0.15))),
        ("target_depth", None, scene()),
        ("target_level", "above", scene(goal=(0.0, 0.6, 0.25))),
        ("target_level", "below", scene(goal=(0.0, 0.6, 0.05))),
        ("target_level", None, scene()),
        ("target_side_of_object", "right", scene(goal=(0.05, 0.6, 0.15))),
        ("target_side_of_object", "left", scene(thing=(0.05, 0.6, 0.15))),
        ("target_side_of_object", None, scene()),
        ("nearest", "object", scene(goal=(0.1, 0.6, 0.15))),
        ("nearest", "target", scene(thing=(0.1, 0.6, 0.15))),
        ("nearest", None, scene()),
        ("near_object", "yes", scene(thing=(0.05, 0.6, 0.15))),
        ("near_object", "no", scene(thing=(0.2, 0.6, 0.15))),
        ("near_object", None, scene(thing=(0.09, 0.6, 0.15))),
        ("gripper_opening", "open", scene(opening=1.0)),
        ("gripper_opening", "closed", scene(opening=0.4)),
        ("gripper_opening", None, scene(opening=0.75)),
        ("gripper_moving", "yes", scene(hand_moved=(0.0, 0.006, 0.0))),
        ("gripper_moving", "no", scene()),
        ("gripper_moving", None, scene(hand_moved=(0.0, 0.003, 0.0))),
        ("gripper_vertical", "up", scene(hand_moved=(0.0, 0.0, 0.005))),
        ("gripper_vertical", "down", scene(hand_moved=(0.0, 0.0, -0.005))),
        ("gripper_vertical", None, scene(hand_moved=(0.005, 0.0, 0.001))),
        ("gripper_lateral", "right", scene(hand_moved=(0.005, 0.0, 0.0))),
        ("gripper_lateral", "left", scene(hand_moved=(-0.005, 0.0, 0.0))),
        ("gripper_lateral", None, scene(hand_moved=(0.001, 0.0, 0.005))),
        ("object_moving", "yes", scene(thing_moved=(0.0, 0.004, 0.0))),
        ("object_moving", "no", scene(hand_moved=(0.0, 0.004, 0.0))),
        ("object_moving", None, scene(thing_moved=(0.0, 0.001, 0.0))),
        ("gripper_height", "high", scene(hand=(0.0, 0.6, 0.2))),
        ("gripper_height", "low", scene(hand=(0.0, 0.6, 0.08))),
        ("gripper_height", None, scene()),
        ("object_height", "high", scene(thing=(0.0, 0.6, 0.2))),
        ("object_height", "low", scene(thing=(0.0, 0.6, 0.02))),
        ("object_height", None, scene(thing=(0.0, 0.6, 0.1))),
    ],
)
def test_answers_match_the_scene(kind: str, expected: str | None, state: State) -> None:
    question = QUESTIONS[kind]
    (index,) = question.answer(state)
    assert (None if index == -1 else question.answers[index]) == expected
