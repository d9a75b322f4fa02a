"""Ctrl-C while a hook runs: the run ends, and no record blames the method."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
from torch import Tensor

from clbench.learning.method import Method
from clbench.policy.policy import Policy
from clbench.runs.checkpoints import make_stages
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

TOY = "clbench.testing:clbench/Toy-v0"


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
