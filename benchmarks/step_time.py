"""Cost of an adaptation step of each method, as a ratio to plain fine-tuning: `make benchmark`.

Methods take turns in blocks of steps, in a new order each round, so that other work on the machine affects
all of them equally. A ratio compares two blocks of one round; the results are the median over rounds and its
95 % bootstrap interval. The policy, the data and the batches come from the first target of a real run. The
limit is a bare PyTorch loop of the same model on batches in memory: the additional time of plain fine-tuning
is the cost of hooks, sources and checks.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import time
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from ratios import median_ratio
from result_files import write_results
from rich.progress import track

from clbench.base.seeding import seeded, torch_generator
from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.data.questions import load_questions
from clbench.learning.adaptation import Step, adapt
from clbench.learning.method import Stage
from clbench.learning.optimise import BETAS, GRADIENT_NORM, deterministic
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.prior import Prior, Source
from clbench.learning.registry import load_method, method_names, new_method
from clbench.policy.policy import Policy
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario

BASELINE = "sft"
LIMIT = "bare loop"


class Bench:
    """One prepared method, which can run blocks of steps.

    Args:
        name: Name of the method.
        scenario: Scenario of the budget and the tasks.
        policy: Pretrained policy; it is copied.
        data: Data to draw from, by the names `target`, `demonstrations` and `questions`.
    """

    def __init__(self, name: str, scenario: Scenario, policy: Policy, data: Mapping[str, Any]) -> None:
        self.scenario, self.policy, self.data = scenario, deepcopy(policy), data
        self.method = new_method(name, load_method(name), {})
        with seeded("benchmark", name):
            self.method.prepare(self.policy, self._prior("prepare"))

    def _source(self, name: str) -> Source[Any]:
        return Source(self.data[name], torch_generator("benchmark", name), self.scenario.budget.batch_size)

    def _prior(self, when: str) -> Prior:
        access = dataclasses.asdict(self.method.uses)
        names = [name for name in ("demonstrations", "questions") if access[name] in (when, "throughout")]
        return Prior({name: self._source(name) for name in names})

    def seconds(self, steps: int) -> float:
        """Return the time of `steps` steps in seconds, after a first step that makes the optimiser."""
        stage = Stage(
            1, self.scenario.target[0], 0, steps + 1, self._source("target"), self._prior("throughout")
        )
        marks: list[float] = []

        def after(step: Step) -> None:
            if step.trains:
                marks.append(time.perf_counter())

        with seeded("benchmark", "steps"):
            adapt(self.policy, self.method, stage, self.scenario.budget, after)
        return marks[-1] - marks[0]


class BareLoop:
    """The bare steps of plain fine-tuning: the limit.

    Args:
        bench: Prepared plain fine-tuning; its policy is copied.
    """

    def __init__(self, bench: Bench) -> None:
        self.budget, self.policy = bench.scenario.budget, deepcopy(bench.policy)
        self.target = bench.data["target"]

    def seconds(self, steps: int) -> float:
        """Return the time of `steps` steps in seconds, after a first step."""
        generator = torch_generator("benchmark", "target")
        size = self.budget.batch_size
        batches = [self.target.sample(size, generator) for _ in range(steps + 1)]
        parameters = list(self.policy.parameters())
        optimiser = torch.optim.AdamW(
            parameters, lr=self.budget.learning_rate, betas=BETAS, weight_decay=1e-10, fused=True
        )
        begin = 0.0
        for number, batch in enumerate(batches):
            loss = self.policy.action_loss(batch).mean()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            torch.nn.utils.clip_grad_norm_(parameters, GRADIENT_NORM)
            optimiser.step()
            begin = begin if number else time.perf_counter()
        return time.perf_counter() - begin


def main() -> None:
    """Measure, print a table and write results/step_time.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenario", default="clbench/Fetch-v1")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=8, help="timed steps in a block")
    arguments = parser.parse_args()
    scenario = load_scenario(arguments.scenario)
    names = [name for name in method_names() if name != "frozen" and "/" not in name]
    policy, _ = pretrained_policy(scenario, 0)
    skills = [load_demonstrations(task, scenario, policy.config) for task in scenario.retained]
    data = {
        "target": load_demonstrations(scenario.target[0], scenario, policy.config),
        "demonstrations": Demonstrations.cat(skills),
        "questions": load_questions(scenario)[0],
    }
    generator = np.random.default_rng(0)
    rounds: list[dict[str, float]] = []
    with deterministic():
        benches: dict[str, Bench | BareLoop] = {}
        for name in names:
            benches[name] = bench = Bench(name, scenario, policy, data)
            if name == BASELINE:
                benches[LIMIT] = BareLoop(bench)
        for number in track(range(arguments.rounds + 1), "rounds"):
            taken = {}
            for name in generator.permutation(list(benches)):
                taken[str(name)] = benches[str(name)].seconds(arguments.steps)
            if number:  # the first round warms up
                rounds.append(taken)
    ratios = {
        name: median_ratio([one[name] / one[BASELINE] for one in rounds], generator) for name in benches
    }
    limit = ratios.pop(LIMIT)
    baseline = statistics.median(one[BASELINE] for one in rounds) / arguments.steps
    result = {
        "baseline_seconds_per_step": round(baseline, 4),
        "rounds": arguments.rounds,
        "bare_loop": limit,
        "ratios": ratios,
    }
    write_results("step_time", arguments.scenario, result)
    for name, ratio in sorted({LIMIT: limit, **ratios}.items(), key=lambda item: item[1]["median_ratio"]):
        print(f"{name:24} {ratio['median_ratio']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]")


if __name__ == "__main__":
    main()
