"""Throughput of a served policy: `python benchmarks/served_policy.py`.

The pretrained policy plays the skills' validation episodes, 40 in parallel, in this process and behind a
server in another process on the same machine. Both take turns; the outcomes must be equal.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ratios import median_ratio, take_turns
from result_files import write_results

from clbench.base.seeding import torch_generator
from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.players import ChunkPolicy, play_chunks
from clbench.learning.pretraining import pretrained_policy
from clbench.serving.client import ServedPolicy
from clbench.serving.server import Observations, open_server
from clbench.spec.language import encode
from clbench.spec.registry import load_scenario


def main() -> None:
    """Measure, print the ratio and write results/served_policy.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenario", default="clbench/Fetch-v1")
    parser.add_argument("--episodes", type=int, default=40, help="episodes of each skill")
    parser.add_argument("--rounds", type=int, default=9)
    arguments = parser.parse_args()
    scenario = load_scenario(arguments.scenario)
    trials = [
        Trial(task, "validation", number)
        for task in scenario.retained
        for number in range(arguments.episodes)
    ]
    here = policy_of(arguments.scenario)
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    server = spawn.Process(target=offer, args=(arguments.scenario, theirs), daemon=True)
    server.start()
    served = ServedPolicy(f"ws://localhost:{ours.recv()}")
    outcomes: list[list[Episode]] = []

    def rate(policy: ChunkPolicy, _: int) -> float:
        begin = time.perf_counter()
        outcomes.append(play_chunks(policy, scenario, trials, 0).episodes)
        seconds = time.perf_counter() - begin
        if outcomes[-1] != outcomes[0]:
            raise SystemExit("The served policy has other outcomes.")
        return len(trials) / seconds

    policies: dict[str, ChunkPolicy] = {"in this process": here, "served": served}
    generator = np.random.default_rng(0)
    rates = take_turns(
        {name: functools.partial(rate, policy) for name, policy in policies.items()},
        arguments.rounds,
        generator,
    )
    served.close()
    server.terminate()
    values = {
        "episodes": len(trials),
        "rounds": len(rates),
        "episodes_per_second": {name: float(np.median([r[name] for r in rates])) for name in policies},
        "served_to_in_process": median_ratio([r["served"] / r["in this process"] for r in rates], generator),
    }
    print(values)
    write_results("served_policy", values)


def policy_of(scenario: str) -> Callable[[Observations], NDArray[Any]]:
    """Return the pretrained policy of seed 0 as a function of observations."""
    torch.set_num_threads(1)
    policy, _ = pretrained_policy(load_scenario(scenario), 0)
    size = (policy.config.chunk, policy.config.action_size)

    def act(observations: Observations) -> NDArray[Any]:
        drawn = [
            torch.randn(size, generator=torch_generator("noise", int(seed), int(step)))
            for seed, step in zip(observations["seed"], observations["step"], strict=True)
        ]
        state = torch.from_numpy(observations["state"])
        words = encode(observations["instruction"], policy.config.text_length)
        image = torch.zeros(len(state), 0, 0, 3, dtype=torch.uint8)
        with torch.no_grad():
            chunks = policy.act(state, words, torch.stack(drawn), image)
        actions: NDArray[Any] = chunks[:, : policy.config.executed].numpy()
        return actions

    return act


def offer(scenario: str, port: Connection) -> None:
    """Serve the pretrained policy, and send the port."""
    with open_server(policy_of(scenario), port=0) as server:
        port.send(server.socket.getsockname()[1])
        server.serve_forever()


if __name__ == "__main__":
    main()
