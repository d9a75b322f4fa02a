import subprocess
import sys
from importlib.metadata import version

from clbench.runs.fingerprint import fingerprint, rollout_hash
from clbench.spec.registry import load_scenario

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
FETCH = load_scenario("clbench/Fetch-v1")


def test_a_rollout_hash_is_the_same_in_another_process_and_differs_between_tasks() -> None:
    world = FETCH.task("press").world
    code = f"from clbench.runs.fingerprint import rollout_hash; print(rollout_hash({world!r}, 'press'))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert rollout_hash(world, "press") == result.stdout.strip()
    assert rollout_hash(world, "press") != rollout_hash(world, "reach")


def test_a_fingerprint_names_only_the_simulator_of_its_suite() -> None:
    assert fingerprint(FETCH)["versions"]["gymnasium-robotics"] == version("gymnasium-robotics")
    assert "gymnasium-robotics" not in fingerprint(TOY)["versions"]


def test_a_fingerprint_names_versions_hardware_and_every_world() -> None:
    found = fingerprint(TOY)
    assert found["versions"]["mujoco"] == version("mujoco")
    assert set(found["hardware"]) == {"machine", "system", "processor", "instructions"}
    assert all(found["hardware"].values())
    assert set(found["rollouts"]) == {"clbench.testing:ToyWorld"}
    assert found["commit"] is None or len(found["commit"]["id"]) == 40
