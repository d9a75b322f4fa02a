"""The guide to policies from elsewhere: its server and its commands run as they are written."""

import contextlib
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from agents import ID
from helpers import blocks_of, scenario_or_skip
from served import SERVER

from clbench.base.errors import MissingPackageError
from clbench.runs.spec import describe_scenario
from clbench.serving.client import ServedPolicy
from clbench.spec.identifiers import scenario_ids
from clbench.spec.registry import load_scenario, registered_scenario

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "external.md"
SIZES, SERVED, LEROBOT, OPENPI, SCORED = blocks_of(PAGE, "python")
ROWS = re.findall(
    r"\| \[(.+)\]\(.+\) \| (\d+) \| (\d+) \| (.+) \| (\d+)(?: to (\d+))? \|", PAGE.read_text("utf-8")
)


@contextmanager
def served_by(program: str, folder: Path) -> Iterator[str]:
    """Run a program of the page on a free port, and yield the address that it prints."""
    shutil.copy(SERVER, folder / "server.py")
    (folder / "serve_policy.py").write_text(program.replace("port=8000", "port=0"), encoding="utf-8")
    command = [sys.executable, "serve_policy.py", "stage-0"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().split()[-1]
        finally:
            server.kill()


@pytest.mark.slow
def test_the_policy_of_the_page_is_served_and_scored_by_its_commands(
    tmp_path: Path, empty_caches: Path
) -> None:
    with served_by(SERVED.replace("8, 4)", "8, 2)"), tmp_path) as address:
        for stage, shown in enumerate(blocks_of(PAGE, "console")):
            command = shown.replace("clbench/Fetch-v1", ID).replace("ws://localhost:8000", address)
            done = subprocess.run(
                f"{sys.executable} -m {command}",
                shell=True,
                cwd=tmp_path,
                env=dict(os.environ),
                check=False,
                capture_output=True,
                text=True,
            )
            assert f"stage {stage}: left 0.00" in done.stderr, done.stderr
            assert "(server: checkpoint stage-0)" in done.stderr
    assert "does it serve the new checkpoint?" in done.stderr
    (kept,) = (path for path in (tmp_path / "leaderboard" / "records").rglob("*") if path.is_file())
    assert kept.name == "seed-0.json.unfinished"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="the script of the page is for bash")
def test_the_script_of_the_page_scores_all_stages_one_after_another(
    tmp_path: Path, empty_caches: Path
) -> None:
    shutil.copy(SERVER, tmp_path / "server.py")
    with socket.create_server(("localhost", 0)) as free:
        port = str(free.getsockname()[1])
    program = SERVED.replace("8, 4)", "8, 2)").replace("port=8000", f"port={port}")
    (tmp_path / "serve_policy.py").write_text(program, encoding="utf-8")
    (script,) = blocks_of(PAGE, "bash")
    stages = len(load_scenario(ID).target) + 1
    for shown, here in (
        ("0 1 2 3 4", " ".join(str(stage) for stage in range(stages))),
        ("clbench/Fetch-v1", ID),
        ("localhost:8000", f"localhost:{port}"),
        ("python ", f"{sys.executable} "),
        ("clbench score", f"{sys.executable} -m clbench score"),
    ):
        assert shown in script
        script = script.replace(shown, here)
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, check=False, capture_output=True, text=True, timeout=280
    )
    for stage in range(stages):
        assert f"(server: checkpoint stage-{stage})" in done.stderr, done.stderr
    assert (tmp_path / "leaderboard/records/Toy-v0/me--lora/seed-0.json").is_file()
    with socket.create_server(("localhost", int(port))):  # no server is left
        pass


def test_the_page_lists_the_sizes_of_all_scenarios_that_retain_skills() -> None:
    shown = {f"clbench/{name}" for name, *_ in ROWS}
    worlds = {name: registered_scenario(name).tasks[0].world for name in scenario_ids()}
    ours = {name for name, world in worlds.items() if world.startswith("clbench.envs.")}
    assert shown <= ours
    for name in ours:
        with contextlib.suppress(MissingPackageError):
            assert (name in shown) == bool(load_scenario(name).retained)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: str(row[0]))
def test_the_sizes_on_the_page_are_those_of_the_scenario(row: tuple[str, ...]) -> None:
    name, state, action, picture, fewest, most = row
    scenario = scenario_or_skip(f"clbench/{name}")
    env = gymnasium.make(scenario.id, stage=0)
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    spaces = {key: space.shape for key, space in env.observation_space.items()}
    assert spaces["state"] == (int(state),)
    assert env.action_space.shape == (int(action),)
    size = picture.partition(" x ")[0]
    assert spaces.get("image") == (None if picture == "-" else (int(size), int(size), 3))
    protocol = describe_scenario(scenario).protocol()
    stages = range(len(scenario.target) + 1)
    counts = [len(list(protocol.episodes(protocol.end(stage)))) for stage in stages]
    assert (min(counts), max(counts)) == (int(fewest), int(most or fewest))
    env.close()


def test_the_programs_of_the_page_run_in_the_environment_of_clbench(
    tmp_path: Path, empty_caches: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(SIZES, {})
    assert capsys.readouterr().out.splitlines() == [
        "(28,) Box(-1.0, 1.0, (4,), float32)",
        "['reach', 'hover', 'pick_and_place'] ['push_right', 'press', 'lift', 'carry_back']",
    ]
    exec(SCORED.replace("clbench/Fetch-v1", ID), {"act": lambda _: np.zeros((40, 8, 2))})
    assert (tmp_path / "leaderboard/records/Toy-v0/me--lora/seed-0.json.unfinished").exists()


LIBRARIES = {
    "lerobot/policies/act/modeling_act.py": """
import torch

class ACTPolicy:
    config = "config"

    @classmethod
    def from_pretrained(cls, path):
        assert path.endswith("pretrained_model")
        return cls()

    def predict_action_chunk(self, batch):
        assert batch["observation.images.image"].shape == (40, 3, 8, 8)
        return batch["observation.state"][:, None, :2].repeat(1, 5, 1)
""",
    "lerobot/policies/factory.py": """
def make_pre_post_processors(policy_cfg, pretrained_path=None, **kwargs):
    assert policy_cfg == "config" and pretrained_path
    return dict, (lambda action: action)
""",
    "openpi/training/config.py": """
from types import SimpleNamespace

def get_config(name):
    return SimpleNamespace(model=SimpleNamespace(action_horizon=5, action_dim=32))
""",
    "openpi/policies/policy_config.py": """
import numpy as np

class Policy:
    def infer(self, obs, *, noise=None):
        assert noise.shape == (5, 32)
        assert obs["observation/image"].shape == obs["observation/wrist_image"].shape
        return {"actions": np.tile(obs["observation/state"][:2], (5, 1)), "prompt": obs["prompt"]}

def create_trained_policy(train_config, checkpoint_dir):
    return Policy()
""",
}
"""The parts of LeRobot and openpi that the page uses, with the signatures that they have there."""


@pytest.mark.long
@pytest.mark.parametrize("program", [LEROBOT, OPENPI], ids=["lerobot", "openpi"])
def test_the_programs_for_other_libraries_serve_their_policies(program: str, tmp_path: Path) -> None:
    for name, source in LIBRARIES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(source, encoding="utf-8")
    observations: dict[str, Any] = {
        "state": np.random.default_rng(0).random((40, 3), np.float32),
        "image": np.zeros((40, 8, 8, 3), np.uint8),
        "instruction": ["go left"] * 40,
        "seed": np.arange(40),
        "step": np.zeros(40, np.int64),
        "pictures/agentview": np.zeros((40, 8, 8, 3), np.uint8),
        "pictures/robot0_eye_in_hand": np.zeros((40, 8, 8, 3), np.uint8),
    }
    with served_by(program, tmp_path) as address:
        served = ServedPolicy(address)
        found = served(observations)
        assert "stage-0" in served.metadata["checkpoint"]
        served.close()
    assert np.array_equal(found, np.repeat(observations["state"][:, None, :2], 5, axis=1))
