"""The definition of a scenario: it changes when a task changes, and only then."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import scenario_or_skip

from clbench.base.errors import InputError
from clbench.evaluation.definition import definition
from clbench.jobs.recorded import has_record
from clbench.records.fingerprints import other_parts
from clbench.records.pinned import pinned
from clbench.records.reader import read_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.spec.identifiers import scenario_ids
from clbench.spec.registry import registered_scenario
from clbench.spec.scenario import Scenario
from clbench.testing import TOY, ToyWorld

TOY_ID = "clbench.testing:clbench/Toy-v0"
FIRST = TOY.retained[0].name


def test_every_scenario_of_the_project_is_pinned_unless_it_depends_on_the_processor() -> None:
    worlds = {name: registered_scenario(name).tasks[0].world for name in scenario_ids()}
    ours = {name for name, world in worlds.items() if world.startswith("clbench.envs.")}
    on_libero = {name for name, world in worlds.items() if world.startswith("clbench.envs.libero.")}
    assert ours - on_libero == set(pinned())  # other processors move LIBERO's arm differently


CHECKED = ("clbench/FetchKnowledge-v1", "clbench/FetchPixels-v0", "clbench/MetaWorldCW-v0")
"""They take 28 s, and others stand for their suites in `make test-long`; `make check` defines all."""


@pytest.mark.long
@pytest.mark.parametrize(
    "scenario",
    [pytest.param(name, marks=pytest.mark.slow if name in CHECKED else []) for name in sorted(pinned())],
)
def test_a_scenario_is_what_its_pinned_definition_says(scenario: str) -> None:
    changed = other_parts(definition(scenario_or_skip(scenario)), pinned()[scenario])
    assert not changed, f"Give {scenario} a new version, see clbench.evaluation.definition: {changed} changed"


@pytest.fixture
def remade(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, str]]:
    """Return a function that defines a scenario with an empty cache."""

    def remade(scenario: Scenario = TOY) -> dict[str, str]:
        monkeypatch.setenv("CLBENCH_CACHE", str(tmp_path / str(len(list(tmp_path.iterdir())))))
        return definition(scenario)

    return remade


def test_it_has_parts_for_each_task_and_the_questions(remade: Callable[..., dict[str, str]]) -> None:
    names = [task.name for task in TOY.tasks]
    assert set(remade()) == {f"{part} {name}" for part in ("task", "rule") for name in names} | {"questions"}
    assert remade() == remade()


@pytest.mark.parametrize(
    "change",
    [
        {"instructions": ("another wording",)},
        {"test_instructions": ("a wording of the test",)},
        {"horizon": TOY.retained[0].horizon + 1},
        {"version": 1},
        {"action_noise": 0.5},
        {"expert": "clbench.testing:crooked_expert"},
    ],
)
def test_a_changed_task_changes_its_own_part(
    change: dict[str, Any], remade: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "clbench.testing.crooked_expert", lambda _: lambda state: np.ones(2, np.float32), raising=False
    )
    task = dataclasses.replace(TOY.retained[0], **change)
    other = remade(dataclasses.replace(TOY, retained=(task, *TOY.retained[1:])))
    changed = other_parts(other, remade())
    assert f"task {FIRST}" in changed
    assert set(changed) <= {f"task {FIRST}", "questions"}  # its episodes give states for the questions


class Easier(ToyWorld):
    """The toy with another condition of success."""

    def step(self, action: Any) -> Any:
        state, reward, _, truncated, info = super().step(action)
        return state, reward, reward > -0.4, truncated, info  # the toy: -0.3


class Generous(ToyWorld):
    """The toy with other rewards."""

    def step(self, action: Any) -> Any:
        state, reward, *rest = super().step(action)
        return state, reward + 0.01, *rest


class Elsewhere(ToyWorld):
    """The toy with other initial states."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return super().reset(seed=None if seed is None else seed + 1, options=options)


def test_a_task_that_names_another_expert_of_the_same_module_changes_though_it_was_defined_before(
    empty_caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = definition(TOY)
    monkeypatch.setattr(
        "clbench.testing.crooked_expert", lambda _: lambda state: np.ones(2, np.float32), raising=False
    )
    task = dataclasses.replace(TOY.retained[0], expert="clbench.testing:crooked_expert")
    other = definition(dataclasses.replace(TOY, retained=(task, *TOY.retained[1:])))
    assert f"task {FIRST}" in other_parts(other, before)


@pytest.mark.parametrize("world", [Easier, Generous, Elsewhere])
def test_another_success_reward_or_initial_state_changes_the_task(
    world: type[ToyWorld], remade: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.testing.Changed", world, raising=False)
    task = dataclasses.replace(TOY.retained[0], world="clbench.testing:Changed")
    other = remade(dataclasses.replace(TOY, retained=(task, *TOY.retained[1:])))
    assert f"task {FIRST}" in other_parts(other, remade())


CAMERA = """
class Camera:
    image_size, state_size = 64, 2
    azimuth = 180.0

    @staticmethod
    def proprioception(states):
        return states[:, :2]

    @staticmethod
    def pictured(states):
        return states[:, :1]

    def draw(self, states, views):
        raise AssertionError("a definition needs no renderer")
"""


def _seen_by(camera: str) -> Scenario:
    """Return the toy, seen by the camera of a module."""
    seen: dict[str, Any] = {
        name: tuple(dataclasses.replace(task, camera=f"{camera}:Camera") for task in getattr(TOY, name))
        for name in ("retained", "target", "held_out")
    }
    return dataclasses.replace(TOY, **seen)


@pytest.mark.parametrize(
    ("before", "after", "changed"),
    [
        ("class Camera:", "class Camera:  # a remark", []),
        ("class Camera:", "class Camera:\n    'A view from above.'\n", []),
        ("azimuth = 180.0", "azimuth = 175.0", ["camera"]),
        ("image_size, state_size = 64, 2", "image_size, state_size = 32, 2", ["camera"]),
        ("states[:, :2]", "states[:, 1:3]", ["camera"]),
    ],
)
def test_another_camera_changes_the_part_of_the_camera_alone(
    before: str,
    after: str,
    changed: list[str],
    remade: Callable[..., dict[str, str]],
    write_module: Callable[[str, str], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, source in (("one_camera", CAMERA), ("other_camera", CAMERA.replace(before, after))):
        write_module(name, source)
        monkeypatch.delitem(sys.modules, name, raising=False)  # of another case
    one, other = (remade(_seen_by(camera)) for camera in ("one_camera", "other_camera"))
    assert set(one) == {*remade(), "camera"}
    assert other_parts(other, one) == changed


def test_a_definition_of_another_form_differs_as_a_whole() -> None:
    known = {"task left": "a", "questions": "b"}
    assert other_parts(None, known) == []  # an older record
    assert other_parts({"task left": "a"}, known) == ["questions"]
    assert other_parts(known, {**known, "rule left": "c"}) == []  # older than rules
    assert other_parts({**known, "rule left": "b"}, {**known, "rule left": "c"}) == ["rule left"]
    strangers: list[Any] = [[], "x", {"task left": "a", "questions": "b", "\x1b[2J": "c"}]
    for strange in strangers:
        assert other_parts(strange, known) == ["the tasks themselves"]


@pytest.mark.long
def test_a_record_of_another_definition_is_refused_by_run_and_not_shown_on_the_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    execute(RunSpec(TOY_ID, "frozen", 0), tmp_path)
    run = RunSpec(TOY_ID, "frozen", 0).resolve()
    record = read_record(run.path(tmp_path))
    assert record.fingerprint["definition"] == definition(TOY)
    assert has_record(run, tmp_path)
    other = {**definition(TOY), "questions": "another"}
    monkeypatch.setattr("clbench.evaluation.definition.definition", lambda _: other)
    with pytest.raises(
        InputError, match=r"made with another definition of clbench/Toy-v0: questions differ\. Give"
    ):
        has_record(run, tmp_path)
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    with pytest.raises(InputError, match=r"Worlds may move differently on x86_64, .* than on arm64: choose"):
        has_record(run, tmp_path)
