"""The definition of a scenario: it changes with what a task is, and with nothing else."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.errors import InputError
from clbench.evaluation.definition import definition
from clbench.jobs.recorded import has_record
from clbench.records.pinned import other_parts, pinned
from clbench.records.reader import read_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.spec.identifiers import scenario_ids
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.testing import TOY, ToyWorld

TOY_ID = "clbench.testing:clbench/Toy-v0"
FIRST = TOY.retained[0].name


def test_every_scenario_of_the_project_is_pinned() -> None:
    ours = {name for name in scenario_ids() if load_scenario(name).tasks[0].world.startswith("clbench.envs.")}
    assert ours == set(pinned())


@pytest.mark.parametrize("scenario", sorted(pinned()))
def test_a_scenario_is_what_its_pinned_definition_says(scenario: str) -> None:
    loaded = load_scenario(scenario)
    try:
        loaded.require_packages()
    except LookupError as error:
        pytest.skip(str(error))
    changed = other_parts(definition(loaded), pinned()[scenario])
    assert not changed, f"Give {scenario} a new version, see clbench.evaluation.definition: {changed} changed"


@pytest.fixture
def remade(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, str]]:
    """Return a function that defines a scenario with an empty cache."""

    def remade(scenario: Scenario = TOY) -> dict[str, str]:
        monkeypatch.setenv("CLBENCH_CACHE", str(tmp_path / str(len(list(tmp_path.iterdir())))))
        return definition(scenario)

    return remade


def test_it_has_a_part_for_each_task_and_the_questions(remade: Callable[..., dict[str, str]]) -> None:
    assert set(remade()) == {*(f"task {task.name}" for task in TOY.tasks), "questions"}
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


def test_another_condition_of_success_changes_the_task(
    remade: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Easier(ToyWorld):
        def step(self, action: Any) -> Any:
            state, reward, _, truncated, info = super().step(action)
            return state, reward, reward > -0.4, truncated, info  # the toy: -0.3

    monkeypatch.setattr("clbench.testing.Easier", Easier, raising=False)
    task = dataclasses.replace(TOY.retained[0], world="clbench.testing:Easier")
    other = remade(dataclasses.replace(TOY, retained=(task, *TOY.retained[1:])))
    assert f"task {FIRST}" in other_parts(other, remade())


def test_a_definition_of_another_form_differs_as_a_whole() -> None:
    known = {"task left": "a", "questions": "b"}
    assert other_parts(None, known) == []  # an older record
    assert other_parts({"task left": "a"}, known) == ["questions"]
    strangers: list[Any] = [[], "x", {"task left": "a", "questions": "b", "\x1b[2J": "c"}]
    for strange in strangers:
        assert other_parts(strange, known) == ["the tasks themselves"]


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
    with pytest.raises(InputError, match=r"made with another clbench/Toy-v0: questions differ\. Give"):
        has_record(run, tmp_path)
