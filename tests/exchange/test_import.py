"""Recorded demonstrations: a task names them, training reads them, and every record says so."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
from helpers import same_demonstrations

import clbench
from clbench.base.errors import InputError
from clbench.data.demonstrations import dataset_folder, load_demonstrations, read_dataset
from clbench.evaluation.definition import definition
from clbench.exchange.hdf5 import read_hdf5
from clbench.exchange.recorded import expert_of, recording_hash
from clbench.learning.pretraining import policy_config, pretraining_inputs
from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.testing import TOY, ScenarioError, check_scenario
from clbench.testing import toy as toy_module

TASK = TOY.task("right")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file with the demonstrations of one task, whose actions are the expert's at half speed."""
    folder = clbench.export_demonstrations(TOY, tmp_path / "out", format="hdf5", tasks=["right"])
    with h5py.File(folder / "right_demo.hdf5", "r+") as file:
        for demo in file["data"].values():
            demo["actions"][...] = np.asarray(demo["actions"]) / 2
    return folder / "right_demo.hdf5"


def _recorded(path: Path, budget: Budget = TOY.budget) -> Scenario:
    """Return a toy whose first target learns from a file."""
    expert = expert_of(recording_hash(read_hdf5(path, TASK)))
    target = (dataclasses.replace(TASK, expert=expert), *TOY.target[1:])
    return dataclasses.replace(TOY, id="me/Taught-v0", target=target, budget=budget)


def test_training_learns_from_the_file(path: Path, empty_caches: Path) -> None:
    scenario = _recorded(path)
    task = scenario.target[0]
    name = clbench.import_demonstrations(scenario, "right", path)
    assert same_demonstrations(read_dataset(dataset_folder(task, scenario.budget)), read_hdf5(path, TASK))
    assert minari.load_dataset(name).total_episodes == 10
    assert list(minari.list_local_datasets()) == [name]
    data = load_demonstrations(task, scenario, policy_config(scenario))
    assert data.action.abs().max() == 0.5
    assert clbench.import_demonstrations(scenario, "right", path) == name


def test_an_imported_task_is_exported_as_it_was(path: Path, tmp_path: Path, empty_caches: Path) -> None:
    scenario = _recorded(path)
    clbench.import_demonstrations(scenario, "right", path)
    again = clbench.export_demonstrations(scenario, tmp_path / "again", format="hdf5", tasks=["right"])
    assert recording_hash(read_hdf5(again / "right_demo.hdf5", TASK)) in scenario.target[0].expert


def test_a_task_with_an_expert_is_refused_with_what_to_write(path: Path, empty_caches: Path) -> None:
    expert = expert_of(recording_hash(read_hdf5(path, TASK)))
    with pytest.raises(InputError, match=f'fits the task right of clbench/Toy-v0, but .* expert="{expert}"'):
        clbench.import_demonstrations(TOY, "right", path)
    assert not list((empty_caches / "minari").rglob("*.hdf5"))


def test_a_task_that_names_other_demonstrations_is_refused(path: Path) -> None:
    scenario = _recorded(path)
    other = dataclasses.replace(scenario.target[0], expert=expert_of("0123456789abcdef"))
    changed = dataclasses.replace(scenario, target=(other,))
    with pytest.raises(InputError, match=r"holds the recording \w{16}, but the task right of me/\S+ names"):
        clbench.import_demonstrations(changed, "right", path)


def test_the_budget_must_have_as_many_demonstrations(path: Path) -> None:
    budget = dataclasses.replace(TOY.budget, demonstrations=50)
    with pytest.raises(InputError, match="has 10 demonstrations, but the budget of me/Taught-v0 has 50"):
        clbench.import_demonstrations(_recorded(path, budget=budget), "right", path)


def test_no_expert_ever_takes_the_place_of_the_file(path: Path, empty_caches: Path) -> None:
    scenario = _recorded(path)
    for _ in range(2):
        with pytest.raises(InputError, match="The task right has no expert: it learns from the recording"):
            dataset_folder(scenario.target[0], scenario.budget)
    with pytest.raises(LookupError, match="has no 'demonstrations_x'"):
        dataset_folder(dataclasses.replace(TASK, expert=expert_of("x")), scenario.budget)


def test_other_demonstrations_are_another_dataset_another_policy_and_another_definition(path: Path) -> None:
    scenario = _recorded(path)
    other = dataclasses.replace(scenario.target[0], expert=expert_of("0123456789abcdef"))
    both = [
        dataclasses.replace(scenario, retained=(task,), target=()) for task in (scenario.target[0], other)
    ]
    first, second = (pretraining_inputs(dataclasses.replace(one, scenes=TOY.retained), 0) for one in both)
    assert first != second
    defined = [definition(dataclasses.replace(scenario, target=(task,))) for task in (TASK, other)]
    assert defined[1]["demonstrations right"] == "0123456789abcdef"
    assert defined[0]["task right"] != defined[1]["task right"]
    assert [name for name in defined[0] if name.startswith("demonstrations")] == []


@pytest.mark.long
def test_a_record_says_which_demonstrations_it_learned_from(
    path: Path, tmp_path: Path, write_module: Callable[[str, str], None]
) -> None:
    expert = expert_of(recording_hash(read_hdf5(path, TASK)))
    write_module(
        "recorded_toy",
        f"""
import dataclasses
import clbench
from clbench.testing import TOY

right, *others = TOY.target
SCENARIO = dataclasses.replace(
    TOY, id="me/Taught-v0", target=(dataclasses.replace(right, expert={expert!r}),)
)
clbench.register("me/Taught-v0", "recorded_toy:SCENARIO")
""",
    )
    name = "recorded_toy:me/Taught-v0"
    clbench.import_demonstrations(name, "right", path)
    record = clbench.execute(clbench.RunSpec(name, "sft", 0), tmp_path / "records")
    assert record.fingerprint["definition"]["demonstrations right"] in expert
    assert record.status == "success"


def test_the_check_of_a_scenario_plays_a_recorded_task_without_its_expert(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = _recorded(path)
    check_scenario(scenario, episodes=3)
    early = dataclasses.replace(scenario.target[0], world="clbench.testing.toy:Early")
    changed = dataclasses.replace(scenario, target=(early,))
    monkeypatch.setattr(toy_module, "Early", _Early, raising=False)
    with pytest.raises(ScenarioError, match="task right, step 1"):
        check_scenario(changed, episodes=3)


class _Early(toy_module.ToyWorld):
    """A toy whose info says success too early."""

    def step(self, action: toy_module.Action) -> tuple:  # type: ignore[type-arg]
        state, reward, done, truncated, info = super().step(action)
        return state, reward, done, truncated, {**info, "success": True}


def test_a_recording_is_named_by_its_bits_alone(path: Path) -> None:
    episodes = read_hdf5(path, TASK)
    name = recording_hash(episodes)
    assert re.fullmatch(r"[0-9a-f]{16}", name)
    assert recording_hash(read_hdf5(path, TASK)) == name
    nearly = dataclasses.replace(episodes[0], reward=np.nextafter(episodes[0].reward, 9))
    assert recording_hash([nearly, *episodes[1:]]) != name
    assert recording_hash(episodes[::-1]) != name
