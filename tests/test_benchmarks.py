import importlib
import itertools
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from tiny import TINY

from clbench.base.entry_points import resolve
from clbench.data.demonstrations import load_demonstrations
from clbench.learning.pretraining import policy_config
from clbench.policy.kinds import new_policy
from clbench.testing import TOY

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"

COMPARISON = """
import numpy as np
import walker
from rollouts import DMControlEnv

world, peer = walker.WalkerVectorWorld(3, threads=2), DMControlEnv("walker", "walk", walker.SECONDS)
lanes, generator = [0, 1, 2], np.random.default_rng(0)
states = world.reset(lanes, [5, 6, 5], ["walk"] * 3)
peer.env.task.random.seed(5)
np.testing.assert_array_equal(states[0], peer.reset()[0].astype(np.float32))
rewarded = 0
for _ in range(90):
    actions = generator.uniform(-1, 1, (3, 6)).astype(np.float32)
    actions[2] = actions[0]
    states, rewards, successes = world.step(lanes, actions)
    state, reward, *_ = peer.step(actions[0])
    np.testing.assert_array_equal(states[0], state.astype(np.float32))
    np.testing.assert_array_equal(states[0], states[2])
    np.testing.assert_allclose(rewards[[0, 2]], reward, rtol=1e-15)
    assert not successes.any()
    rewarded += reward > 0.1
assert rewarded
assert (states[0] != states[1]).any()
world.close()
"""


def _run(program: str) -> None:
    """Run a program that imports benchmarks: some of them replace functions of clbench."""
    path = os.pathsep.join(map(os.fspath, (BENCHMARKS, Path(__file__).parent / "shared")))
    environment = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "off"}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)


def test_the_walker_that_is_measured_is_dm_controls() -> None:
    _run(COMPARISON)


@pytest.mark.parametrize("criterion", [None, 1.0])
def test_a_step_is_timed_without_the_first_which_makes_the_optimiser(
    criterion: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    step_time = importlib.import_module("step_time")
    readings = itertools.count()
    monkeypatch.setattr(step_time, "time", SimpleNamespace(perf_counter=readings.__next__))
    scenario = replace(TINY, budget=replace(TINY.budget, criterion=criterion))
    policy = new_policy(policy_config(scenario))
    data = {"target": load_demonstrations(scenario.target[0], scenario, policy.config)}
    assert step_time.Bench("sft", scenario, policy, data).seconds(3) == 3


WHOLE_RUN = """
import itertools, types, whole_run
from tiny import TINY
from clbench.runs.spec import RunSpec

whole_run.time = types.SimpleNamespace(perf_counter=itertools.count().__next__)  # no part is too short
found = whole_run.measure(RunSpec(TINY.id, "sft", 0).resolve())
assert all(found["parts"][part] > 0 for part in ("physics", "pictures", "policy")), found
"""


def test_every_part_of_a_whole_run_is_measured() -> None:
    _run(WHOLE_RUN)


@pytest.mark.parametrize(
    ("quantity", "size"),
    [
        ("tasks", 1),
        ("episodes", 1),
        ("environments", 1),
        pytest.param("demonstrations", 200, marks=pytest.mark.slow),
    ],
)
def test_every_quantity_whose_cost_may_grow_is_measured(
    quantity: str, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    prepare, _ = importlib.import_module("scaling").MEASURES[quantity]
    assert prepare()(size) > 0


def test_the_size_of_the_page_is_that_of_a_page_with_all_rows() -> None:
    command = [
        sys.executable,
        os.fspath(BENCHMARKS / "page.py"),
        "--methods",
        "2",
        "--seeds",
        "1",
        "--scenarios",
        "1",
    ]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.startswith("2 rows, ")


# ---- overlap ---------------------------------------------------------------------------------------------


@pytest.fixture
def overlap(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("overlap")


def test_the_page_on_overlap_has_the_committed_results(overlap: ModuleType) -> None:
    results = json.loads((BENCHMARKS / "results" / "overlap.json").read_text(encoding="utf-8"))
    assert set(results) == set(overlap.SCENARIOS)
    assert overlap.PAGE.read_text(encoding="utf-8") == overlap.page(results)


def test_rates_are_of_the_actors_that_the_page_names(overlap: ModuleType) -> None:
    found = overlap.measured(TOY, episodes=6)
    right = found["tasks"]["right"]
    assert right["part"] == "target"
    assert right["nothing"] == 0.0
    assert right["random"] < 0.5
    assert "right" not in right["experts"]
    assert right["experts"]["left"] == 0.0
    assert overlap.rate(TOY.task("right"), resolve(TOY.task("right").expert)("right"), 6) == 1.0
    assert max(found["known"].values()) < 0.9  # the toy's tasks begin alike
