"""The forecast of a command: the time from the lengths of its jobs, the disk from what they keep."""

import dataclasses
import itertools
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from eager import EAGER
from tiny import TINY

from clbench.jobs import forecast as module
from clbench.jobs import work
from clbench.jobs.forecast import STEPS, forecast, step_seconds
from clbench.jobs.job import Job
from clbench.learning.pretraining import policy_config
from clbench.policy.transformer import TransformerPolicy
from clbench.runs.spec import RunSpec
from clbench.testing.seen_toy import SEEN_TOY


def _plan(*jobs: Job) -> Any:
    """Return a plan, as far as a forecast reads it."""
    return types.SimpleNamespace(jobs=jobs)


def _job(function: Any, length: float, pace: float = 1.0) -> Job:
    return Job("a job", function, {"scenario": TINY.id}, length, pace=pace)


RUNS = [RunSpec(TINY.id, "sft", seed).resolve() for seed in range(2)]


@pytest.mark.parametrize(
    ("length", "workers", "words"),
    [
        (18_000, 1, "about 54 minutes with 1 at once"),  # 3 jobs, one at half of the pace: 2.5 x 18,000 steps
        (18_000, 2, "about 27 minutes with 2 at once"),
        (18_000, 8, "about 22 minutes with 3 at once"),  # there are three jobs, and the longest takes 22
        (29_000, 1, "about 87 minutes with 1 at once"),
        (31_000, 1, "about 1.6 hours with 1 at once"),
    ],
)
def test_the_time_is_that_of_all_jobs_shared_by_the_workers(
    length: float, workers: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda _: 0.072)
    jobs = [_job(work.do_run, length), _job(work.pretrain, length), _job(work.do_run, length, 0.5)]
    _, time, _ = forecast(_plan(*jobs), RUNS, workers, None)
    assert time == f"Time: {words}, at 72 ms for an optimiser step here."


def test_the_time_of_runs_on_a_gpu_is_said_to_be_that_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda _: 0.06)
    runs = [RunSpec(TINY.id, "sft", 0, device="cuda").resolve()]
    _, time, _ = forecast(_plan(_job(work.do_run, 1000)), runs, 1, None)
    assert time == "Time: about 1 minute with 1 at once, at 60 ms for an optimiser step on this CPU."


def test_it_is_said_that_stages_may_end_early_if_those_of_one_scenario_may(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda _: 0.06)
    for runs, early in ((RUNS, False), ([*RUNS, RunSpec(EAGER.id, "sft", 0).resolve()], True)):
        _, time, _ = forecast(_plan(_job(work.do_run, 1000)), runs, 1, None)
        assert ("; a stage ends as soon as its target is learned" in time) == early


def test_more_workers_do_not_shorten_the_longest_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda _: 0.06)
    pretraining = _job(work.pretrain, 3000)
    runs = [Job("a run", work.do_run, {}, 1000 * (1 + number), (pretraining,)) for number in range(4)]
    _, time, _ = forecast(_plan(pretraining, *runs), RUNS, 16, None)
    # 3,000 and then 4,000 steps of 60 ms; all 13,000 on the five workers that have a job take 2.6 minutes
    assert time == "Time: about 7 minutes with 5 at once, at 60 ms for an optimiser step here."


@pytest.mark.parametrize(
    ("own", "minutes"),
    [
        (0.6, 10 + 100 + 100 + 100),  # a slow policy does not slow the simulator down that collects data
        (0.006, 10 + 1 + 1 + 10),  # a fast one does not speed its episodes up
    ],
)
def test_the_simulator_takes_as_long_whatever_the_policy(
    own: float, minutes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda scenario: 0.06 if scenario.policy == "flow" else own)
    functions = (work.collect_demonstrations, work.pretrain, work.make_policies, work.do_run)
    jobs = [_job(function, 10_000) for function in functions]
    runs = [RunSpec(TINY.id, "sft", 0, policy="discrete_diffusion").resolve()]
    _, time, _ = forecast(_plan(*jobs), runs, 1, None)
    hours = f"{minutes / 60:.1f} hours"
    words = hours if minutes >= 90 else f"{minutes} minutes"
    assert time == f"Time: about {words} with 1 at once, at {1000 * own:.0f} ms for an optimiser step here."


def test_the_disk_is_that_of_policies_demonstrations_and_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda _: 0.1)
    weights = TransformerPolicy(policy_config(TINY)).parameters()
    bytes_of_policy = sum(weight.nbytes for weight in weights)
    # 4 demonstrations of 5 tasks of at most 12 steps; each has a state of 4 numbers, three actions of 2, and
    # four numbers more
    demonstrations = 4 * 5 * 12 * 4 * (4 + 3 * 2 + 4)
    jobs = [_job(work.pretrain, 1), _job(work.pretrain, 1), *(_job(work.do_run, 1) for _ in range(3))]
    to_do, _, disk = forecast(_plan(*jobs), RUNS, 8, Path("kept"))
    assert to_do == "To do: 2 policies to pretrain, 3 runs."
    made, kept = 2 * bytes_of_policy + demonstrations, 2 * 3 * bytes_of_policy  # after 0, 1 and 2 targets
    meanwhile = (
        2 * 2 * bytes_of_policy
    )  # of each run the checkpoint of a stage, and for a moment the one before
    sizes = (made, meanwhile, kept)
    words = [f"{count / 1e3:.0f} kB" if count < 1e6 else f"{count / 1e6:.0f} MB" for count in sizes]
    assert disk == (
        f"Disk: up to {words[0]} in the caches, {words[1]} more while runs go on, 300 kB of records, "
        f"{words[2]} of policies in kept."
    )


def test_the_disk_holds_the_pictures_of_demonstrations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "step_seconds", lambda _: 0.1)
    run = RunSpec("clbench.testing.seen_toy:clbench/SeenToy-v0", "sft", 0).resolve()
    more = dataclasses.replace(SEEN_TOY.retained[0], name="more")
    scenario = dataclasses.replace(run.scenario, background=(more,))
    runs = [dataclasses.replace(run, scenario=scenario)]
    _, _, disk = forecast(_plan(_job(work.do_run, 1)), runs, 1, None)
    config, steps = policy_config(SEEN_TOY), sum(task.horizon for task in (*SEEN_TOY.tasks, more))
    numbers = 4 * (config.state_size + 3 * config.action_size + 4)
    data = (numbers + 3 * config.image_size**2) * SEEN_TOY.budget.demonstrations * steps
    assert disk.startswith(f"Disk: up to {data / 1e3:.0f} kB in the caches")


def test_the_time_of_a_step_is_the_median_without_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = [100.0, *(float(number) for number in range(1, STEPS + 1))]
    clock = itertools.accumulate(taken)  # the clock is read at the end of each step
    monkeypatch.setattr(module, "time", types.SimpleNamespace(perf_counter=lambda: next(clock)))
    assert step_seconds(TINY) == (1 + STEPS) / 2


def test_the_step_of_a_scenario_without_targets_is_timed_and_the_threads_stay_as_they_are() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        assert step_seconds(dataclasses.replace(TINY, target=())) > 0
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
