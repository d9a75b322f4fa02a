"""Gain from a second worker, and cost of Ray: `python benchmarks/workers.py`.

One worker, one worker per core and a Ray cluster on this machine take turns at the same runs: methods that
take as long as plain fine-tuning, on the first target. Everything that the runs need is in the cache before.
The cluster, and the process of each of its workers that has imported everything, start before the clock; the
time of the start is reported separately. The records must be equal except for their times.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from ratios import median_ratio
from result_files import write_results
from rich.console import Console

from clbench.jobs.job import Job, Workers
from clbench.jobs.plan import Plan
from clbench.jobs.processes import Processes
from clbench.jobs.ray import RayWorkers
from clbench.jobs.scheduler import run_with_bars
from clbench.jobs.work import collect_scenes
from clbench.records.reader import read_record
from clbench.runs.spec import RunSpec

METHODS = ("sft", "l2_sp", "stop_gradient", "constant_weight")


def main() -> None:
    """Measure, print the ratios and write results/workers.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenario", default="clbench/Fetch-v1")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    count = arguments.workers
    specs = [RunSpec(arguments.scenario, name, 0, split="validation", targets=1) for name in METHODS]
    ways: dict[str, Callable[[], Workers]] = {
        "one worker": lambda: Processes(1),
        f"{count} workers": lambda: Processes(count),
        f"Ray, {count} workers": lambda: RayWorkers("local", count),
    }
    with tempfile.TemporaryDirectory() as folder:
        _seconds(specs, Path(folder), ways[f"{count} workers"])  # fills the cache
    rounds, starts, generator = [], [], np.random.default_rng(0)
    for number in range(arguments.rounds):
        started, taken, found = {}, {}, []
        for way in generator.permutation(list(ways)):
            with tempfile.TemporaryDirectory() as folder:
                started[str(way)], taken[str(way)] = _seconds(specs, Path(folder), ways[str(way)])
                found.append(_outcomes(specs, Path(folder)))
        assert all(outcomes == found[0] for outcomes in found), "the records differ"
        print(f"round {number + 1}:", ", ".join(f"{way} {seconds:.0f} s" for way, seconds in taken.items()))
        rounds.append(taken)
        starts.append(started)
    one, many, ray = ways
    result = {
        "runs": len(specs),
        "workers": count,
        "seconds": {way: round(float(np.median([taken[way] for taken in rounds])), 1) for way in ways},
        "seconds_to_start": {
            way: round(float(np.median([started[way] for started in starts])), 1) for way in ways
        },
        "one_worker_to_many": median_ratio([taken[one] / taken[many] for taken in rounds], generator),
        "ray_to_many": median_ratio([taken[ray] / taken[many] for taken in rounds], generator),
    }
    write_results("workers", arguments.scenario, result)
    print(json.dumps({name: result[name] for name in ("one_worker_to_many", "ray_to_many")}, indent=1))


def _seconds(specs: list[RunSpec], records: Path, make: Callable[[], Workers]) -> tuple[float, float]:
    """Return the time until the workers are ready, and the time of the runs after that, in seconds."""
    plan, begin = Plan(), time.perf_counter()
    for spec in specs:
        plan.add_run(spec.resolve(), records)
    workers = make()
    count, arguments = workers.free(), {"scenario": specs[0].scenario}
    for number in range(count):  # its result is in the cache: it takes only the time of the imports
        workers.start(Job(f"first job {number}", collect_scenes, arguments, 1))
    while workers.free() < count:
        assert all(event.kind in ("progress", "done") for event in workers.events())
    ready = time.perf_counter()
    failed = run_with_bars(plan.jobs, workers, Console(file=io.StringIO()))
    assert not failed, failed
    return ready - begin, time.perf_counter() - ready


def _outcomes(specs: list[RunSpec], records: Path) -> list[dict[str, Any]]:
    """Return the results in the records."""
    kept = (read_record(spec.path(records)) for spec in specs)
    return [{"episodes": one.episodes, "answers": one.answers, "policy": one.policy} for one in kept]


if __name__ == "__main__":
    main()
