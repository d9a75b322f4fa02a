"""How fast environments step on Fetch, against the vector environments of others and the physics alone.

Contenders take turns in blocks of steps, in a new order each round, so that what else the machine does meets
all of them alike. A ratio is that of two blocks of one round; reported are the median over rounds and a 95 %
bootstrap interval of it. All take the same random actions and begin episodes anew as they end. The peers step
gymnasium-robotics' own FetchPickAndPlace-v4, whose scene, physics and observation ours has, and our plain
environment besides; the physics alone is as many threads that do nothing but `mujoco.mj_step`.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray
from ratios import median_ratio
from rich.progress import track

import clbench
from clbench.fingerprint import fingerprint
from clbench.task import load_scenario, resolve

RESULTS = Path(__file__).parent / "results"
OURS = "clbench/Fetch-v0"
PEERS = "FetchPickAndPlace-v4"

Actions = NDArray[np.float32]


class Contender(Protocol):
    """Something that steps environments."""

    def run(self, actions: Actions) -> None:
        """Step each environment by its actions (steps, num_envs, 4)."""
        ...

    def close(self) -> None:
        """End its threads or processes."""
        ...


class VectorContender:
    """A vector environment of Gymnasium."""

    def __init__(self, env_id: str, num_envs: int, **options: Any) -> None:
        self.env = gymnasium.make_vec(env_id, num_envs=num_envs, **options)
        self.env.reset(seed=0)

    def run(self, actions: Actions) -> None:
        """Step each environment by its actions (steps, num_envs, 4)."""
        for batch in actions:
            self.env.step(batch)

    def close(self) -> None:
        """Close it."""
        self.env.close()


class SubprocContender:
    """The vector environment of Stable-Baselines3: a process for each environment."""

    def __init__(self, env_id: str, num_envs: int, **options: Any) -> None:
        from stable_baselines3.common.vec_env import SubprocVecEnv

        make: Callable[[], Any] = functools.partial(_make, env_id, options)
        self.env = SubprocVecEnv([make] * num_envs)
        self.env.seed(0)
        self.env.reset()

    def run(self, actions: Actions) -> None:
        """Step each environment by its actions (steps, num_envs, 4)."""
        for batch in actions:
            self.env.step(batch)

    def close(self) -> None:
        """End its processes."""
        self.env.close()


def _make(env_id: str, options: dict[str, Any]) -> gymnasium.Env[Any, Any]:
    """Make an environment in a process of its own."""
    _register_peers()
    return gymnasium.make(env_id, **options)


def _register_peers() -> None:
    with contextlib.redirect_stderr(io.StringIO()):  # else each process prints a notice about Adroit's hand
        import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)


class PhysicsContender:
    """The physics alone, on as many threads: what is left if all else costs nothing.

    Args:
        num_envs: How many copies of the scene.
        threads: How many threads share them.
    """

    def __init__(self, num_envs: int, threads: int) -> None:
        self.scene = resolve("clbench.envs.fetch.scene:scene")()
        self.data = [mujoco.MjData(self.scene.model) for _ in range(num_envs)]
        self.threads, self.pool = threads, ThreadPoolExecutor(threads)

    def run(self, actions: Actions) -> None:
        """Step each copy by its actions (steps, num_envs, 4), 60 steps from the start and then anew."""
        list(self.pool.map(functools.partial(self._run, actions), range(self.threads)))

    def _run(self, actions: Actions, first: int) -> None:
        for number in range(first, len(self.data), self.threads):
            for step, action in enumerate(actions[:, number]):
                if step % 60 == 0:
                    self._reset(self.data[number])
                self._step(self.data[number], action)

    def _reset(self, data: mujoco.MjData) -> None:
        mujoco.mj_resetData(self.scene.model, data)
        data.qpos[:], data.qvel[:] = self.scene.qpos, self.scene.qvel
        mujoco.mj_forward(self.scene.model, data)

    def _step(self, data: mujoco.MjData, action: Actions) -> None:
        data.mocap_pos[0] = data.xpos[self.scene.hand_body] + 0.05 * action[:3]
        data.mocap_quat[0] = data.xquat[self.scene.hand_body]
        data.ctrl[:] = data.qpos[self.scene.actuators_qpos] + action[3]
        mujoco.mj_step(self.scene.model, data, nstep=self.scene.substeps)

    def close(self) -> None:
        """End its threads."""
        self.pool.shutdown()


def contenders(num_envs: int, threads: int) -> dict[str, Contender]:
    """Return all that is compared, by name; `clbench` is ours."""
    tokens = {"instruction": "tokens"}
    return {
        "clbench": VectorContender(OURS, num_envs, threads=threads, **tokens),
        "clbench, one thread": VectorContender(OURS, num_envs, threads=1, **tokens),
        "SyncVectorEnv of ours": VectorContender(OURS, num_envs, vectorization_mode="sync", **tokens),
        "AsyncVectorEnv of ours": VectorContender(OURS, num_envs, vectorization_mode="async", **tokens),
        "SubprocVecEnv of ours": SubprocContender(OURS, num_envs, **tokens),
        "AsyncVectorEnv": VectorContender(PEERS, num_envs, vectorization_mode="async"),
        "SubprocVecEnv": SubprocContender(PEERS, num_envs),
        "mj_step": PhysicsContender(num_envs, threads),
        "mj_step, one thread": PhysicsContender(num_envs, 1),
    }


def main() -> None:
    """Measure, print a table and write results/rollouts.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=60, help="steps of each environment in a block")
    arguments = parser.parse_args()
    _register_peers()
    generator = np.random.default_rng(0)
    compared = contenders(arguments.num_envs, arguments.threads)
    rounds: list[dict[str, float]] = []
    for number in track(range(arguments.rounds + 1), "rounds"):
        shape = (arguments.steps, arguments.num_envs, 4)
        actions = generator.uniform(-1.0, 1.0, shape).astype(np.float32)
        rates = {}
        for name in generator.permutation(list(compared)):
            begin = time.perf_counter()
            compared[str(name)].run(actions)
            rates[str(name)] = actions[..., 0].size / (time.perf_counter() - begin)
        if number:  # the first round warms up
            rounds.append(rates)
    for contender in compared.values():
        contender.close()
    others = [name for name in compared if name != "clbench"]
    result = {
        "clbench": clbench.__version__,
        "hardware": fingerprint(load_scenario(OURS))["hardware"],
        "num_envs": arguments.num_envs,
        "threads": arguments.threads,
        "rounds": arguments.rounds,
        "steps_per_second": {
            name: round(statistics.median(one[name] for one in rounds)) for name in compared
        },
        "ratios_of_clbench_to": {
            name: median_ratio([one["clbench"] / one[name] for one in rounds], generator) for name in others
        },
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "rollouts.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    for name, ratio in result["ratios_of_clbench_to"].items():
        interval = f"[{ratio['low']:.2f}, {ratio['high']:.2f}]"
        print(f"{ratio['median_ratio']:.2f} {interval} times {name} ({result['steps_per_second'][name]} /s)")


if __name__ == "__main__":
    main()
