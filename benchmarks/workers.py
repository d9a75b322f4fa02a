"""Gain from a second worker, and cost of Ray: `python benchmarks/workers.py`.

One worker, one worker per core and a Ray cluster on this machine take turns at the same runs: methods whose
runs take about as long as one of plain fine-tuning, on the first target. A first round puts everything that
the runs need into the cache, and does not count. The cluster, and in each of its workers the process that has
imported everything, start before the clock; the time of the start is reported separately. The records must be
equal except for their times.
"""

from __future__ import annotations

import argparse
import functools
import io
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from ratios import median_ratio, take_turns
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
from clbench.worlds.threads import cores

METHODS = ("sft", "l2_sp", "stop_gradient", "constant_weight")


def main() -> None:
    """Measure, print the ratios and write results/workers.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scenario", default="clbench/Fetch-v1")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--workers", type=int, default=cores())
    arguments = parser.parse_args()
    count = arguments.workers
    specs = [RunSpec(arguments.scenario, name, 0, split="validation", targets=1) for name in METHODS]
    ways: dict[str, Callable[[], Workers]] = {
        "one worker": lambda: Processes(1),
        f"{count} workers": lambda: Processes(count),
        f"Ray, {count} workers": lambda: RayWorkers("local", count),
    }
    starts: dict[str, list[float]] = {way: [] for way in ways}
    found: list[list[dict[str, Any]]] = []

    def seconds(way: str, number: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            start, taken = _seconds(specs, Path(folder), ways[way])
            found.append(_outcomes(specs, Path(folder)))
        assert found[-1] == found[0], "the records differ"
        starts[way].append(start)
        print(f"round {number}: {way} {taken:.0f} s")
        return taken

    generator = np.random.default_rng(0)
    rounds = take_turns({way: functools.partial(seconds, way) for way in ways}, arguments.rounds, generator)
    one, many, ray = ways
    result = {
        "runs": len(specs),
        "workers": count,
        "rounds": arguments.rounds,
        "seconds": {way: round(float(np.median([taken[way] for taken in rounds])), 1) for way in ways},
        "seconds_to_start": {way: round(float(np.median(starts[way][1:])), 1) for way in ways},
        "one_worker_to_many": median_ratio([taken[one] / taken[many] for taken in rounds], generator),
        "ray_to_many": median_ratio([taken[ray] / taken[many] for taken in rounds], generator),
    }
    write_results("workers", result)
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
