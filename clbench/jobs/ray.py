"""Workers of a Ray cluster: each job is a task, and the job of a lost worker is done again."""

from __future__ import annotations

import logging
import os
import shutil
import site
import socket
import sys
import sysconfig
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from clbench.base.cache import cache_folder, hash_of
from clbench.base.dependencies import require
from clbench.base.errors import ClbenchError, InputError, UnknownNameError
from clbench.jobs.folders import absolute_places
from clbench.jobs.job import Event, Job, Outcome
from clbench.jobs.processes import Processes
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_result

RETRIES = 3
"""How often a job starts again after its worker was lost. A run continues from its last finished stage."""

_INSTRUCTIONS = (
    "ATEN_CPU_CAPABILITY",
    "ONEDNN_MAX_CPU_ISA",
    "MKL_ENABLE_INSTRUCTIONS",
    "MKL_CBWR",
    "OPENBLAS_CORETYPE",
    "NPY_DISABLE_CPU_FEATURES",
)
"""Variables that select the instructions of the processor, and so affect the bits of trained weights."""
_PASSED_ON = ("MUJOCO_GL", *_INSTRUCTIONS)
_PATIENCE = 10.0
"""Seconds within which the machine of a cluster must accept a connection."""


class LostProcessError(Exception):
    """The process of a job ended without a result: it was killed, perhaps because memory ran out."""


class RayWorkers:
    """Workers of a Ray cluster.

    A worker has one processor core, and a GPU if its job computes on one. Records return to the driver, which
    writes them. Demonstrations and pretrained policies stay in the cache of the node: nodes with a common
    file system share them through `CLBENCH_CACHE`, other nodes make them once each.

    Args:
        address: "local" starts Ray on this machine, "auto" finds a running cluster; other addresses are
            passed to `ray.init`.
        count: Number of jobs that run at once; one per core of the cluster if None.

    Raises:
        MissingPackageError: Ray is not installed.
        InputError: The address has another form.
        UnknownNameError: No cluster answers at the address.
    """

    def __init__(self, address: str, count: int | None = None) -> None:
        require("ray", "ray", "--ray")
        import ray

        if not _answers(address):
            raise _no_cluster(address)
        self._ray: Any = ray
        self._count = count
        options: dict[str, Any] = {"runtime_env": {"env_vars": _environment()}}
        if address == "local":
            # otherwise the workers, at a niceness of 15, yield to all other work on this machine
            options |= {
                "_system_config": {"worker_niceness": 0},
                "num_cpus": count,
                "include_dashboard": False,
            }
        try:
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, **options)
        except ValueError as error:
            raise InputError(f"--ray must be auto, local or host:port, not {address!r}.") from error
        except (ConnectionError, RuntimeError) as error:
            raise _no_cluster(address) from error
        except Exception as error:  # Ray has no class for "The current node timed out during startup"
            raise ClbenchError(f"Ray did not start at {address!r}: {error}") from error
        self._progress_actor: Any = ray.remote(num_cpus=0)(_ProgressActor).remote()
        self._running: dict[Any, Job] = {}
        self._shown: defaultdict[Job, float] = defaultdict(float)

    def free(self) -> int:
        """Return the number of jobs that can start now."""
        cores = int(self._ray.cluster_resources().get("CPU", 0))
        return max(0, min(self._count or cores, cores) - len(self._running))

    def start(self, job: Job) -> None:
        """Start a job as a task of the cluster."""
        gpus = 0 if job.device == "cpu" else 1
        options = {"max_retries": RETRIES, "retry_exceptions": [LostProcessError]}
        task = self._ray.remote(num_cpus=1, num_gpus=gpus, **options)(_do)
        self._running[task.remote(self._progress_actor, job.bare())] = job

    def events(self) -> Iterator[Event]:
        """Yield the events since the last call; wait at most a second for one."""
        ended, _ = self._ray.wait(list(self._running), num_returns=1, timeout=1.0)
        done = self._amounts()
        for job in self._running.values():
            amount = done.get(job.title, self._shown[job]) - self._shown[job]
            self._shown[job] += amount
            if amount:  # negative after a worker was lost
                yield Event(job, "progress", amount)
        for reference in ended:
            job = self._running.pop(reference)
            self._shown.pop(job, None)  # it may start again
            yield Event(job, *self._end(job, reference))

    def _amounts(self) -> dict[str, float]:
        """Return the progress of each job; empty if its actor is lost, and the jobs go on without bars."""
        try:
            found: dict[str, float] = self._ray.get(self._progress_actor.amounts.remote())
        except self._ray.exceptions.RayError:
            return {}
        return found

    def close(self) -> None:
        """End all tasks, and Ray if it was started here."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._running.clear()
        self._ray.shutdown()

    def _end(self, job: Job, reference: Any) -> tuple[Outcome, str]:
        """Write the records of a job that ended, and return its outcome."""
        lost = f"its worker was lost {RETRIES + 1} times: "
        try:
            result: _Result = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, LostProcessError):
                return "failed", f"{lost}{error.cause}"
            return "failed", f"its worker could not run it: {str(error).strip().splitlines()[-1]}"
        except self._ray.exceptions.RayError as error:
            first = str(error).strip().partition("\n")[0]
            return "failed", f"{lost}{type(error).__name__}: {first}"
        try:
            for path, record in result.records.items():
                write_result(record, job.arguments["records"] / path)
        except (ClbenchError, OSError) as error:  # the other jobs go on
            return "failed", f"its record cannot be written: {error}"
        return result.kind, result.value


def _answers(address: str) -> bool:
    """Return False if the address has a host and a port where nothing listens: Ray would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        return True
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE).close()
    except OSError:
        return False
    return True


def _no_cluster(address: str) -> UnknownNameError:
    return UnknownNameError(f"No Ray cluster answers at {address!r}; --ray local starts one.")


class _Result(NamedTuple):
    """The result of a task."""

    kind: Outcome
    value: str
    records: dict[str, Record]
    """Records by their path below the folder of records."""


class _ProgressActor:
    """An actor that keeps the progress of each job: tasks report to it, and the driver reads it."""

    def __init__(self) -> None:
        self._amounts: dict[str, float] = {}

    def begin(self, name: str) -> None:
        """Set the progress of a new or restarted job to 0."""
        self._amounts[name] = 0.0

    def add(self, name: str, amount: float) -> None:
        """Add to the progress of a job."""
        self._amounts[name] += amount

    def amounts(self) -> dict[str, float]:
        """Return the progress of each job."""
        return self._amounts


def _do(actor: Any, job: Job) -> _Result:
    """Do a job on a node of the cluster, and return its records: the node may lack access to their folder."""
    actor.begin.remote(job.title)
    if "records" not in job.arguments:
        return _Result(*_do_apart(actor, job), {})
    # the same folder on every attempt: a run finds its checkpoints by it
    folder = cache_folder() / "ray" / hash_of([job.title, str(job.arguments["records"])])
    shutil.rmtree(folder, ignore_errors=True)
    ended = _do_apart(actor, replace(job, arguments=job.arguments | {"records": folder}))
    found = sorted(folder.rglob("*.json"))
    records = {path.relative_to(folder).as_posix(): read_record(path) for path in found}
    shutil.rmtree(folder, ignore_errors=True)
    return _Result(*ended, records)


def _do_apart(actor: Any, job: Job) -> tuple[Outcome, str]:
    """Do a job in its own process, as on one machine, so that no method affects another.

    The process is forked from one that this worker keeps and that has imported everything; a new worker for
    each job would take 5 s.

    Raises:
        LostProcessError: The process was killed.
    """
    processes = Processes(1)
    processes.start(job)
    try:
        while True:
            for _, kind, value in processes.events():
                if kind == "progress":
                    actor.add.remote(job.title, value)
                elif kind == "at":
                    continue
                elif kind == "lost":
                    raise LostProcessError(value)
                else:
                    return kind, value
    finally:
        processes.close()


def _environment() -> dict[str, str]:
    """Return the environment in which workers find the same modules and caches as this process."""
    own = [*map(sysconfig.get_path, ("stdlib", "platstdlib")), *site.getsitepackages()]
    paths = [
        path for path in sys.path if os.path.isdir(path) and not any(map(Path(path).is_relative_to, own))
    ]
    passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    return {"PYTHONPATH": os.pathsep.join(paths), **passed_on, **absolute_places()}
