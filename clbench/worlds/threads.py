"""Threads that share the stepping of worlds."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import TypeVar

Item = TypeVar("Item")


class Team:
    """Threads that share out work, the calling one among them; MuJoCo releases the interpreter lock.

    Args:
        threads: How many.
    """

    def __init__(self, threads: int) -> None:
        self._helpers = [_Helper() for _ in range(threads - 1)]

    def each(self, work: Callable[[Item], None], items: Sequence[Item]) -> None:
        """Do the work on each item, in any order: each thread takes the next that is left."""
        left = iter(items)

        def take() -> None:
            for item in left:
                work(item)

        helpers = self._helpers[: len(items) - 1] if items else []
        for helper in helpers:
            helper.asked.put(take)
        try:
            take()
        finally:
            errors = [error for helper in helpers if (error := helper.ended.get()) is not None]
        if errors:
            raise errors[0]

    def close(self) -> None:
        """End the threads."""
        for helper in self._helpers:
            helper.asked.put(None)
        self._helpers = []

    def __del__(self) -> None:
        """End the threads of a team that nobody closed."""
        self.close()


class _Helper:
    """A thread that does what it is asked for, until that is None.

    Two queues in C pass work on in 10 us; an executor takes 50, a fortieth of a step of Meta-World.
    """

    def __init__(self) -> None:
        self.asked: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.ended: SimpleQueue[Exception | None] = SimpleQueue()
        threading.Thread(target=_help, args=(self.asked, self.ended), daemon=True).start()


def _help(asked: SimpleQueue[Callable[[], None] | None], ended: SimpleQueue[Exception | None]) -> None:
    while (work := asked.get()) is not None:
        try:
            work()
        except Exception as error:
            ended.put(error)
        else:
            ended.put(None)
