"""What the examiner writes about a policy that has diverged, though its weights are finite."""

import dataclasses
from pathlib import Path

import pytest
import torch

from clbench.learning.method import Method, Stage
from clbench.policy.policy import Policy
from clbench.records.reader import read_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.scores import Scores


@dataclasses.dataclass
class Enlarging(Method):
    """Multiplies the weights after the last target."""

    factor: float = 1.0

    def end_task(self, policy: Policy, stage: Stage) -> None:
        if stage.number == 2:
            with torch.no_grad():
                for weight in policy.parameters():
                    weight.mul_(self.factor)


@pytest.mark.parametrize("factor", [1e5, 1e18])  # hidden states beyond what a reader takes, and infinite ones
def test_a_policy_whose_hidden_states_overflow_has_no_drift_and_a_record_that_can_be_read(
    factor: float, tmp_path: Path
) -> None:
    spec = RunSpec("tiny:me/Tiny-v0", f"{__name__}:Enlarging", 0, changes={"factor": factor})
    execute(spec, tmp_path)
    record = read_record(spec.path(tmp_path))
    assert record.status == "success"
    assert record.policy["activation_drift"][:-1].count(None) == 0
    assert record.policy["activation_drift"][-1] is None
    Scores.from_record(record)
