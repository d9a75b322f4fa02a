"""Cost of an adaptation step of each method, relative to plain fine-tuning: `make benchmark`.

Methods take turns in blocks of steps, in a new order each round, so that other work on the machine affects
all of them equally. A ratio compares two blocks of one round; the results are the median over rounds and its
95 % bootstrap interval. The steps are those that the trainer of a run takes on the first target. The limit is
a bare PyTorch loop of the same model on batches in memory: the additional time of plain fine-tuning is the
cost of hooks, sources and checks. Every run measures the same ratio, at its end and less precisely, for the
board's costs (`clbench.runs.step_time`).
"""

from __future__ import annotations

import argparse
import functools
import statistics
import time
from copy import deepcopy

import numpy as np
import torch
from ratios import median_ratio, take_turns
from result_files import write_results

from clbench.base.seeding import torch_generator
from clbench.data.training_data import TrainingData
from clbench.learning.adaptation import Step
from clbench.learning.optimise import BETAS, GRADIENT_NORM, WEIGHT_DECAY, deterministic
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import load_method, new_method
from clbench.learning.trainer import Trainer
from clbench.policy.policy import Policy
from clbench.spec.identifiers import built_in_methods
from clbench.spec.references import BASELINE, FROZEN
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario

LIMIT = "bare loop"


class Bench:
    """One prepared method, which can run blocks of steps on the first target.

    Args:
        name: Name of the method.
        scenario: Scenario of the budget and the tasks.
        data: Data of the scenario.
        policy: Pretrained policy; it is copied.
    """

    def __init__(self, name: str, scenario: Scenario, data: TrainingData, policy: Policy) -> None:
        new = functools.partial(new_method, name, load_method(name), {})
        self.trainer = Trainer(scenario, data, policy, new, seed=0)
        self.trainer.prepare()

    def seconds(self, steps: int) -> float:
        """Return the time of `steps` steps in seconds, after a first step that creates the optimiser."""
        marks: list[float] = []

        def after(step: Step) -> bool:
            if step.loss is not None:
                marks.append(time.perf_counter())
            return len(marks) > steps

        self.trainer.learn(1, after)
        return marks[-1] - marks[0]


class BareLoop:
    """The bare steps of plain fine-tuning: the limit.

    Args:
        scenario: Scenario of the budget and the tasks.
        data: Data of the scenario.
        policy: Pretrained policy; it is copied.
    """

    def __init__(self, scenario: Scenario, data: TrainingData, policy: Policy) -> None:
        self.budget, self.policy = scenario.budget, deepcopy(policy)
        self.target = data.demonstrations(scenario.target[0])

    def seconds(self, steps: int) -> float:
        """Return the time of `steps` steps in seconds, after a first step."""
        generator = torch_generator("benchmark", "target")
        size = self.budget.batch_size
        batches = [self.target.sample(size, generator) for _ in range(steps + 1)]
        parameters = list(self.policy.parameters())
        optimiser = torch.optim.AdamW(
            parameters, lr=self.budget.learning_rate, betas=BETAS, weight_decay=WEIGHT_DECAY, fused=True
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
    names = sorted(built_in_methods().keys() - {FROZEN})
    policy, _ = pretrained_policy(scenario, 0)
    data = TrainingData.open(scenario, policy.config)
    generator = np.random.default_rng(0)
    with deterministic():
        benches: dict[str, Bench | BareLoop] = {LIMIT: BareLoop(scenario, data, policy)}
        benches |= {name: Bench(name, scenario, data, policy) for name in names}
        blocks = {
            name: lambda _, bench=bench: bench.seconds(arguments.steps) for name, bench in benches.items()
        }
        rounds = take_turns(blocks, arguments.rounds, generator)
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
    write_results("step_time", result)
    for name, ratio in sorted({LIMIT: limit, **ratios}.items(), key=lambda item: item[1]["median_ratio"]):
        print(f"{name:24} {ratio['median_ratio']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]")


if __name__ == "__main__":
    main()
