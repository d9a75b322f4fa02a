"""Workers of a Ray cluster: each job is a task, and what a lost worker had under way is done again."""

from __future__ import annotations

import logging
import os
import shutil
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from clbench.base.cache import cache_folder, hash_of
from clbench.base.dependencies import require
from clbench.base.errors import UnknownNameError
from clbench.jobs.job import Event, Job
from clbench.jobs.processes import Processes
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record

RETRIES = 3
"""How often a job begins again after its worker was lost. A run goes on with its last finished stage."""

_INSTRUCTIONS = (
    "ATEN_CPU_CAPABILITY",
    "ONEDNN_MAX_CPU_ISA",
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
)
"""What decides which of its instructions a processor uses, and so the bits of what is trained."""
_PASSED_ON = ("CLBENCH_CACHE", "MINARI_DATASETS_PATH", "MUJOCO_GL", *_INSTRUCTIONS)


class LostProcessError(Exception):
    """The process of a job ended and said nothing: it was killed, perhaps for want of memory."""


class RayWorkers:
    """Workers of a Ray cluster.

    A worker has one processor core, and a GPU if its job computes on one. Records come back to who asked and
    are written here. What is made first, demonstrations and pretrained policies, stays in the cache of the
    node: nodes that share a file system share it by `CLBENCH_CACHE`, others make it once each.

    Args:
        address: "local" starts Ray on this machine, "auto" finds one that runs, else as `ray.init` takes it.
        count: How many jobs are under way at once; one for each core of the cluster if None.

    Raises:
        LookupError: Ray is not installed, or no cluster answers at the address.
    """

    def __init__(self, address: str, count: int | None = None) -> None:
        require("ray", "ray", "--ray")
        import ray

        self._ray: Any = ray
        self._count = count
        options: dict[str, Any] = {"runtime_env": {"env_vars": _environment()}}
        if address == "local":
            # else they are nicer, by 15, than whatever else runs on this machine
            options |= {
                "_system_config": {"worker_niceness": 0},
                "num_cpus": count,
                "include_dashboard": False,
            }
        try:
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **options)
        except ConnectionError as error:
            raise UnknownNameError(
                f"No Ray cluster answers at {address!r}; --ray local starts one."
            ) from error
        self._progress_actor: Any = ray.remote(num_cpus=0)(_ProgressActor).remote()
        self._running: dict[Any, Job] = {}
        self._shown: defaultdict[Job, float] = defaultdict(float)

    def free(self) -> int:
        """Return how many more jobs can be under way."""
        cores = int(self._ray.cluster_resources().get("CPU", 0))
        return min(self._count or cores, cores) - len(self._running)

    def start(self, job: Job) -> None:
        """Begin a job as a task of the cluster."""
        gpus = 0 if job.device == "cpu" else 1
        options = {"max_retries": RETRIES, "retry_exceptions": [LostProcessError]}
        task = self._ray.remote(num_cpus=1, num_gpus=gpus, **options)(_do)
        arguments = {
            name: value.absolute() if isinstance(value, Path) else value
            for name, value in job.arguments.items()
        }
        self._running[task.remote(self._progress_actor, replace(job, arguments=arguments, needs=()))] = job

    def events(self) -> Iterator[Event]:
        """Give what was told since the last call; wait for it, but no longer than a second."""
        if not self._running:  # the cluster has no cores yet
            time.sleep(1.0)
            return
        ended, _ = self._ray.wait(list(self._running), num_returns=1, timeout=1.0)
        done = self._ray.get(self._progress_actor.amounts.remote())
        for job in self._running.values():
            amount = done.get(job.title, 0.0) - self._shown[job]
            self._shown[job] += amount
            if amount:  # less than nothing after a worker was lost
                yield Event(job, "progress", amount)
        for reference in ended:
            job = self._running.pop(reference)
            yield Event(job, *self._end(job, reference))

    def close(self) -> None:
        """End all tasks, and Ray if it was started here."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._running.clear()
        self._ray.shutdown()

    def _end(self, job: Job, reference: Any) -> tuple[Literal["done", "failed"], str]:
        """Write the records of a job that ended, and return how it did."""
        lost = f"its worker was lost {RETRIES + 1} times: "
        try:
            result: _Result = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, LostProcessError):
                return "failed", f"{lost}{error.cause}"
            return "failed", f"its worker could not do it: {str(error).strip().splitlines()[-1]}"
        except self._ray.exceptions.RayError as error:
            first = str(error).strip().partition("\n")[0]
            return "failed", f"{lost}{type(error).__name__}: {first}"
        for path, record in result.records.items():
            write_record(record, job.arguments["records"] / path)
        return result.kind, result.value


class _Result(NamedTuple):
    """What a task returns."""

    kind: Literal["done", "failed"]
    value: str
    records: dict[str, Record]
    """By their path below the folder of records."""


class _ProgressActor:
    """Keeps how much of each job is done: an actor, which tasks tell and the driver asks."""

    def __init__(self) -> None:
        self._amounts: dict[str, float] = {}

    def begin(self, name: str) -> None:
        """Begin a job, perhaps again."""
        self._amounts[name] = 0.0

    def add(self, name: str, amount: float) -> None:
        """Add to what is done."""
        self._amounts[name] += amount

    def amounts(self) -> dict[str, float]:
        """Return how much of each job is done."""
        return self._amounts


def _do(actor: Any, job: Job) -> _Result:
    """Do a job on a node of the cluster. Its records are returned: the node may not see their folder."""
    actor.begin.remote(job.title)
    if "records" not in job.arguments:
        return _Result(*_do_apart(actor, job), {})
    # the same on every attempt, for it is part of what a run goes on by
    folder = cache_folder() / "ray" / hash_of([job.title, str(job.arguments["records"])])
    shutil.rmtree(folder, ignore_errors=True)
    ended = _do_apart(actor, replace(job, arguments=job.arguments | {"records": folder}))
    found = sorted(folder.rglob("*.json"))
    records = {path.relative_to(folder).as_posix(): read_record(path) for path in found}
    shutil.rmtree(folder, ignore_errors=True)
    return _Result(*ended, records)


def _do_apart(actor: Any, job: Job) -> tuple[Literal["done", "failed"], str]:
    """Do a job in a process of its own, as on one machine: what a method leaves behind meets no other.

    It is forked from one that this worker keeps and that has imported all; a worker for each job takes 5 s.

    Raises:
        LostProcessError: The process was killed.
    """
    # else the process reads the program of this one, which is Ray's, and imports Ray
    vars(sys.modules["__main__"]).pop("__file__", None)
    processes = Processes(1)
    processes.start(job)
    try:
        while True:
            for _, kind, value in processes.events():
                if kind == "progress":
                    actor.add.remote(job.title, value)
                elif kind == "lost":
                    raise LostProcessError(value)
                else:
                    return kind, value
    finally:
        processes.close()


def _environment() -> dict[str, str]:
    """Return what workers need to find the same modules and caches as this process."""
    installed = (sys.prefix, sys.base_prefix)
    paths = [path for path in sys.path if path and not path.startswith(installed)]
    passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    return {"PYTHONPATH": os.pathsep.join(paths), **passed_on}
