"""How cost grows with tasks, episodes, environments and demonstrations: `python benchmarks/scaling.py`.

Each quantity is measured at several sizes in turns, in a new order each round; the results are the medians,
the straight line through them and their distance from it. Tasks come from Meta-World, each with its own
scene, and episodes from Fetch, both with an untrained policy, whose episodes last to their horizons. Numbers
of episodes are multiples of the 40 that step together, because fewer episodes need a forward pass with just
as many rows.
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from ratios import take_turns
from result_files import write_results

from clbench.base.seeding import torch_generator
from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.evaluation.episodes import Trial
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.optimise import deterministic, optimise
from clbench.learning.pretraining import policy_config
from clbench.policy.kinds import new_policy
from clbench.spec.registry import load_scenario

FETCH, META_WORLD = "clbench/Fetch-v1", "clbench/MetaWorld-v1"


def evaluation_of_tasks() -> Callable[[int], float]:
    """Return a function that times 4 episodes of 50 steps on each of a number of tasks."""
    scenario = load_scenario(META_WORLD)
    names = [name.removesuffix("-v3").replace("-", "_") for name in ALL_V3_ENVIRONMENTS]
    tasks = [dataclasses.replace(scenario.target[0], name=name, horizon=50) for name in names]
    policy = new_policy(policy_config(scenario), seed=0)
    evaluator = Evaluator(scenario, seed=0)

    def seconds(count: int) -> float:
        trials = [Trial(task, "validation", number) for task in tasks[:count] for number in range(4)]
        begin = time.perf_counter()
        with deterministic():
            evaluator.play(policy, trials)
        return time.perf_counter() - begin

    return seconds


def evaluation_of_episodes() -> Callable[[int], float]:
    """Return a function that times a number of episodes of one task."""
    scenario = load_scenario(FETCH)
    policy = new_policy(policy_config(scenario), seed=0)
    evaluator = Evaluator(scenario, seed=0)

    def seconds(count: int) -> float:
        begin = time.perf_counter()
        with deterministic():
            evaluator.play(
                policy, [Trial(scenario.retained[-1], "validation", number) for number in range(count)]
            )
        return time.perf_counter() - begin

    return seconds


def steps_of_environments() -> Callable[[int], float]:
    """Return a function that times 20 steps of a number of environments."""
    made: dict[int, gymnasium.vector.VectorEnv[Any, Any, Any]] = {}

    def seconds(count: int) -> float:
        if count not in made:
            made[count] = gymnasium.make_vec(FETCH, num_envs=count, instruction="tokens")
            made[count].reset(seed=0)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, count, 4)).astype(np.float32)
        begin = time.perf_counter()
        for batch in actions:
            made[count].step(batch)
        return time.perf_counter() - begin

    return seconds


def steps_on_demonstrations() -> Callable[[int], float]:
    """Return a function that times 10 optimiser steps on a number of demonstrations."""
    scenario = load_scenario(FETCH)
    policy = new_policy(policy_config(scenario), seed=0)
    data = load_demonstrations(scenario.target[0], scenario, policy.config)
    copies: dict[int, Demonstrations] = {}

    def seconds(count: int) -> float:
        times = count // scenario.budget.demonstrations
        if count not in copies:
            whole = Demonstrations.cat([data] * times)
            rows = torch.tensor([[0, len(whole)]])
            copies[count] = dataclasses.replace(whole, words=data.words, rows=rows)
        generator = torch_generator("scaling", count)
        many = copies[count]
        begin = time.perf_counter()
        with deterministic():
            optimise(
                policy.parameters(),
                1e-4,
                10,
                lambda _: policy.action_loss(many.sample(scenario.budget.batch_size, generator)).mean(),
            )
        return time.perf_counter() - begin

    return seconds


MEASURES: dict[str, tuple[Callable[[], Callable[[int], float]], tuple[int, ...]]] = {
    "tasks": (evaluation_of_tasks, (10, 20, 30, 40, 50)),
    "episodes": (evaluation_of_episodes, (40, 80, 120, 160, 200)),
    "environments": (steps_of_environments, (4, 8, 16, 32, 64)),
    "demonstrations": (steps_on_demonstrations, (200, 400, 800, 1600, 3200)),
}
"""Measured quantities with their sizes."""


def line(sizes: Sequence[int], seconds: Sequence[float]) -> dict[str, float]:
    """Return the least-squares line, and the largest relative distance of a point from it."""
    slope, offset = np.polyfit(sizes, seconds, 1)
    fitted = slope * np.array(sizes) + offset
    return {
        "seconds_each": float(slope),
        "seconds_at_none": float(offset),
        "farthest_off": round(float(np.abs(np.array(seconds) / fitted - 1.0).max()), 3),
    }


def main() -> None:
    """Measure, print a table and write results/scaling.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    generator = np.random.default_rng(0)
    found: dict[str, Any] = {}
    for name, (prepare, sizes) in MEASURES.items():
        measure = prepare()
        # the first round also prepares everything that is made once, such as scenes
        works = {str(size): lambda _, size=size, measure=measure: measure(size) for size in sizes}
        rounds = take_turns(works, arguments.rounds, generator, name)
        seconds = [statistics.median(taken[one] for taken in rounds) for one in works]
        found[name] = {"sizes": sizes, "seconds": [round(one, 3) for one in seconds], **line(sizes, seconds)}
        print(name, found[name])
    result = {
        "rounds": arguments.rounds,
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "measures": found,
    }
    write_results("scaling", result)
    print(f"peak memory {result['peak_memory_gb']} GB")


if __name__ == "__main__":
    main()
