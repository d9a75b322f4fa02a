"""The fingerprint of a record: software, hardware, and the bits of the simulator."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from clbench.runs.fingerprint import arithmetic, arithmetic_hash, fingerprint, rollout_hash
from clbench.spec.registry import load_scenario

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
FETCH = load_scenario("clbench/Fetch-v1")


@pytest.mark.long
def test_a_rollout_hash_is_the_same_in_another_process_and_differs_between_tasks() -> None:
    world = FETCH.task("press").world
    code = f"from clbench.runs.fingerprint import rollout_hash; print(rollout_hash({world!r}, 'press'))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert rollout_hash(world, "press") == result.stdout.strip()
    assert rollout_hash(world, "press") != rollout_hash(world, "reach")


WORLD = """
from clbench.testing import ToyWorld

class Counting(ToyWorld):
    def reset(self, **given):
        self.count = 0
        return super().reset(**given)

    def step(self, action):
        self.count += 1
        state, *rest = super().step(action)
        return (state + (self.count == self.other), *rest)

class Usual(Counting):
    other = 0

class Fiftieth(Counting):
    other = 50

class Later(Counting):
    other = 51
"""


def test_a_rollout_hash_changes_with_any_of_fifty_steps(write_module: Callable[[str, str], None]) -> None:
    write_module("counting_worlds", WORLD)
    names = (
        "clbench.testing:ToyWorld",
        *(f"counting_worlds:{one}" for one in ("Usual", "Later", "Fiftieth")),
    )
    toy, usual, later, fiftieth = (rollout_hash(name, "left") for name in names)
    assert toy == usual == later != fiftieth


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_commit_is_dirty_if_code_was_changed_and_not_by_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> str:
        author = ("-c", "user.name=a", "-c", "user.email=a@b")
        command = ["git", "-C", str(tmp_path), *author, *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    code, record = tmp_path / "clbench" / "runs" / "fingerprint.py", tmp_path / "leaderboard" / "seed-0.json"
    for path in (code, record):
        path.parent.mkdir(parents=True)
    code.touch()
    git("init")
    git("add", ".")
    git("commit", "--message", "first")
    monkeypatch.setattr("clbench.runs.fingerprint.__file__", str(code))
    head = git("rev-parse", "HEAD")
    record.touch()
    assert fingerprint(TOY)["commit"] == {"id": head, "dirty": False}
    code.write_text("changed = True")
    assert fingerprint(TOY)["commit"] == {"id": head, "dirty": True}


@pytest.mark.long
def test_a_fingerprint_names_only_the_simulator_of_its_suite() -> None:
    assert fingerprint(FETCH)["versions"]["gymnasium-robotics"] == version("gymnasium-robotics")
    assert "gymnasium-robotics" not in fingerprint(TOY)["versions"]


def test_a_run_on_a_gpu_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.get_device_name", {"cuda:1": "H100"}.__getitem__)
    assert fingerprint(TOY, "cuda:1")["hardware"]["gpu"] == "H100"


def test_processors_of_two_makers_compute_otherwise_with_the_same_instructions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = []
    for maker in ("GenuineIntel", "AuthenticAMD", "AuthenticAMD"):
        text = f"processor\t: 0\nvendor_id\t: {maker}\nmodel name\t: One\n"
        monkeypatch.setattr(Path, "read_text", lambda *_, text=text, **__: text)
        found.append(arithmetic("cpu"))
    assert found[0] != found[1] == found[2]
    assert {**found[0], "maker": None} == {**found[1], "maker": None}


def test_the_arithmetic_is_the_same_with_any_number_of_threads() -> None:
    one, threads = arithmetic_hash(), torch.get_num_threads()
    arithmetic_hash.cache_clear()
    torch.set_num_threads(3)
    try:
        assert arithmetic_hash() == one
    finally:
        torch.set_num_threads(threads)


@pytest.mark.long
@pytest.mark.skipif(
    torch.backends.cpu.get_cpu_capability() == "DEFAULT",
    reason="PyTorch has no other code here",
)
def test_the_arithmetic_is_measured_and_not_read_from_a_name() -> None:
    code = "from clbench.runs.fingerprint import arithmetic_hash; print(arithmetic_hash())"
    without_vectors = {**os.environ, "ATEN_CPU_CAPABILITY": "default"}
    result = subprocess.run(
        [sys.executable, "-c", code], env=without_vectors, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() != arithmetic_hash()


def test_a_fingerprint_names_versions_hardware_and_every_world() -> None:
    found = fingerprint(TOY)
    assert found["versions"]["mujoco"] == version("mujoco")
    assert set(found["hardware"]) == {"machine", "system", "processor", "instructions", "arithmetic"}
    assert all(found["hardware"].values())
    assert set(found["rollouts"]) == {"clbench.testing:ToyWorld"}
    assert found["commit"] is None or len(found["commit"]["id"]) == 40
