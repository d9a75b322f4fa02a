"""The grid: many runs, each in its own process with one thread, on all cores."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from rich.console import Console

from clbench.limits import Limits, end
from clbench.progress import Bars
from clbench.run import RunSpec, execute, run_length
from clbench.task import load_scenario, resolve
from clbench.training import MethodError

_SEND_SECONDS = 0.2
_LOOK_SECONDS = 0.5


class JobError(Exception):
    """A job came to a bad end that its message tells in full."""


@dataclass(frozen=True)
class Job:
    """A piece of work for one process."""

    name: str
    """What people see."""
    function: str
    """Entry point; called with the arguments and `progress`. What it returns, a text, is shown."""
    arguments: dict[str, Any]
    """By name."""
    length: float
    """In optimiser steps, for the time left."""
    needs: tuple[str, ...] = ()
    """Names of the jobs that must have ended well before."""
    limits: Limits | None = None
    """What its process may take; anything if None."""


@dataclass
class _Worker:
    job: Job
    process: BaseProcess
    connection: Connection
    started: float = field(default_factory=time.monotonic)
    looked: float = field(default_factory=time.monotonic)
    broken: str | None = None
    """Why its process was ended, if it was beyond a limit."""


def run_jobs(jobs: Sequence[Job], workers: int, bars: Bars) -> dict[str, str]:
    """Do all jobs, at most `workers` at once, and return what went wrong, by the name of the job.

    A job that fails, or whose process dies, does not stop the others; what needs it is left out. However this
    function is left, by Ctrl-C too, no process stays behind.
    """
    waiting, running = list(jobs), dict[Connection, _Worker]()
    ended: set[str] = set()
    failed: dict[str, str] = {}
    try:
        while waiting or running:
            waiting = _drop_hopeless(waiting, failed)
            for job in _ready(waiting, ended, workers - len(running)):
                waiting.remove(job)
                with _undisturbed():
                    worker = _start(job)
                    running[worker.connection] = worker
                bars.start(job.name, job.length)
            _hold_to_limits(running.values())
            for connection in wait(list(running), timeout=1.0):
                assert isinstance(connection, Connection)
                worker = running[connection]
                kind, value = _receive(worker)
                if kind == "progress":
                    bars.advance(worker.job.name, value)
                    continue
                del running[connection]
                worker.process.join()
                if kind == "failed":
                    failed[worker.job.name] = value
                else:
                    ended.add(worker.job.name)
                seconds = time.monotonic() - worker.started
                bars.finish(worker.job.name, f"{value} ({seconds:.0f} s)")
    finally:
        for worker in running.values():
            worker.process.terminate()
            worker.process.join()
    return failed


def run_with_bars(jobs: Sequence[Job], workers: int | None, console: Console | None = None) -> dict[str, str]:
    """Do all jobs as `run_jobs` does, with a bar for each, on all cores if `workers` is None."""
    with Bars(sum(job.length for job in jobs), console) as bars:
        return run_jobs(jobs, workers or os.cpu_count() or 1, bars)


def _hold_to_limits(workers: Iterable[_Worker]) -> None:
    """End the processes that are beyond their limits."""
    for worker in workers:
        limits, now = worker.job.limits, time.monotonic()
        if limits is None or worker.broken or now - worker.looked < _LOOK_SECONDS:
            continue
        worker.looked = now
        assert worker.process.pid is not None
        worker.broken = limits.exceeded(worker.process.pid, now - worker.started)
        if worker.broken:
            end(worker.process.pid)


def _drop_hopeless(waiting: list[Job], failed: dict[str, str]) -> list[Job]:
    """Return the jobs that can still be done; the others fail with what they needed."""
    kept = []
    for job in waiting:
        missing = [name for name in job.needs if name in failed]
        if missing:
            failed[job.name] = f"left out, because {missing[0]} failed"
        else:
            kept.append(job)
    return kept


def _ready(waiting: Sequence[Job], ended: set[str], free: int) -> list[Job]:
    """Return the jobs to start: those whose needs have ended, in their order."""
    return [job for job in waiting if ended.issuperset(job.needs)][:free]


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back inside: a start that is cut short leaves half a process behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    stops = (signal.SIGINT, signal.SIGTERM)
    before = {stop: signal.signal(stop, lambda number, _: held.append(number)) for stop in stops}
    try:
        yield
    finally:
        for stop, handler in before.items():
            signal.signal(stop, handler)
        for number in held[:1]:
            signal.raise_signal(number)


def _context() -> Any:
    """Return how processes are started: from one that has imported all once (50 ms), or anew (2 s)."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver  # cannot be imported where there is none

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["clbench.run"])
    if threading.current_thread() is threading.main_thread():
        # what it starts ignores Ctrl-C as it does: from the first instruction, not from `_work` on
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        forkserver.ensure_running()
        signal.signal(signal.SIGINT, before)
    return context


def _start(job: Job) -> _Worker:
    context = _context()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(
        target=_work, args=(theirs, job.function, job.arguments, dict(os.environ)), daemon=True
    )
    process.start()
    theirs.close()  # so that the end of the process is the end of the stream
    return _Worker(job, process, ours)


def _receive(worker: _Worker) -> tuple[str, Any]:
    try:
        kind, value = worker.connection.recv()
    except EOFError:
        worker.process.join()
        if worker.broken:
            return "failed", f"stopped, because {worker.broken}"
        return "failed", f"its process ended without a result (exit code {worker.process.exitcode})"
    return kind, value


def _work(
    connection: Connection, function: str, arguments: dict[str, Any], environment: dict[str, str]
) -> None:
    """Do one job in this process and send what comes of it."""
    os.environ.update(environment)  # the process that this one was forked from may have an older one
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which ends its workers
    owed, sent = 0.0, time.monotonic()

    def progress(amount: float) -> None:
        nonlocal owed, sent
        owed += amount
        if time.monotonic() - sent >= _SEND_SECONDS:
            try:
                connection.send(("progress", owed))
            except OSError:  # nobody listens any more: stop as if killed, so that the run can be resumed
                sys.exit(1)
            owed, sent = 0.0, time.monotonic()

    try:
        text = resolve(function)(**arguments, progress=progress)
        connection.send(("progress", owed))
        connection.send(("done", text))
    except JobError as error:
        connection.send(("failed", str(error)))
    except Exception as error:
        connection.send(("failed", f"{type(error).__name__}: {error}\n{traceback.format_exc()}"))


# ---- the jobs of a benchmark -----------------------------------------------------------------------


def collect_job(scenario: str, task: str, progress: Callable[[float], None]) -> str:
    """Collect the demonstrations of a task, unless they are in the cache."""
    from clbench.demonstrations import dataset_folder, read_dataset

    loaded = load_scenario(scenario)
    episodes = read_dataset(dataset_folder(loaded.task(task), loaded.budget, progress))
    return f"{len(episodes)} episodes, {sum(len(episode.executed) for episode in episodes)} steps"


def scenes_job(scenario: str, progress: Callable[[float], None]) -> str:
    """Collect the states that questions are asked about, unless they are in the cache."""
    from clbench.questions import load_questions, scenes_folder

    loaded = load_scenario(scenario)
    scenes_folder(loaded, progress)
    train, report = load_questions(loaded)
    return (
        f"{len(train.kinds)} kinds about {len(train.scenes)} states, and {len(report.scenes)} for the report"
    )


def pretrain_job(scenario: str, seed: int, progress: Callable[[float], None]) -> str:
    """Pretrain the policy of a seed, unless it is in the cache."""
    from clbench.pretraining import pretrained_policy

    policy, _ = pretrained_policy(load_scenario(scenario), seed, progress)
    return f"{sum(parameter.numel() for parameter in policy.parameters()):,} parameters"


def run_job(
    spec: RunSpec,
    records: Path,
    progress: Callable[[float], None],
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> str:
    """Do one run, write its record, and return its main scores."""
    from clbench.metrics import measure
    from clbench.scores import Scores

    record = execute(spec, records, progress, checkpoints=checkpoints, tensorboard=tensorboard)
    if record.error is not None:
        raise JobError(
            f"failed in {record.error['where']}: {record.error['type']}: {record.error['message']}"
        )
    scores = Scores.from_record(record)
    names = ["adaptation", "retention", "question_retention"]
    names[2:2] = ["perturbed_retention"] if spec.perturb else []
    values = {name: measure(name, scores) for name in names}
    return ", ".join(f"{name} {'-' if value is None else f'{value:.2f}'}" for name, value in values.items())


def stages_job(spec: RunSpec, checkpoints: Path | None, progress: Callable[[float], None]) -> str:
    """Make the policies of all stages of a run again, and keep them below `checkpoints`, if any."""
    from clbench.stages import keep_stages, make_stages

    try:
        if checkpoints is None:
            make_stages(spec, progress)
        else:
            keep_stages(spec, checkpoints, progress)
    except MethodError as error:
        raise JobError(str(error)) from error
    return "policies of all stages"


def demonstration_jobs(scenario: str, tasks: Sequence[str]) -> list[Job]:
    """Return the jobs that collect the demonstrations of `tasks`."""
    length = load_scenario(scenario).budget.demonstrations
    return [
        Job(
            f"demonstrations {task}", "clbench.grid:collect_job", {"scenario": scenario, "task": task}, length
        )
        for task in tasks
    ]


def benchmark_jobs(
    specs: Sequence[RunSpec],
    records: Path,
    limits: Limits | None = None,
    *,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> list[Job]:
    """Return all jobs that the runs `specs` need, of one scenario: demonstrations, pretraining, the runs.

    Args:
        specs: What is run.
        records: Folder of the records.
        limits: What the process of a run may take.
        checkpoints: Folder below which the policies of all stages are kept; none is if None.
        tensorboard: Folder below which the runs are logged for TensorBoard; they are not if None.
    """
    folders = {"records": records, "checkpoints": checkpoints, "tensorboard": tensorboard}
    jobs = _preparing_jobs(specs)
    for spec in specs:
        needs = (f"pretraining seed {spec.seed}",)
        length = run_length(spec.load(), spec.split, spec.perturb)
        jobs.append(
            Job(_title(spec), "clbench.grid:run_job", {"spec": spec, **folders}, length, needs, limits)
        )
    return jobs


def stages_jobs(specs: Sequence[RunSpec], checkpoints: Path | None) -> list[Job]:
    """Return all jobs that make the policies of all stages of runs, of one scenario, without a record.

    Args:
        specs: The runs.
        checkpoints: Folder below which the policies are kept; they stay in the cache alone if None.
    """
    jobs = _preparing_jobs(specs)
    for spec in specs:
        title, needs = f"stages of {_title(spec)}", (f"pretraining seed {spec.seed}",)
        scenario = spec.load()
        length = len(scenario.target) * scenario.budget.adaptation_steps
        arguments = {"spec": spec, "checkpoints": checkpoints}
        jobs.append(Job(title, "clbench.grid:stages_job", arguments, length, needs))
    return jobs


def _title(spec: RunSpec) -> str:
    """Return what people see of a run."""
    order = f" order {spec.order}" if spec.order else ""
    return f"{spec.label} seed {spec.seed}{order}"


def _preparing_jobs(specs: Sequence[RunSpec]) -> list[Job]:
    """Return the jobs that make what runs begin with: demonstrations, questions, a policy for each seed."""
    from clbench.pretraining import is_pretrained

    if not specs:
        return []
    name = specs[0].scenario
    scenario = load_scenario(name)
    budget = scenario.budget
    jobs = demonstration_jobs(name, [task.name for task in scenario.retained + scenario.target])
    jobs.append(Job("questions", "clbench.grid:scenes_job", {"scenario": name}, budget.question_episodes))
    data = tuple(job.name for job in jobs)
    for seed in sorted({spec.seed for spec in specs}):
        length = 0 if is_pretrained(scenario, seed) else budget.pretraining_steps
        arguments = {"scenario": name, "seed": seed}
        jobs.append(Job(f"pretraining seed {seed}", "clbench.grid:pretrain_job", arguments, length, data))
    return jobs
