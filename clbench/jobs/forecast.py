"""What a command would do: its jobs, with the time and the disk to expect."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import torch

from clbench.base.text import counted
from clbench.jobs import work
from clbench.jobs.job import Job, chain_times
from clbench.jobs.plan import Plan
from clbench.learning.optimise import optimise
from clbench.learning.pretraining import policy_config
from clbench.policy.batch import Batch
from clbench.policy.kinds import new_policy
from clbench.runs.spec import ResolvedRun
from clbench.spec.language import encode
from clbench.spec.policies import DEFAULT_POLICY
from clbench.spec.scenario import Scenario

STEPS = 8
"""Optimiser steps that are timed."""

RECORD_BYTES = 100_000
"""Bytes of a record: the largest of the board has 97,000, those of Fetch-v1 have at most 70,000."""

KINDS = {
    work.collect_demonstrations: ("dataset to collect or read", "datasets to collect or read"),
    work.collect_scenes: ("set of questions to collect or read", "sets of questions to collect or read"),
    work.pretrain: ("policy to pretrain", "policies to pretrain"),
    work.evaluate_policy: ("pretrained policy to evaluate", "pretrained policies to evaluate"),
    work.do_run: ("run", "runs"),
    work.make_policies: ("run to train again for its policies", "runs to train again for their policies"),
}
"""Words for one job of a kind, and for several jobs. A plan does not know which data are in the cache."""


def forecast(plan: Plan, runs: Sequence[ResolvedRun], workers: int, checkpoints: Path | None) -> list[str]:
    """Return lines that say what a plan would do on this machine.

    Args:
        plan: The plan of the runs.
        runs: The runs, of one scenario or of several.
        workers: Number of jobs that run at once.
        checkpoints: Folder that would keep the policies of all stages, or None.
    """
    counts = Counter(KINDS[job.function] for job in plan.jobs)
    scenarios = {run.spec.scenario: run.scenario for run in runs}
    to_do = ", ".join(counted(count, *words) for words, count in counts.items())
    return [
        f"To do: {to_do}.",
        _time(plan.jobs, runs, list(scenarios.values()), workers),
        _disk(plan.jobs, runs, scenarios, workers, checkpoints),
    ]


def _time(
    jobs: Sequence[Job], runs: Sequence[ResolvedRun], scenarios: Sequence[Scenario], at_once: int
) -> str:
    defaults = [one.with_policy(DEFAULT_POLICY) for one in scenarios]
    times = {one: step_seconds(one) for one in dict.fromkeys([*scenarios, *defaults])}  # often the same
    slowest, usual = (max(times[one] for one in some) for some in (scenarios, defaults))
    at_once = min(at_once, len(jobs))

    def seconds_of(job: Job) -> float:
        # lengths are in steps of the default policy, and no policy changes the time of a simulator
        if job.function in (work.collect_demonstrations, work.collect_scenes):
            return job.duration * usual
        trains = job.function in (work.pretrain, work.make_policies)
        return job.duration * (slowest if trains else max(slowest, usual))

    # a run waits for its policy, and the policy for demonstrations, however many workers there are
    longest = max(chain_times(jobs, seconds_of).values())
    seconds = max(sum(map(seconds_of, jobs)) / at_once, longest)
    early = any(scenario.budget.criterion for scenario in scenarios)
    place = "here" if all(run.spec.device == "cpu" for run in runs) else "on this CPU"
    return (
        f"Time: about {_duration(seconds)} with {at_once} at once, at "
        f"{1000 * slowest:.0f} ms for an optimiser step {place}"
        f"{'; a stage ends as soon as its target is learned' if early else ''}."
    )


def _disk(
    jobs: Sequence[Job],
    runs: Sequence[ResolvedRun],
    scenarios: Mapping[str, Scenario],
    at_once: int,
    checkpoints: Path | None,
) -> str:
    policies = {name: _policy_bytes(scenario) for name, scenario in scenarios.items()}
    made = sum(map(_data_bytes, scenarios.values()))
    made += sum(policies[job.arguments["scenario"]] for job in jobs if job.function is work.pretrain)
    records = RECORD_BYTES * sum(job.function is work.do_run for job in jobs)
    # the next checkpoint is written before the last one is removed; a method's state is not counted
    meanwhile = 2 * min(at_once, len(runs)) * max(policies.values())
    parts = [
        f"up to {_megabytes(made)} in the caches",
        f"{_megabytes(meanwhile)} more while runs go on",
        f"{_megabytes(records)} of records",
    ]
    if checkpoints:
        kept = sum(policies[run.spec.scenario] * (len(run.scenario.target) + 1) for run in runs)
        parts.append(f"{_megabytes(kept)} of policies in {checkpoints}")
    return f"Disk: {', '.join(parts)}."


def step_seconds(scenario: Scenario) -> float:
    """Return the time of an optimiser step of plain fine-tuning here, in seconds, on one CPU thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        config, size = policy_config(scenario), scenario.budget.batch_size
        policy = new_policy(config)
        chunk = (size, config.chunk, config.action_size)
        batch = Batch(
            state=torch.randn(size, config.state_size),
            words=encode(scenario.tasks[0].instructions[:1] * size, scenario.text_length),
            action=torch.randn(chunk),
            valid=torch.ones(chunk[:2]),
            draw=torch.rand(size),
            noise=torch.randn(chunk),
            image=torch.zeros((size, config.image_size, config.image_size, 3), dtype=torch.uint8),
        )
        ends: list[float] = []
        optimise(
            policy.parameters(),
            scenario.budget.learning_rate,
            STEPS + 1,
            lambda _: policy.action_loss(batch).mean(),
            after=lambda _: ends.append(time.perf_counter()),
        )
    finally:
        torch.set_num_threads(threads)
    return statistics.median(end - begin for begin, end in pairwise(ends))


def _policy_bytes(scenario: Scenario) -> int:
    return 4 * sum(parameter.numel() for parameter in new_policy(policy_config(scenario)).parameters())


def _data_bytes(scenario: Scenario) -> int:
    """Return the bytes that demonstrations and their pictures take at most, with episodes of full length."""
    config = policy_config(scenario)
    step = 4 * (config.state_size + 3 * config.action_size + 4) + 3 * config.image_size**2
    tasks = scenario.tasks + scenario.background
    return step * scenario.budget.demonstrations * sum(task.horizon for task in tasks)


def _duration(seconds: float) -> str:
    minutes = counted(max(1, round(seconds / 60)), "minute")
    return minutes if seconds < 5400 else f"{seconds / 3600:.1f} hours"


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.0f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"
