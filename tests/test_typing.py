"""The public names have types: `mypy --strict` accepts a user's script, and knows what it gets."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import clbench

SCRIPT = '''
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, assert_type

import clbench
import gymnasium
import numpy
import pandas
import torch


@dataclass
class Mine(clbench.Method):
    """A method with every hook that has a type."""

    strength: float = 1.0
    uses = clbench.Uses(demonstrations="throughout")

    def start_task(self, policy: clbench.Policy, stage: clbench.Stage) -> Iterable[torch.nn.Parameter]:
        assert_type(stage.prior, clbench.Prior)
        self.memory = clbench.Batch.cat([stage.target.sample(4), stage.target.sample(4)])
        assert_type(self.memory[:2], clbench.Batch)
        return policy.head.parameters()

    def loss(self, policy: clbench.Policy, batch: clbench.Batch, progress: clbench.Progress) -> torch.Tensor:
        return policy.action_loss(batch).mean() * self.strength


scenario = clbench.load_scenario("clbench/Fetch-v1")
assert_type(scenario.target[0], clbench.Task)
assert_type(scenario.budget, clbench.Budget)
records = clbench.run(scenario.id, Mine, seeds=1, records="records")
assert_type(records, list[clbench.Record])
assert_type(records[0].matrix(), pandas.DataFrame)
assert_type(clbench.load_records("records"), pandas.DataFrame)
assert_type(clbench.read_record("records/Fetch-v1/sft/seed-0.json"), clbench.Record)
run = clbench.RunSpec(scenario.id, "sft", 0)
assert_type(clbench.execute(run, "records", checkpoints="policies"), clbench.Record)
table = clbench.compare(scenario.id, [Mine, "sft"], records="records")
print(table["gain"], clbench.load_board("records"))
clbench.plot.matrix(records).save("matrix.png")
assert_type(clbench.metrics.from_matrix([[0.5]])["adaptation"].value, float | None)


def agent(observation: dict[str, Any]) -> Any:
    return numpy.zeros(4)


env = gymnasium.make(scenario.id, stage=0)
assert_type(clbench.evaluate_agent(agent, env, method="me/zero"), clbench.Record)
'''

SETTINGS = """
[mypy]
strict = true
[mypy-clbench.*]
follow_imports = silent
"""
"""What a user has: packages that are installed are read for their types, and not checked themselves."""


@pytest.mark.slow
def test_mypy_strict_accepts_a_users_script(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT, encoding="utf-8")
    (tmp_path / "mypy.ini").write_text(SETTINGS, encoding="utf-8")
    home = Path(clbench.__file__).parents[1]
    path = {"MYPYPATH": str(home)} if (home / "pyproject.toml").exists() else {}  # mypy finds a wheel itself
    result = subprocess.run(
        [sys.executable, "-m", "mypy", "script.py"],
        cwd=tmp_path,
        env={**os.environ, **path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stdout == "Success: no issues found in 1 source file\n"
