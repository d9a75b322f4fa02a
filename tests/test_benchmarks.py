import os
import subprocess
import sys
from pathlib import Path

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


def test_the_walker_that_is_measured_is_dm_controls() -> None:
    environment = {**os.environ, "PYTHONPATH": os.fspath(BENCHMARKS), "MUJOCO_GL": "off"}
    subprocess.run([sys.executable, "-c", COMPARISON], check=True, env=environment)
