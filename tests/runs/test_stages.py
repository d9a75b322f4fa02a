"""The policies of all stages: kept by a run or made again, they are equal to the last bit."""

import dataclasses
import logging
import random
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import tiny
import torch
from helpers import stage_policies
from tiny import TINY
from torch import Tensor

from clbench.base.errors import InputError
from clbench.cli.runs import run
from clbench.learning.method import Method, MethodState, Stage
from clbench.learning.optimise import MethodError
from clbench.policy.checkpoint import CheckpointError
from clbench.policy.policy import Policy
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.runs.stages import find_stages, has_stages, keep_stages, load_stages, make_stages

SPEC = RunSpec(TINY.id, "lora", seed=0)


@dataclasses.dataclass
class Restless(Method):
    """A method that adds a parameter to the policy, keeps a state, and draws from the global generators."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_parameter("scale", torch.nn.Parameter(torch.rand(3)))
        self.steps = 0

    def load_state(self, policy: Policy, state: MethodState) -> None:
        policy.register_parameter("scale", torch.nn.Parameter(torch.zeros(3)))
        assert isinstance(state["steps"], int)
        self.steps = state["steps"]

    def state(self) -> MethodState:
        return {"steps": self.steps}

    def loss(self, policy: Policy, batch: Any, progress: Any) -> Tensor:
        self.steps += 1
        noise = torch.rand(()) + random.random() + float(np.random.rand()) + self.steps  # noqa: NPY002
        return (
            policy.action_loss(batch).mean() * noise + (policy.get_parameter("scale") * torch.rand(3)).sum()
        )


TYPED = """
import dataclasses
import clbench

@dataclasses.dataclass
class Typed(clbench.Method):
    def loss(self, policy, batch, progress):
        return {factor} * policy.action_loss(batch).mean()
"""


@dataclasses.dataclass
class Stumbling(Method):
    """A method that fails in the first stage."""

    def end_task(self, policy: Policy, stage: Stage) -> None:
        raise RuntimeError(f"cannot merge {stage.task.name}")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a run of LoRA kept its policies."""
    folder = tmp_path_factory.mktemp("kept")
    assert execute(SPEC, folder / "records", checkpoints=folder / "policies").status == "success"
    return folder / "policies"


def _tensors(policies: list[Policy]) -> list[dict[str, Tensor]]:
    return [policy.state_dict() for policy in policies]


def _assert_equal(first: list[Policy], second: list[Policy]) -> None:
    assert len(first) == len(second)
    for one, other in zip(_tensors(first), _tensors(second), strict=True):
        assert one.keys() == other.keys()
        assert all(value.equal(other[name]) for name, value in one.items())


def test_a_run_keeps_a_folder_for_each_stage(kept: Path) -> None:
    files = {"policy.safetensors", "policy.json", "method.safetensors", "method.json", "clbench.json"}
    folders = sorted((kept / "me--Tiny-v0" / "lora" / "seed-0").iterdir())
    assert [folder.name for folder in folders] == ["stage-0", "stage-1", "stage-2"]
    assert all({path.name for path in folder.iterdir()} == files for folder in folders)


def test_policies_that_are_made_again_equal_the_kept_ones(kept: Path) -> None:
    amounts: list[float] = []
    again = stage_policies(SPEC.resolve(), progress=amounts.append)
    _assert_equal(stage_policies(SPEC.resolve(), kept), again)
    assert len(again) == 3
    assert sum(amounts) == 2 * TINY.budget.adaptation_steps
    words = "backbone.words.weight"  # under the adapters: it never changes
    changed = [name for name in again[0].state_dict() if "lora_" in name]
    first, _, last = _tensors(again)
    assert changed
    assert first[words].equal(last[words])
    assert not any(first[name].equal(last[name]) for name in changed)


def test_policies_of_the_same_run_with_another_evaluation_count(kept: Path) -> None:
    assert has_stages(dataclasses.replace(SPEC, split="validation").resolve(), kept)
    assert has_stages(dataclasses.replace(SPEC, perturb=True).resolve(), kept)
    assert not has_stages(dataclasses.replace(SPEC, seed=1).resolve(), kept)
    assert not has_stages(dataclasses.replace(SPEC, targets=1).resolve(), kept)
    assert not has_stages(dataclasses.replace(SPEC, changes={"rank": 4}).resolve(), kept)


@pytest.mark.long
def test_a_method_that_draws_from_global_generators_makes_the_same_policies_again(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    spec = RunSpec(TINY.id, stranger(Restless), seed=0, targets=1)
    execute(spec, tmp_path / "records", checkpoints=tmp_path)
    _assert_equal(stage_policies(spec.resolve(), tmp_path), stage_policies(spec.resolve()))


@pytest.mark.parametrize("option", ["checkpoints", "tensorboard"])
def test_a_link_that_leads_out_of_a_folder_is_refused_before_the_run(option: str, tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    SPEC.resolve().path(tmp_path / "kept").parents[1].symlink_to(tmp_path)
    folders: dict[str, Any] = {option: tmp_path / "kept"}
    with pytest.raises(InputError, match="leads out of"):
        execute(SPEC, tmp_path / "records", **folders)
    assert not (tmp_path / "records").exists()


@pytest.mark.long
def test_a_killed_run_keeps_all_stages_once_it_has_finished(
    tmp_path: Path, execute_and_kill: Callable[..., None]
) -> None:
    spec = RunSpec(TINY.id, "sft", seed=0)
    execute_and_kill(spec, tmp_path, 0.75, checkpoints=tmp_path)
    assert not has_stages(spec.resolve(), tmp_path)
    assert execute(spec, tmp_path, checkpoints=tmp_path).timing["resumed_after"] == 1
    _assert_equal(stage_policies(spec.resolve(), tmp_path), stage_policies(spec.resolve()))


@pytest.mark.long
def test_a_run_killed_without_keeping_its_policies_keeps_them_all_if_it_goes_on_with_a_folder(
    tmp_path: Path, execute_and_kill: Callable[..., None]
) -> None:
    spec = RunSpec(TINY.id, "sft", seed=0)
    execute_and_kill(spec, tmp_path, 0.75)
    execute(spec, tmp_path, checkpoints=tmp_path)
    assert has_stages(spec.resolve(), tmp_path)


@pytest.mark.long
def test_a_run_that_goes_on_keeps_no_policy_of_older_code(
    tmp_path: Path, execute_and_kill: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = RunSpec(TINY.id, "sft", seed=0)
    with monkeypatch.context() as older:
        older.setattr(Method, "loss", lambda _, policy, batch, __: 0.0 * policy.action_loss(batch).mean())
        execute(spec, tmp_path, checkpoints=tmp_path)
    spec.path(tmp_path).unlink()
    assert has_stages(spec.resolve(), tmp_path)
    execute_and_kill(spec, tmp_path, 0.75)
    execute(spec, tmp_path, checkpoints=tmp_path)
    _assert_equal(stage_policies(spec.resolve(), tmp_path), stage_policies(spec.resolve()))


def test_policies_kept_by_another_version_of_the_code_are_replaced(kept: Path, tmp_path: Path) -> None:
    stale = tmp_path / "me--Tiny-v0" / "lora" / "seed-0" / "stage-2"
    stale.mkdir(parents=True)
    (stale / "policy.safetensors").write_bytes(b"stale")
    keep_stages(SPEC.resolve(), tmp_path)
    _assert_equal(stage_policies(SPEC.resolve(), tmp_path), stage_policies(SPEC.resolve(), kept))


@pytest.mark.slow
def test_the_command_keeps_the_policies_of_a_run_that_has_a_record(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "path", sys.path.copy())  # the command adds to it
    monkeypatch.setenv("PYTHONPATH", str(Path(tiny.__file__).parent))  # its workers import the scenario
    records, scenario = kept.parent / "records", f"tiny:{TINY.id}"
    run(scenario, "lora", seeds=1, records=records, checkpoints=tmp_path, workers=1)
    assert "0 runs and the policies of 1 in" in capsys.readouterr().err
    _assert_equal(stage_policies(SPEC.resolve(), tmp_path), stage_policies(SPEC.resolve(), kept))
    run(scenario, "lora", seeds=1, records=records, checkpoints=tmp_path, workers=1)
    assert "policies" not in capsys.readouterr().err  # they are there now


def test_a_torn_policy_is_not_used_and_the_log_says_so(
    kept: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keep_stages(SPEC.resolve(), tmp_path)
    path = tmp_path / "me--Tiny-v0" / "lora" / "seed-0" / "stage-1" / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-4] + bytes(4))
    assert not has_stages(SPEC.resolve(), tmp_path)
    assert has_stages(SPEC.resolve(), tmp_path, last=0)
    with caplog.at_level(logging.WARNING, "clbench"):
        assert find_stages(SPEC.resolve(), tmp_path) == find_stages(SPEC.resolve())
    assert "does not hold the policies of all stages of lora, seed 0" in caplog.text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"scale": 1, "scale": 2}', "the name 'scale' is there twice"),
        (f'{{"scale": {"[" * 99}{"]" * 99}}}', "scale: nested more than 16 deep"),
        ('{"scale": NaN}', "NaN is not a JSON number"),
        ("[1]", "cannot be read as the state of a method"),
    ],
)
def test_an_untrusted_state_is_read_within_limits_and_refused_by_name(
    kept: Path, tmp_path: Path, text: str, reason: str
) -> None:
    folder = shutil.copytree(kept / "me--Tiny-v0" / "lora" / "seed-0", tmp_path / "stages")
    (folder / "stage-1" / "method.json").write_text(text)
    with pytest.raises(CheckpointError, match=reason) as refused:
        load_stages(SPEC.resolve(), folder)
    assert str(folder / "stage-1") in str(refused.value)


@dataclasses.dataclass
class Boundless(Method):
    """A method whose state no file can hold."""

    def state(self) -> MethodState:
        return {"best": float("inf")}


def test_a_state_that_cannot_be_read_again_is_refused_when_it_is_written(
    stranger: Callable[[type[Method]], str],
) -> None:
    message = r"failed in state\(\) after stage 0: .*'best': a number that is not finite"
    with pytest.raises(MethodError, match=message):
        stage_policies(RunSpec(TINY.id, stranger(Boundless), seed=0).resolve())


def test_the_error_of_a_failing_method_names_the_stage(stranger: Callable[[type[Method]], str]) -> None:
    with pytest.raises(
        MethodError, match=r"failed in end_task\(\) of stage 1 \(right\): RuntimeError: cannot merge right"
    ):
        stage_policies(RunSpec(TINY.id, stranger(Stumbling), seed=0).resolve())


def test_policies_of_a_class_typed_at_a_prompt_are_made_again_if_the_class_has_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))
    folders = []
    for factor in (1.0, 2.0):
        exec(TYPED.format(factor=factor), vars(sys.modules["__main__"]))
        folders.append(make_stages(RunSpec(TINY.id, "__main__:Typed", 0, targets=1).resolve()))
    assert len(set(folders)) == 2
