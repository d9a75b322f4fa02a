"""Workers on this machine: processes that each do one job, or this process.

A job computes with one thread, so that it repeats bit for bit. Its worlds step with its share of the cores.
"""

from __future__ import annotations

import errno
import functools
import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any

from clbench.base.errors import ClbenchError, InputError
from clbench.base.lease import LeaseLostError
from clbench.base.progress import ProgressCallback, listen
from clbench.jobs.folders import absolute_places
from clbench.jobs.job import Event, Job, Outcome
from clbench.jobs.process_limits import end, end_group, exceeded, signal_group
from clbench.worlds.threads import cores, share_cores

SEND_SECONDS = 0.2
"""Shortest time between two progress reports of a worker, in seconds."""

LEAVE_SECONDS = 5.0
"""Time for a process that has sent its outcome to end, in seconds; then it is killed."""
CLOSE_SECONDS = 3.0
"""Time for processes to end after SIGTERM, in seconds; then they are killed."""
_LOOK_SECONDS = 0.5

MOST_CORES = 8
"""Most cores for the worlds of a job. Where steps are short, further threads cost more than they do: on two
cores, dm_control's 40 lanes take 1.05 times as long with 8 threads as with one, and 1.35 times with 16."""

_LIMITS = (errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM)
"""Error numbers of a machine on which no more files can be opened and no more processes can start."""


def at_once(device: str) -> int:
    """Return how many jobs run at once on a device by default: one per core, or one per GPU."""
    return cores() if device == "cpu" else max(1, len(_gpus())) if device == "cuda" else 1


def _gpus() -> list[str]:
    """Return the names of the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` lists them."""
    import torch  # takes a second to import

    count = torch.cuda.device_count()
    names = os.environ.get("CUDA_VISIBLE_DEVICES")
    return [str(number) for number in range(count)] if names is None else names.split(",")[:count]


@dataclass
class _Worker:
    job: Job
    process: BaseProcess
    connection: Connection
    gpu: str | None
    """Name of the GPU that is its "cuda"; None if it computes elsewhere."""
    started: float = field(default_factory=time.monotonic)
    looked: float = field(default_factory=time.monotonic)
    broken: str | None = None
    """Limit that its process exceeded, in words; None if it exceeded none."""
    place: str | None = None
    """Last hook of a method that it announced."""


class Processes:
    """Workers on this machine.

    Args:
        count: Number of jobs that run at once; `at_once` of the device if None.
        device: Device on which runs compute.
    """

    def __init__(self, count: int | None = None, device: str = "cpu") -> None:
        self._count = count or at_once(device)
        self._cores = self._count if device == "cpu" else cores()
        self._share: Any = None
        """Number of cores of each job, in memory that the jobs share; made with the first one."""
        self._running: dict[Connection, _Worker] = {}
        self._handles_suspension = _handles_suspension()
        if self._handles_suspension:
            signal.signal(signal.SIGTSTP, self._suspend)

    def free(self) -> int:
        """Return the number of jobs that can start now."""
        return self._count - len(self._running)

    def start(self, job: Job) -> None:
        """Start a job in its own process, and on its own GPU if there are enough GPUs."""
        used = [worker.gpu for worker in self._running.values()]
        gpu = min(_gpus(), key=used.count, default=None) if job.device == "cuda" else None
        with _signals_held_back():
            context = _context()
            if self._share is None:
                self._share = context.RawValue("i", 1)
            worker = _start(context, job, gpu, self._share)
            self._running[worker.connection] = worker
        self._divide_cores()

    def _divide_cores(self) -> None:
        """Give each running job an equal share of the cores; its process reads the number at every step."""
        self._share.value = _share_of(self._cores, len(self._running))

    def events(self) -> Iterator[Event]:
        """Yield the events since the last call; wait at most a second for one."""
        self._hold_to_limits()
        # a child that a job forked may keep the connection open after the end of its process
        wait([*self._running, *(one.process.sentinel for one in self._running.values())], timeout=1.0)
        for connection, worker in list(self._running.items()):
            ended = not worker.process.is_alive()
            if connection.poll():
                kind, value = _receive(worker)
            elif ended:
                kind, value = _lost(worker)
            else:
                continue
            if kind == "at":
                worker.place, remark = value
                value = f"{worker.place} {remark}".strip()
            event = Event(worker.job, kind, value)
            if event.ends_job:
                del self._running[connection]
                self._divide_cores()
                _leave(worker.process)
            yield event

    def close(self) -> None:
        """End all processes and what they started, even if they ignore SIGTERM."""
        processes = [worker.process for worker in self._running.values()]
        try:
            for process in processes:
                process.terminate()
            deadline = time.monotonic() + CLOSE_SECONDS
            for process in processes:
                process.join(max(0.0, deadline - time.monotonic()))
        finally:  # a second signal may interrupt the wait
            for process in processes:
                _end(process)
            self._running.clear()
            if self._handles_suspension:
                signal.signal(signal.SIGTSTP, signal.SIG_DFL)

    def _suspend(self, *_: object) -> None:
        """On Ctrl-Z, stop and later continue with all workers: a terminal does not reach their groups."""
        groups = [worker.process.pid for worker in self._running.values() if worker.process.pid]
        for group in groups:
            signal_group(group, signal.SIGSTOP)
        begin = time.monotonic()
        os.kill(os.getpid(), signal.SIGSTOP)
        for worker in self._running.values():
            worker.started += time.monotonic() - begin  # its limit is of the time that it runs
        for group in groups:
            signal_group(group, signal.SIGCONT)

    def _hold_to_limits(self) -> None:
        """End the processes that exceed their limits."""
        for worker in self._running.values():
            limits, now = worker.job.limits, time.monotonic()
            if limits is None or worker.broken or now - worker.looked < _LOOK_SECONDS:
                continue
            worker.looked = now
            assert worker.process.pid is not None
            worker.broken = exceeded(limits, worker.process.pid, now - worker.started)
            if worker.broken:
                end(worker.process.pid)


def _share_of(cores: int, jobs: int) -> int:
    """Return the number of cores for the worlds of each of `jobs`."""
    return min(max(1, cores // max(1, jobs)), MOST_CORES)


class Here:
    """This process as a worker: one job at a time, for methods that no other process can import.

    Args:
        count: Number of cores that a job may use for its worlds; all if None.
    """

    def __init__(self, count: int | None = None) -> None:
        self._share = _share_of(count or cores(), 1)
        self._job: Job | None = None
        self._thread = threading.Thread()
        self._events: queue.Queue[Event] = queue.Queue()
        self._stopped = threading.Event()

    def free(self) -> int:
        """Return the number of jobs that can start now."""
        return 0 if self._job else 1

    def start(self, job: Job) -> None:
        """Start a job in a new thread, so that this thread can show its progress."""
        self._job = job
        self._thread = threading.Thread(target=self._work, args=(job,), daemon=True)
        self._thread.start()

    def _work(self, job: Job) -> None:
        def send(amount: float) -> None:
            if self._stopped.is_set():
                raise SystemExit  # it ends the thread alone
            self._events.put(Event(job, "progress", amount))

        listen(lambda place, remark: self._events.put(Event(job, "at", f"{place} {remark}".strip())))
        share_cores(lambda: self._share)
        try:
            kind, value = _do_job(job.function, job.arguments, send)
        except SystemExit as leaving:
            if self._stopped.is_set():
                return
            kind, value = "failed", f"it ended its process ({leaving})"
        finally:
            listen(None)
            share_cores(None)
        self._events.put(Event(job, kind, value))

    def events(self) -> Iterator[Event]:
        """Yield the events since the last call; wait at most a second for one."""
        with suppress(queue.Empty):
            event = self._events.get(timeout=1.0)
            while True:
                if event.ends_job:
                    self._thread.join()
                    self._job = None
                yield event
                event = self._events.get_nowait()

    def close(self) -> None:
        """End the running job at its next sign of progress."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()


def _handles_suspension() -> bool:
    """Return whether Ctrl-Z would stop this process and can be handled here."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    return in_main_thread and signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL


def _leave(process: BaseProcess) -> None:
    """Wait for a process that has sent its outcome to end, and kill everything it started that still runs."""
    process.join(LEAVE_SECONDS)
    _end(process)


def _end(process: BaseProcess) -> None:
    """Kill a process, if it still runs, and everything that it started."""
    assert process.pid is not None
    if process.is_alive():
        end(process.pid)
        process.join()
    end_group(process.pid)


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Hold back the signals that end the command: an interrupted start would leave half a process behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    stops = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {stop: signal.signal(stop, lambda number, _: held.append(number)) for stop in stops}
    try:
        yield
    finally:
        for stop, handler in before.items():
            signal.signal(stop, handler)
        for number in held[:1]:
            signal.raise_signal(number)


@contextmanager
def _script_hidden() -> Iterator[None]:
    """Keep new processes from importing the user's script: no job needs it, and it would run twice."""
    script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _context() -> Any:
    """Return how processes start: forked from one that has imported everything, in 50 ms instead of 2 s."""
    context = multiprocessing.get_context("forkserver")
    # the second module also takes a second, and PyTorch's deterministic algorithms import it
    context.set_forkserver_preload(["clbench.runs.run", "torch._inductor.config"])
    # otherwise the server starts it, and thereby unblocks Ctrl-C for itself
    resource_tracker.ensure_running()
    # The server inherits the mask. It ignores Ctrl-C, which reaches all processes of a terminal, only after
    # its imports: until then the mask protects it. A Ctrl-C that comes meanwhile waits here, and is not lost.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _script_hidden():
            forkserver.ensure_running()
    except OSError as error:
        advice = (
            "Close programs, or raise the limit that `ulimit -a` shows."
            if error.errno in _LIMITS
            # the path of a socket has at most 107 characters
            else "Workers need a folder for temporary files with room and a short path: set TMPDIR to one."
        )
        raise InputError(f"No worker can start: {error}. {advice}") from error
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def _start(context: Any, job: Job, gpu: str | None, share: Any) -> _Worker:
    ours, theirs = context.Pipe(duplex=False)
    environment = {**os.environ, **absolute_places()}
    if gpu is not None:
        environment["CUDA_VISIBLE_DEVICES"] = gpu
    process = context.Process(
        target=_work, args=(theirs, job.function, job.arguments, environment, share), daemon=True
    )
    with _script_hidden():
        process.start()
    theirs.close()  # so that the end of the process is the end of the stream
    return _Worker(job, process, ours, gpu)


def _receive(worker: _Worker) -> tuple[Any, Any]:
    try:
        kind, value = worker.connection.recv()
    except (EOFError, OSError):  # closed, or torn in the middle of a message
        return _lost(worker)
    return kind, value


def _lost(worker: _Worker) -> tuple[str, str]:
    """Return the event of a worker that has closed its connection or died."""
    _leave(worker.process)
    if worker.broken:
        return "failed", f"stopped, because {worker.broken}"
    place = f" in {worker.place}" if worker.place else ""
    return "lost", f"its process ended{place} without a result ({_exit(worker.process.exitcode)})"


def _exit(code: int | None) -> str:
    """Return an exit code in words, with the name of the signal if one ended the process."""
    if code is None or code >= 0:
        return f"exit code {code}"
    try:
        return f"exit code {code}, {signal.Signals(-code).name}"
    except ValueError:  # the real-time signals between the first and the last have no name
        return f"exit code {code}, signal {-code}"


def _work(
    connection: Connection,
    function: Callable[..., str],
    arguments: dict[str, Any],
    environment: dict[str, str],
    share: Any,
) -> None:
    """Do one job in this process and send its outcome."""
    # this process may be forked from one with an older environment
    os.environ.clear()
    os.environ.update(environment)
    multiprocessing.current_process().daemon = False  # otherwise a method could not start processes
    os.setpgid(0, 0)  # so that the parent can end them with this process
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers when Ctrl-C reaches it
    # children of a job must not inherit the mask of the server
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def tell(kind: str, value: Any) -> None:
        try:
            connection.send((kind, value))
        except OSError:  # the parent is gone: stop as if killed, so that the run can be resumed
            sys.exit(1)

    share_cores(lambda: int(share.value))
    listen(lambda place, remark: tell("at", (place, remark)))
    tell(*_do_job(function, arguments, functools.partial(tell, "progress")))


def _do_job(
    function: Callable[..., str], arguments: dict[str, Any], send: ProgressCallback
) -> tuple[Outcome, str]:
    """Do one job in this process, and return how it ended and its result.

    Args:
        function: Function of the job.
        arguments: Arguments by name.
        send: Called at intervals with the length done since its last call.
    """
    owed, sent = 0.0, time.monotonic()

    def progress(amount: float) -> None:
        nonlocal owed, sent
        owed += amount
        if time.monotonic() - sent >= SEND_SECONDS:
            send(owed)
            owed, sent = 0.0, time.monotonic()

    try:
        text = function(**arguments, progress=progress)
        send(owed)
    except LeaseLostError as error:
        return "taken", str(error)
    except ClbenchError as error:  # its message says all
        return "failed", str(error)
    except SystemExit:
        raise
    except BaseException as error:  # Ctrl-C, for example, reaches neither a worker nor a thread
        return "failed", f"{type(error).__name__}: {error}\n{traceback.format_exc()}"
    return "done", text
