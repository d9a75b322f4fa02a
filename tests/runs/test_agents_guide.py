"""The guide to online agents: its code runs unchanged."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import blocks_of

import clbench
from clbench.records.reader import read_record

ID = "clbench.testing:clbench/Toy-v0"

DOCS = Path(__file__).parents[2] / "docs" / "guide"


# ---- the page ----------------------------------------------------------------------------------------------


SHOW_FLAT = """
class Shown:
    def predict(self, observation, deterministic):
        print(observation.shape)

Flat(Shown(), env).predict(env.reset()[0], deterministic=True)
"""


def _output(command: list[str], folder: Path) -> str:
    """Return the output of a program; several threads would only slow each other down here."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, env=environment, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _small_blocks() -> tuple[str, str]:
    """Return the code of the page, with the toy and few steps."""
    learning, flat = blocks_of(DOCS / "online.md", "python")
    small = learning.replace("clbench/Fetch-v1", ID).replace("range(5)", "range(3)").replace("5_000", "120")
    return small, flat


@pytest.mark.long
def test_the_agent_of_the_page_repeats_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")

    def evaluate(agent: Any, *_: Any, **__: Any) -> None:
        weights.append([parameter.detach().clone() for parameter in agent.policy.parameters()])

    monkeypatch.setattr(clbench, "evaluate_agent", evaluate)
    small, _ = _small_blocks()
    runs = []
    for _ in range(2):
        weights: list[list[torch.Tensor]] = []
        exec(small, {})
        runs.append(weights)
    assert [len(weights) for weights in runs] == [3, 3]
    for one, other in zip(*runs, strict=True):
        assert all(map(torch.equal, one, other))


@pytest.mark.slow
def test_the_code_of_the_page_makes_a_row(tmp_path: Path) -> None:
    small, flat = _small_blocks()
    command = [sys.executable, "-c", small + flat + SHOW_FLAT]
    output = _output(command, tmp_path)
    assert output == "(16,)\n"
    record = read_record(tmp_path / "leaderboard/records/Toy-v0/me--sac/seed-0.json")
    assert record.costs.environment_steps == 360
    assert (record.costs.parameters or 0) > 0
    assert record.fingerprint["method"]["class"] == "stable_baselines3.sac.sac:SAC"
    assert record.run.device == "cpu"
    (shown,) = blocks_of(DOCS / "online.md", "console")
    command = [sys.executable, "-m", *shown.split()]
    output = _output(command, tmp_path)
    assert "me/sac" in output


@pytest.mark.slow
def test_the_program_of_the_page_makes_a_record_for_each_seed_and_skips_existing_ones(tmp_path: Path) -> None:
    (line,) = blocks_of(DOCS / "online.md", "shell")
    python, script, scenario, *seeds = line.split()
    assert (python, script, scenario, seeds) == (
        "python",
        "docs/guide/online_sac.py",
        "clbench/PointMaze-v1",
        ["--seeds", "3"],
    )
    command = [sys.executable, str(DOCS.parents[1] / script), ID, "--seeds", "1", "--steps", "112"]
    for expected in ("sac seed 0, stage 2: left ", "sac seed 0 has a record already"):
        output = _output(command, tmp_path)
        assert expected in output
    record = read_record(tmp_path / "leaderboard/records/Toy-v0/sac/seed-0.json")
    assert record.costs.environment_steps == 336
    assert record.timing["seconds"] is not None
