"""Ctrl-C while a hook runs: the run ends, and no record blames the method."""

import dataclasses
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from torch import Tensor

from clbench.learning.method import Method
from clbench.policy.policy import Policy
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
