"""The time of a step is measured in the run, for any method, and changes nothing in it."""

import dataclasses
import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from tiny import TINY

from clbench.learning.method import Method
from clbench.policy.transformer import TransformerPolicy
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec


@dataclasses.dataclass
class Slow(Method):
    """Plain fine-tuning that computes each loss five times."""

    def loss(self, policy: Any, batch: Any, progress: Any) -> torch.Tensor:
        for _ in range(5):
            loss = super().loss(policy, batch, progress)
        return loss


@dataclasses.dataclass
class OwnOptimiser(Method):
    """Plain fine-tuning by plain gradient descent, beside an AdamW that moves nothing."""

    def start_task(self, policy: Any, stage: Any) -> Any:
        parameters = list(policy.parameters())
        self._own = torch.optim.SGD(parameters, lr=1e-3)
        return parameters

    def learning_rate(self, scheduled: float, progress: Any) -> float:
        self._own.step()
        return 0.0


@dataclasses.dataclass
class OnlyOnce(Method):
    """A method that fails if a stage begins twice in a process."""

    begun: ClassVar[list[int]] = []

    def start_task(self, policy: Any, stage: Any) -> Any:
        if stage.number in self.begun:
            raise RuntimeError("twice")
        self.begun.append(stage.number)
        return super().start_task(policy, stage)


def _timing(method: str, folder: Path, **options: Any) -> Any:
    record = execute(RunSpec(TINY.id, method, 0, targets=1, **options), folder)
    assert record.status == "success"
    return record.timing


@pytest.fixture(autouse=True)
def _all_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure with all pairs of blocks, as users do; other tests have two."""
    monkeypatch.setattr("clbench.runs.step_time.ROUNDS", 5)


@pytest.fixture
def _a_second_for_each_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the clock of the measurement go on by a second with each loss, however busy the machine is."""
    losses, usual = [], TransformerPolicy.action_loss

    def action_loss(policy: TransformerPolicy, *arguments: Any, **named: Any) -> torch.Tensor:
        losses.append(1)
        return usual(policy, *arguments, **named)

    monkeypatch.setattr(TransformerPolicy, "action_loss", action_loss)
    clock = types.SimpleNamespace(perf_counter=lambda: float(len(losses)))
    monkeypatch.setattr("clbench.runs.step_time.time", clock)


@pytest.mark.long
@pytest.mark.usefixtures("_a_second_for_each_loss")
def test_a_slow_method_of_a_stranger_has_its_ratio_in_the_record(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    assert _timing(stranger(Slow), tmp_path)["step_ratio"] == 5


@pytest.mark.long
@pytest.mark.usefixtures("_a_second_for_each_loss")
def test_two_optimisers_share_the_time_of_a_step_of_the_loop(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    ours, plain = (
        execute(RunSpec(TINY.id, method, 0, targets=1), tmp_path)
        for method in (stranger(OwnOptimiser), "sft")
    )
    assert ours.costs.optimiser_steps == 2 * (plain.costs.optimiser_steps or 0)
    assert ours.timing["step_ratio"] == 0.5  # the time of all steps is then that of plain fine-tuning


@pytest.mark.long
def test_neither_the_warm_up_nor_one_disturbed_block_changes_the_ratio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses, begun, usual = list[int](), list[int](), TransformerPolicy.action_loss

    def action_loss(policy: TransformerPolicy, *arguments: Any, **named: Any) -> torch.Tensor:
        losses.append(1)
        return usual(policy, *arguments, **named)

    def clock() -> float:
        """A loss takes a second, but for the four timed ones of the method's first and third block."""
        begun.append(len(losses))
        taken = range(1, len(losses) - begun[0] + 1)
        return float(sum({0: 100, 20: 50}.get((loss - 1) // 5 * 5, 1) for loss in taken))

    monkeypatch.setattr(TransformerPolicy, "action_loss", action_loss)
    monkeypatch.setattr("clbench.runs.step_time.time", types.SimpleNamespace(perf_counter=clock))
    assert _timing("l2_sp", tmp_path)["step_ratio"] == 1


@pytest.mark.long
def test_the_ratio_is_the_median_of_all_pairs_of_blocks_but_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # of the method and of plain fine-tuning, in turn
    seconds = iter([10.0, 1.0, 8.0, 1.0, 1.0, 1.0, 4.0, 1.0, 2.0, 1.0])
    monkeypatch.setattr("clbench.runs.step_time._seconds", lambda *_: next(seconds))
    assert _timing("l2_sp", tmp_path)["step_ratio"] == (2 + 4) / 2


@pytest.mark.long
@pytest.mark.usefixtures("_a_second_for_each_loss")
def test_a_stage_without_a_step_more_than_a_block_is_too_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.runs.step_time.STEPS", TINY.budget.adaptation_steps)
    assert _timing("l2_sp", tmp_path)["step_ratio"] is None


@pytest.mark.long
@pytest.mark.usefixtures("_a_second_for_each_loss")
def test_a_method_that_trains_nothing_has_no_time_of_a_step_and_plain_fine_tuning_is_the_unit(
    tmp_path: Path,
) -> None:
    assert _timing("frozen", tmp_path)["step_ratio"] is None
    assert "step_ratio" not in _timing("sft", tmp_path)


def test_a_tuning_run_does_not_measure(tmp_path: Path) -> None:
    assert "step_ratio" not in _timing("frozen", tmp_path, split="validation")


def test_a_method_that_cannot_be_measured_keeps_its_record(
    tmp_path: Path,
    stranger: Callable[[type[Method]], str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert _timing(stranger(OnlyOnce), tmp_path)["step_ratio"] is None
    assert "The time of a step could not be measured: RuntimeError: twice" in caplog.text


@pytest.mark.long
def test_the_measurement_changes_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    for name in ("with", "without"):
        if name == "without":
            monkeypatch.setattr("clbench.runs.run.step_ratio", lambda trainer, folder: None)
        execute(RunSpec(TINY.id, "experience_replay", 0, targets=1), tmp_path / name)
    assert json.dumps(lasting_records(tmp_path / "with")) == json.dumps(lasting_records(tmp_path / "without"))
