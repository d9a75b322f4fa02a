"""Time and memory of a whole run, by its parts: `python benchmarks/whole_run.py ID`.

It times one run of plain fine-tuning with one thread, as in `clbench run` where other runs need all other
cores, with its data and its pretrained policy in the cache. Clocks measure the physics, the pictures and the
policy of all evaluations and checks; training is the time of the stages' loops without them. All else is
other: reading files, questions, probes of the policy, checkpoints, and the optimiser steps of relearning. The
current speed of the machine is given too: matrix products of a policy's size, in GFLOPS, before and after.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from result_files import write_row
from rich.progress import Progress

from clbench.base.cache import cache_folder
from clbench.cli.arguments import checked_input
from clbench.data.demonstrations import load_demonstrations
from clbench.data.questions import load_questions
from clbench.learning.pretraining import pretrained_policy
from clbench.policy.kinds import policy_class
from clbench.runs.length import run_length
from clbench.runs.run import execute
from clbench.runs.spec import ResolvedRun, RunSpec
from clbench.spec.policies import kind_of
from clbench.worlds.lanes import Lanes

PARTS = {
    "physics": (Lanes, ("step", "reset")),
    "pictures": (Lanes, ("observe",)),
}


def main() -> None:
    """Measure, print a table and write results/whole_run.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenario", help="one per process, because the memory is the whole process's")
    parser.add_argument("--method", default="sft")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    run = RunSpec(arguments.scenario, arguments.method, arguments.seed).resolve()
    spec, scenario = run.spec, run.scenario
    policy, _ = pretrained_policy(scenario, spec.seed)
    for task in scenario.target:
        load_demonstrations(task, scenario, policy.config)
    load_questions(scenario)
    with _cache_without_reports():
        found = measure(run)
    write_row("whole_run", "runs", spec.scenario, found)
    print(f"{spec.scenario}, {spec.method}: {found['seconds']:.0f} s, {found['peak_memory_gb']:.2f} GB")
    for part, seconds in found["parts"].items():
        print(f"  {part:10} {seconds:6.1f} s, {seconds / found['seconds']:4.0%}")


@contextmanager
def _cache_without_reports() -> Iterator[None]:
    """Hide the evaluations before the first target that other runs cached: the run would reuse them."""
    with tempfile.TemporaryDirectory() as folder:
        for kept in cache_folder().iterdir():
            if kept.name != "reports":
                (Path(folder) / kept.name).symlink_to(kept)
        before = os.environ.get("CLBENCH_CACHE")
        os.environ["CLBENCH_CACHE"] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ["CLBENCH_CACHE"]
            else:
                os.environ["CLBENCH_CACHE"] = before


def measure(run: ResolvedRun) -> dict[str, Any]:
    """Return the duration of a run and of its parts."""
    clocks: defaultdict[str, float] = defaultdict(float)
    steps = _counted_steps()
    # each kind of policy has its own `act`
    timed = {**PARTS, "policy": (policy_class(kind_of(run.scenario.policy)), ("act",))}
    for part, (owner, names) in timed.items():
        for name in names:
            setattr(owner, name, _clocked(getattr(owner, name), clocks, part))
    speeds = [_gigaflops()]
    with tempfile.TemporaryDirectory() as records, Progress(transient=True) as bars:
        bar = bars.add_task(run.scenario.id, total=run_length(run.scenario, run.protocol))
        begin = time.perf_counter()
        record = execute(run, Path(records), lambda amount: bars.advance(bar, amount))
        seconds = time.perf_counter() - begin
    speeds.append(_gigaflops())
    training = sum(stage["training"] for stage in record.timing["stages"])
    parts = {"training": training, **{part: clocks[part] for part in timed}}
    parts["other"] = seconds - sum(parts.values())
    return {
        "method": run.spec.method,
        "seconds": round(seconds, 1),
        "parts": {part: round(value, 1) for part, value in parts.items()},
        "environment_steps": sum(steps),
        "optimiser_steps": record.costs.optimiser_steps,
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "gigaflops": [round(speed, 1) for speed in speeds],
    }


def _counted_steps() -> list[int]:
    """Return a list to which each step from now on adds its number of environments.

    The lengths of a record's episodes are not enough: checks of a criterion take steps, too.
    """
    steps: list[int] = []
    step = Lanes.step

    def counted(self: Lanes, lanes: Sequence[int], actions: Any) -> Any:
        steps.append(len(lanes))
        return step(self, lanes, actions)

    Lanes.step = counted  # type: ignore[method-assign]
    return steps


def _clocked(function: Callable[..., Any], clocks: defaultdict[str, float], part: str) -> Callable[..., Any]:
    def timed(*arguments: Any, **options: Any) -> Any:
        begin = time.perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            clocks[part] += time.perf_counter() - begin

    return timed


def _gigaflops() -> float:
    """Return the speed of one thread at matrix products (1088, 96) x (96, 192), a layer of the policy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    left, right = torch.randn(1088, 96), torch.randn(96, 192)
    times = []
    for _ in range(500):
        begin = time.perf_counter()
        torch.mm(left, right)
        times.append(time.perf_counter() - begin)
    torch.set_num_threads(threads)
    return 2 * 1088 * 96 * 192 / sorted(times)[len(times) // 2] / 1e9


if __name__ == "__main__":
    with checked_input():
        main()
