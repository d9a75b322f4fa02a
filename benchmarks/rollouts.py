"""Speed of environments by suite, compared with other vector environments and with the physics alone.

Contenders take turns in blocks of steps, in a new order each round, so that other work on the machine affects
all of them equally. A ratio compares two blocks of one round; the results are the median over rounds and its
95 % bootstrap interval. All take the same random actions and start a new episode when one ends. The peers
step the suite's own environment, which has our physics, with the same simulated time per step. The physics
alone is the same number of threads that only call `mujoco.mj_step` on this environment's model. For LIBERO,
it steps LIBERO's whole model, visual geoms included, and the arm stands still.

    python benchmarks/rollouts.py fetch libero

The results of other suites stay. LIBERO's row leaves out SubprocVecEnv: a process of LIBERO takes half a
gigabyte as a fork and one gigabyte otherwise, and 32 of them do not fit into 24 GB.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol, cast

import gymnasium
import mujoco
import numpy as np
import walker
from numpy.typing import NDArray
from ratios import median_ratio, take_turns
from result_files import write_row

from clbench.base.entry_points import resolve
from clbench.base.errors import MissingPackageError
from clbench.spec.registry import load_scenario
from clbench.worlds.threads import cores

Actions = NDArray[np.float32]
Env = gymnasium.Env[Any, Any]


@dataclass(frozen=True)
class Physics:
    """A scene at the start of an episode."""

    model: mujoco.MjModel
    start: mujoco.MjData
    substeps: int
    move: Callable[[mujoco.MjData, Actions], None]
    """Sets the inputs of the physics for an action (A,)."""


@dataclass(frozen=True)
class Suite:
    """The environments of a suite that are compared."""

    ours: str
    """Id of our scenario."""
    stage: int | None
    """Stage of our environment if the peer has only one task; None goes through all stages."""
    task: str
    """Name of the peer's task."""
    peer: Callable[[], Env]
    """Makes an environment of the peer; called in its own process."""
    physics: Callable[[Env], Physics]
    """Returns the physics of an environment of the peer that has been reset."""
    has_subproc: bool = True
    """Whether SubprocVecEnv is compared, too."""


# ---- the peers -----------------------------------------------------------------------------------------


def _fetch_peer() -> Env:
    with contextlib.redirect_stderr(io.StringIO()):  # hides a notice about Adroit's hand in each process
        import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make("FetchPickAndPlace-v4")


def _set_controls(data: mujoco.MjData, action: Actions) -> None:
    data.ctrl[:] = action


def _fetch_physics(env: Env) -> Physics:
    scene = resolve("clbench.envs.fetch.scene:scene")()

    def move(data: mujoco.MjData, action: Actions) -> None:
        data.mocap_pos[0] = data.xpos[scene.hand_body] + 0.05 * action[:3]
        data.mocap_quat[0] = data.xquat[scene.hand_body]
        data.ctrl[:] = data.qpos[scene.actuators_qpos] + action[3]

    unwrapped: Any = env.unwrapped
    return Physics(unwrapped.model, unwrapped.data, scene.substeps, move)


class DMControlEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """A task of dm_control as a Gymnasium environment, with steps as long as ours."""

    def __init__(self, domain: str, task: str, seconds: float) -> None:
        from dm_control import suite
        from dm_control.rl.control import Environment

        loaded = suite.load(domain, task, task_kwargs={"random": 0})
        self.env = Environment(
            loaded.physics, loaded.task, time_limit=100 * seconds, control_timestep=seconds
        )
        motors = self.env.action_spec()
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, motors.shape, np.float32)
        size = sum(int(np.prod(spec.shape)) for spec in self.env.observation_spec().values())
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begin an episode."""
        return self._flat(self.env.reset()), {}

    def step(self, action: Actions) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Move for one step."""
        moment = self.env.step(action)
        return self._flat(moment), float(moment.reward or 0.0), False, bool(moment.last()), {}

    def _flat(self, moment: Any) -> NDArray[np.float64]:
        return np.concatenate([np.ravel(part) for part in moment.observation.values()])


def _dm_control_peer(domain: str, task: str, seconds: float) -> Env:
    os.environ["MUJOCO_GL"] = "off"
    return DMControlEnv(domain, task, seconds)


def _dm_control_physics(env: Env) -> Physics:
    unwrapped: Any = env.unwrapped
    physics, seconds = unwrapped.env.physics, unwrapped.env.control_timestep()
    return Physics(physics.model.ptr, physics.data.ptr, round(seconds / physics.timestep()), _set_controls)


def _metaworld_peer() -> Env:
    import metaworld  # noqa: F401 - registers its environments

    return gymnasium.make("Meta-World/MT1", env_name="faucet-close-v3", disable_env_checker=True)


def _metaworld_physics(env: Env) -> Physics:
    unwrapped: Any = env.unwrapped

    def move(data: mujoco.MjData, action: Actions) -> None:
        low, high = unwrapped.mocap_low, unwrapped.mocap_high
        data.mocap_pos[0] = np.clip(data.mocap_pos[0] + action[:3] / 100.0, low, high)
        data.ctrl[:] = action[3], -action[3]

    return Physics(unwrapped.model, unwrapped.data, unwrapped.frame_skip, move)


class LiberoEnv(gymnasium.Env[NDArray[np.float64], NDArray[np.float32]]):
    """LIBERO's own environment of a task as a Gymnasium environment, without pictures.

    An episode begins without building its scene anew, 0.01 s of a core instead of the 0.5 s of LIBERO's
    default, which are 40 steps.

    Args:
        task: Name of the task.
    """

    def __init__(self, task: str) -> None:
        from libero_resets import libero

        self.env = libero(task, hard_reset=False)
        self.env.seed(0)
        size = self._flat(self.env.reset()).size
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Begin an episode."""
        return self._flat(self.env.reset()), {}

    def step(self, action: Actions) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Move for one step."""
        observation, reward, success, _ = self.env.step(action)
        return self._flat(observation), float(reward), bool(success), False, {}

    def _flat(self, observation: Mapping[str, Any]) -> NDArray[np.float64]:
        return np.concatenate([np.ravel(part) for part in observation.values()])


def _libero_peer(scenario: str) -> Env:
    task = load_scenario(scenario).target[0]
    return gymnasium.wrappers.TimeLimit(LiberoEnv(task.name), task.horizon)  # LIBERO's only ends with success


def _libero_physics(env: Env) -> Physics:
    sim, substeps = cast("Any", env.unwrapped).env.sim, resolve("clbench.envs.libero.arm:SUBSTEPS")

    def hold(data: mujoco.MjData, action: Actions) -> None:
        """Hold the arm against gravity: the controller is no part of the physics."""
        data.ctrl[:7], data.ctrl[7:] = data.qfrc_bias[:7], action[6]

    return Physics(sim.model._model, sim.data._data, substeps, hold)


SUITES = {
    "fetch": Suite(
        "clbench/Fetch-v1",
        None,
        "FetchPickAndPlace-v4",
        _fetch_peer,
        _fetch_physics,
    ),
    "dm_control": Suite(
        "clbench/DMControl-v0",
        3,
        "ball_in_cup catch",
        functools.partial(_dm_control_peer, "ball_in_cup", "catch", 0.04),
        _dm_control_physics,
    ),
    "dm_control, in no scenario": Suite(
        f"walker:{walker.ID}",
        1,
        "walker walk",
        functools.partial(_dm_control_peer, "walker", "walk", walker.SECONDS),
        _dm_control_physics,
    ),
    "metaworld": Suite(
        "clbench/MetaWorld-v1", 1, "Meta-World/MT1 faucet-close-v3", _metaworld_peer, _metaworld_physics
    ),
    "libero": Suite(
        "clbench/LiberoGoal-v0",
        1,
        "LIBERO open the middle drawer",
        functools.partial(_libero_peer, "clbench/LiberoGoal-v0"),
        _libero_physics,
        has_subproc=False,
    ),
    "libero, many contacts": Suite(
        "clbench/LiberoSpatial-v1",
        1,
        "LIBERO pick up the bowl between plate and ramekin",
        functools.partial(_libero_peer, "clbench/LiberoSpatial-v1"),
        _libero_physics,
        has_subproc=False,
    ),
}


# ---- the contenders ------------------------------------------------------------------------------------


class Contender(Protocol):
    """Something that steps environments."""

    def run(self, actions: Actions) -> None:
        """Step each environment by its actions (steps, num_envs, A)."""
        ...

    def close(self) -> None:
        """End its threads or processes."""
        ...


class Vector:
    """A vector environment that has been reset, of Gymnasium or of Stable-Baselines3.

    Args:
        env: The environment; both have `step` and `close`.
    """

    def __init__(self, env: Any) -> None:
        self.env = env

    def run(self, actions: Actions) -> None:
        """Step each environment by its actions (steps, num_envs, A)."""
        for batch in actions:
            self.env.step(batch)

    def close(self) -> None:
        """Close it, with its processes."""
        self.env.close()


def _of_gymnasium(env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> Vector:
    env.reset(seed=0)
    return Vector(env)


def _subproc(make: Callable[[], Env], num_envs: int) -> Vector:
    """Return the vector environment of Stable-Baselines3: a process for each environment."""
    from stable_baselines3.common.vec_env import SubprocVecEnv

    env = SubprocVecEnv([make] * num_envs)
    env.seed(0)
    env.reset()
    return Vector(env)


class Raw:
    """The physics alone, on the same number of threads: the limit.

    Args:
        physics: Physics of the suite.
        num_envs: Number of copies of the scene.
        threads: Number of threads that share them.
        horizon: Number of steps after which a new episode starts.
    """

    def __init__(self, physics: Physics, num_envs: int, threads: int, horizon: int) -> None:
        self.physics, self.horizon = physics, horizon
        self.data = [mujoco.MjData(physics.model) for _ in range(num_envs)]
        self.threads, self.pool = threads, ThreadPoolExecutor(threads)
        self.done = 0
        """Steps of each copy so far: an episode goes on in the next block, as the others' episodes do."""

    def run(self, actions: Actions) -> None:
        """Step each copy by its actions (steps, num_envs, A)."""
        list(self.pool.map(functools.partial(self._run, actions), range(self.threads)))
        self.done += len(actions)

    def _run(self, actions: Actions, first: int) -> None:
        physics = self.physics
        for number in range(first, len(self.data), self.threads):
            data = self.data[number]
            for step, action in enumerate(actions[:, number], self.done):
                if step % self.horizon == 0:
                    mujoco.mj_copyData(data, physics.model, physics.start)
                physics.move(data, action)
                mujoco.mj_step(physics.model, data, nstep=physics.substeps)

    def close(self) -> None:
        """End its threads."""
        self.pool.shutdown()


def contenders(suite: Suite, num_envs: int, threads: int) -> dict[str, Contender]:
    """Return all contenders by name; `clbench` is ours."""
    options: dict[str, Any] = {"instruction": "tokens"}
    if suite.stage is not None:
        options["stage"] = suite.stage
    scenario = load_scenario(suite.ours)
    scenario.require_packages()
    horizon = (scenario.target[suite.stage - 1] if suite.stage else scenario.tasks[0]).horizon
    peer = suite.peer()
    peer.reset(seed=0)
    physics = suite.physics(peer)

    def ours(**how: Any) -> Vector:
        return _of_gymnasium(gymnasium.make_vec(suite.ours, num_envs=num_envs, **options, **how))

    # processes first: they are forks of this one, which has no threads yet
    others: dict[str, Contender] = {
        "AsyncVectorEnv": _of_gymnasium(gymnasium.vector.AsyncVectorEnv([suite.peer] * num_envs))
    }
    if suite.has_subproc:
        others["SubprocVecEnv"] = _subproc(suite.peer, num_envs)
    return {
        "clbench": ours(threads=threads),
        "clbench, one thread": ours(threads=1),
        "SyncVectorEnv of ours": ours(vectorization_mode="sync"),
        **others,
        "mj_step": Raw(physics, num_envs, threads, horizon),
        "mj_step, one thread": Raw(physics, num_envs, 1, horizon),
    }


# ---- the measurement -----------------------------------------------------------------------------------


def measure(name: str, num_envs: int, threads: int, rounds: int, steps: int) -> dict[str, Any]:
    """Return the rates and ratios of a suite."""
    suite, generator = SUITES[name], np.random.default_rng(0)
    compared = contenders(suite, num_envs, threads)
    ours: Any = compared["clbench"]
    shape = (rounds + 1, steps, num_envs, *ours.env.single_action_space.shape)
    actions = generator.uniform(-1.0, 1.0, shape).astype(np.float32)

    def rate(contender: Contender, number: int) -> float:
        begin = time.perf_counter()
        contender.run(actions[number])
        return steps * num_envs / (time.perf_counter() - begin)

    works = {one: functools.partial(rate, contender) for one, contender in compared.items()}
    taken = take_turns(works, rounds, generator, name)
    for contender in compared.values():
        contender.close()
    return {
        "peer": suite.task,
        "num_envs": num_envs,
        "threads": threads,
        "rounds": rounds,
        "steps_per_second": {
            one: round(statistics.median(rates[one] for rates in taken)) for one in compared
        },
        "ratios_of_clbench_to": {
            one: median_ratio([rates["clbench"] / rates[one] for rates in taken], generator)
            for one in compared
            if one != "clbench"
        },
    }


def main() -> None:
    """Measure, print a table and write results/rollouts.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("suites", nargs="*", default=list(SUITES), help=f"of {', '.join(SUITES)}")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--threads", type=int, default=cores())
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=60, help="steps of each environment in a block")
    arguments = parser.parse_args()
    if unknown := set(arguments.suites) - set(SUITES):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(SUITES)}")
    for name in arguments.suites:
        try:
            found = measure(name, arguments.num_envs, arguments.threads, arguments.rounds, arguments.steps)
        except MissingPackageError as error:
            print(f"{name} is left out: {error}", file=sys.stderr)
            continue
        write_row("rollouts", "suites", name, found)
        print(f"{name}: {found['steps_per_second']['clbench']} steps/s, with {found['peer']} as the peer")
        rates = found["steps_per_second"]
        for other, ratio in found["ratios_of_clbench_to"].items():
            interval = f"[{ratio['low']:.2f}, {ratio['high']:.2f}]"
            print(f"  {ratio['median_ratio']:.2f} {interval} times {other}, {rates[other]} /s")


if __name__ == "__main__":
    main()
