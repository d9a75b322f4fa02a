"""Threads that step worlds together, and the objects that each of them needs for itself."""

from __future__ import annotations

import math
import os
import threading
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from queue import SimpleQueue
from typing import Generic, TypeVar

Item = TypeVar("Item")

_PATIENCE = 5.0
"""Longest wait in seconds for the threads of a team that nobody closed. The garbage collector ends such a
team at any moment, even while its thread holds a lock that an ending thread needs."""


PROCESS_CGROUPS = Path("/proc/self/cgroup")
"""File in which Linux lists the control groups of this process, a line for each hierarchy."""
CGROUPS = Path("/sys/fs/cgroup")
"""Folder of the control groups of version 2; for version 1 it has a folder for each controller."""


def cores() -> int:
    """Return the number of cores that this process may use, which may be only some of the machine's.

    The cores that the process may run on limit the number, and so does the CPU quota of its control groups,
    rounded up: a container with 4.5 of 128 cores has 5.
    """
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _quota()
    return usable if quota == math.inf else max(1, min(usable, math.ceil(quota)))


def _quota() -> float:
    """Return the smallest CPU quota of this process's control groups and their parents, in cores."""
    try:
        lines = PROCESS_CGROUPS.read_text(encoding="utf-8").splitlines()
    except OSError:  # this is not Linux
        return math.inf
    quotas = [math.inf]
    for line in lines:
        _, controllers, path = line.split(":", 2)
        # a container may see the path of the machine, but its own group at the root
        own = PurePosixPath(path.lstrip("/"))
        for group in (own, *own.parents):
            if not controllers:
                quotas.append(_quota_of(CGROUPS / group / "cpu.max"))
            elif "cpu" in controllers.split(","):
                folder = CGROUPS / "cpu" / group
                quotas.append(_quota_of(folder / "cpu.cfs_quota_us", folder / "cpu.cfs_period_us"))
    return min(quotas)


def _quota_of(*files: Path) -> float:
    """Return the cores of a group from files that hold its microseconds of CPU time and of a period."""
    try:
        quota, period = map(int, " ".join(file.read_text(encoding="ascii") for file in files).split())
    except (OSError, ValueError):  # no such controller, or the text "max" for no quota
        return math.inf
    return quota / period if quota > 0 else math.inf  # version 1 says -1 for no quota


_share: Callable[[], int] | None = None


def share_cores(share: Callable[[], int] | None) -> None:
    """Let the teams of this process use at most as many threads as `share` returns, asked at every step.

    A command gives each of its jobs an equal share of the cores, which grows when other jobs end. Without a
    share (None), teams use all of their threads.
    """
    global _share
    _share = share


def threads_of_job() -> int:
    """Return the most threads that the worlds of a job may use: one if it has no share of the cores."""
    return 1 if _share is None else cores()


class Team:
    """Threads, including the calling one, that share work in parallel: MuJoCo releases the interpreter lock.

    A team that nobody closes ends with the last reference to it, or when the interpreter exits.

    Args:
        threads: Most threads that work at once, each started when it is first needed. `share_cores` may allow
            fewer, and so may the machine.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._helpers: list[_Helper] = []
        # what it calls must not refer to the team
        self._ending = weakref.finalize(self, _end, self._helpers, _PATIENCE)

    def each(self, work: Callable[[Item], None], items: Sequence[Item]) -> None:
        """Do the work on each item, in any order: each thread takes the next item that is left.

        If the calling thread is interrupted, the others finish the items that they have begun, then stop.
        """
        left, interrupted = iter(items), False

        def take() -> None:
            for item in left:
                if interrupted:
                    return
                work(item)

        helpers = self._helpers_for(len(items))
        for helper in helpers:
            helper.asked.put(take)
        try:
            take()
        except KeyboardInterrupt:
            interrupted = True
            raise
        finally:
            errors = [error for error in [helper.wait() for helper in helpers] if error is not None]
        if errors:
            raise errors[0]

    def _helpers_for(self, items: int) -> list[_Helper]:
        """Return the threads that work beside the calling one; one that is missing is started."""
        allowed = self._threads if _share is None else min(self._threads, _share())
        count = max(0, min(items, allowed) - 1)
        while len(self._helpers) < count and self._ending.alive:
            try:
                self._helpers.append(_Helper())
            except RuntimeError:  # the machine has no more threads
                self._threads = len(self._helpers) + 1
                break
        # in a forked process, threads of the parent do not live
        return [one for one in self._helpers[:count] if one.thread.is_alive()]

    def close(self) -> None:
        """End the threads and wait for them. A closed team works with the calling thread alone."""
        if self._ending.detach() is not None:
            _end(self._helpers, None)


class _Helper:
    """A thread that does what it is asked for, until it is asked for None.

    Two queues in C hand work over in 10 us; an executor takes 50 us, a fortieth of a step of Meta-World.
    """

    def __init__(self) -> None:
        self.asked: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.ended: SimpleQueue[Exception | None] = SimpleQueue()
        self.thread = threading.Thread(target=_help, args=(self.asked, self.ended), daemon=True)
        self.thread.start()

    def wait(self) -> BaseException | None:
        """Return the error of the work that was asked for, None if it succeeded.

        A Ctrl-C is returned when the work has ended: an answer left in the queue would be taken for the next
        one, while the thread still works.
        """
        interruption: KeyboardInterrupt | None = None
        while True:
            try:
                error = self.ended.get()
            except KeyboardInterrupt as stop:
                interruption = stop
            else:
                return interruption or error


class Copies(Generic[Item]):
    """An object that one thread at a time may change, such as a compiled scene, and copies for other threads.

    Args:
        first: Object for the first thread.
        copied: Returns a copy; called only when a further thread needs one.
    """

    def __init__(self, first: Item, copied: Callable[[], Item]) -> None:
        self._copied, self._free = copied, [first]

    def take(self) -> Item:
        """Return an object that no other thread uses."""
        try:
            return self._free.pop()
        except IndexError:
            return self._copied()

    def give_back(self, taken: Item) -> None:
        """Make an object available to other threads again."""
        self._free.append(taken)


def _help(asked: SimpleQueue[Callable[[], None] | None], ended: SimpleQueue[Exception | None]) -> None:
    while (work := asked.get()) is not None:
        error = _error_of(work)
        # work is often a method of the team's owner: a waiting thread that held it would keep the team alive
        del work
        ended.put(error)
        del error


def _error_of(work: Callable[[], None]) -> Exception | None:
    """Do the work, and return its error, None if it succeeds."""
    try:
        work()
    except Exception as error:
        return error
    return None


def _end(helpers: list[_Helper], patience: float | None) -> None:
    """End the threads of helpers, and wait for all of them but the calling thread.

    Args:
        helpers: Helpers to end; the list is empty afterwards.
        patience: Longest wait for a thread in seconds; None sets no limit.
    """
    for helper in helpers:
        helper.asked.put(None)
    for helper in helpers:
        if helper.thread is not threading.current_thread():
            helper.thread.join(patience)
    helpers.clear()
