"""Progress of long work: bars with the time left on a terminal, otherwise a line now and then."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from importlib.util import find_spec
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from clbench.base.text import clock_time, print_plain, printable, printable_lines

LINE_SECONDS = 30.0
"""Seconds between two printed lines when there is no terminal."""

KNOWN = 0.01
"""Share of all work to do before the time left is shown: 30 s into hours of work, it said two weeks."""

AT_ONCE = 1.0
"""A piece that ends within this many seconds was done before: for example, its result is cached."""


@dataclass
class _Piece:
    """A piece of work that is shown."""

    bar: TaskID
    """Its bar."""
    length: float
    """Its length."""
    left: float
    """Length that is left to do."""
    begun: float
    """Time of its start."""
    text: str
    """What is shown of it."""


class Bars:
    """One bar for all work and one for each running piece.

    Args:
        total: Length of all work, in any unit.
        console: Console that shows the bars; standard error if None.
        clock: Returns the time in seconds; for tests.
    """

    def __init__(
        self, total: float, console: Console | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.console = console or lines_console()
        self._clock = clock
        self._total, self._done = max(total, 1e-9), 0.0
        self._started = self._last_line = clock()
        self._pieces: dict[Hashable, _Piece] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=Console() if self._in_notebook() else self.console,
            disable=not (self.console.is_terminal or self._in_notebook()),
        )
        self._all = self._progress.add_task("all", total=self._total)

    def _in_notebook(self) -> bool:
        """Return whether a notebook shows bars: rich needs ipywidgets for them."""
        return self.console.stderr and Console().is_jupyter and find_spec("ipywidgets") is not None

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def start(self, piece: Hashable, length: float) -> None:
        """Show a new piece of work under its text, `str(piece)`."""
        bar = self._progress.add_task(escape(printable(str(piece))), total=length)
        self._pieces[piece] = _Piece(bar, length, length, self._clock(), str(piece))

    def place(self, piece: Hashable, place: str) -> None:
        """Show where a piece of work is, such as the stage of a run and its last success; "" is nowhere."""
        shown = self._pieces[piece]
        shown.text = f"{piece}, {place}" if place else str(piece)
        self._progress.update(shown.bar, description=escape(printable(shown.text)))

    def share(self, piece: Hashable) -> float:
        """Return the share of a piece that is done."""
        shown = self._pieces[piece]
        return 1.0 - shown.left / max(shown.length, 1e-9)

    def advance(self, piece: Hashable, amount: float) -> None:
        """Show that `amount` of a piece was done."""
        shown = self._pieces[piece]
        shown.left -= amount
        self._progress.advance(shown.bar, amount)
        self._progress.advance(self._all, amount)
        self._done += amount
        self.tick()

    def tick(self) -> None:
        """Without a terminal, print now and then how far the work is, and what it is doing or waiting for."""
        now = self._clock()
        if self._progress.disable and now - self._last_line >= LINE_SECONDS:
            self._last_line = now
            share = min(1.0, self._done / self._total)
            seconds = (now - self._started) * (1 - share) / share if share >= KNOWN else None
            left = "" if seconds is None else f", about {clock_time(seconds)} left"
            self.say(f"{share:4.0%}{left}: {'; '.join(one.text for one in self._pieces.values())}")

    def skip(self, piece: Hashable, length: float, text: str) -> None:
        """Leave out a piece of work that need not be done, and print why."""
        self.start(piece, length)
        self.finish(piece, text)

    def finish(self, piece: Hashable, text: str) -> None:
        """Complete and remove the bar of a piece, and print the outcome.

        A piece that took no time does not count: it says nothing about how long the rest will take.
        """
        shown = self._pieces[piece]
        if self._clock() - shown.begun < AT_ONCE:
            self._total = max(self._total - shown.left, self._done, 1e-9)
            # a bar with nothing left to do is full
            self._progress.update(self._all, total=self._total, completed=min(self._done + 1e-9, self._total))
        else:
            self.advance(piece, shown.left)
        self._remove(piece, text)

    def postpone(self, piece: Hashable, text: str) -> None:
        """Remove the bar of a piece that starts again later, take its progress back, and print why."""
        shown = self._pieces[piece]
        self.advance(piece, shown.left - shown.length)
        self._remove(piece, text)

    def _remove(self, piece: Hashable, text: str) -> None:
        self._progress.remove_task(self._pieces.pop(piece).bar)
        self.say(f"{piece}: {text}")

    def say(self, line: str) -> None:
        """Print a text without markup, wrapping or characters that control the terminal."""
        print_plain(self.console, printable_lines(line))


def lines_console() -> Console:
    """Return a console for standard error; in a notebook, its lines are text rather than HTML."""
    return Console(stderr=True, force_jupyter=False)
