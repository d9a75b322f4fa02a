"""Ctrl-C while a hook runs: the run ends, and no record blames the method."""

import dataclasses
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest
from tiny import TINY
from torch import Tensor

from clbench.learning.method import Method, Progress, Stage
from clbench.learning.prior import Uses
from clbench.policy.policy import Policy
from clbench.runs.length import run_length, training_length, watching_length
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.runs.stages import make_stages

TOY = "clbench.testing:clbench/Toy-v0"


@pytest.fixture(autouse=True)
def _ctrl_c_comes_here() -> Iterator[None]:
    """Let Ctrl-C raise: a shell lets what it starts in the background ignore it, and tests inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@dataclasses.dataclass
class _Interrupted(Method):
    def gradients(self, policy: Policy, loss: Tensor) -> None:
        raise KeyboardInterrupt


def test_ctrl_c_in_a_hook_ends_the_run_without_a_record(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    spec = RunSpec(TOY, stranger(_Interrupted), seed=0)
    with pytest.raises(KeyboardInterrupt):
        execute(spec, tmp_path)
    assert not spec.path(tmp_path).exists()


def test_ctrl_c_while_policies_are_made_again_is_no_fault_of_the_method(
    stranger: Callable[[type[Method]], str],
) -> None:
    with pytest.raises(KeyboardInterrupt):
        make_stages(RunSpec(TOY, stranger(_Interrupted), seed=0).resolve())


@dataclasses.dataclass
class _InterruptedOnce(Method):
    """Ends its first run in the second stage, as a lost machine does."""

    lost: ClassVar[list[bool]] = []

    def start_task(self, policy: Policy, stage: Stage) -> Any:
        if stage.number == 2 and not self.lost:
            self.lost.append(True)
            raise KeyboardInterrupt
        return policy.parameters()


@pytest.mark.long
@pytest.mark.parametrize(("instructions", "resumed"), [(None, True), ("NEON", False)])
def test_a_run_goes_on_only_where_the_processor_computes_like_the_first_one(
    tmp_path: Path,
    stranger: Callable[[type[Method]], str],
    monkeypatch: pytest.MonkeyPatch,
    instructions: str | None,
    resumed: bool,
) -> None:
    monkeypatch.setattr(_InterruptedOnce, "lost", [])
    spec = RunSpec(TINY.id, stranger(_InterruptedOnce), seed=0)
    with pytest.raises(KeyboardInterrupt):
        execute(spec, tmp_path)
    if instructions is not None:
        monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: instructions)
    record = execute(spec, tmp_path)
    assert record.status == "success"
    assert ("resumed_after" in record.timing) == resumed


@dataclasses.dataclass
class _Watches(_InterruptedOnce):
    """Looks on during the pretraining, too."""

    uses = Uses(demonstrations="prepare")

    def watch_pretraining(self, policy: Policy, progress: Progress) -> None:
        """Watch."""


def test_the_bar_of_a_run_counts_the_watched_pretraining_once_wherever_it_goes_on(
    tmp_path: Path, stranger: Callable[[type[Method]], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_InterruptedOnce, "lost", [])
    spec = RunSpec(TINY.id, stranger(_Watches), seed=0)
    run, amounts = spec.resolve(), list[float]()
    with pytest.raises(KeyboardInterrupt):
        execute(spec, tmp_path)
    assert execute(spec, tmp_path, amounts.append).timing["resumed_after"] == 1
    watched = watching_length(run.method, run.scenario)
    assert watched == TINY.budget.pretraining_steps
    assert sum(amounts) == pytest.approx(run_length(run.scenario, run.protocol) + watched, rel=0.05)
    make_stages(run)
    amounts.clear()
    make_stages(run, amounts.append)  # all stages are in the cache
    assert sum(amounts) == training_length(run.scenario) + watched


SOURCE = """
import dataclasses
import clbench

@dataclasses.dataclass
class Mine(clbench.Method):
    def loss(self, policy, batch, progress):
        return {factor} * policy.action_loss(batch).mean()
"""


@pytest.mark.parametrize("changed", ["method", "clbench"])
def test_a_run_does_not_go_on_from_a_stage_of_other_code(
    changed: str,
    tmp_path: Path,
    write_module: Callable[[str, str], None],
    execute_and_kill: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_module("typed_mine", SOURCE.format(factor=1))
    spec = RunSpec(TINY.id, "typed_mine:Mine", 0)
    execute_and_kill(spec, tmp_path, 0.75)
    if changed == "method":
        write_module("typed_mine", SOURCE.format(factor=2.5))
        monkeypatch.delitem(sys.modules, "typed_mine")
    else:
        monkeypatch.setattr("clbench.learning.trainer.source_hash", lambda *_: "newer")
    assert "resumed_after" not in execute(spec, tmp_path).timing
