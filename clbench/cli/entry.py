"""The entry point of the command `clbench`: Ctrl-C ends it at any moment, without a traceback."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

from clbench.base import interrupts

INTERRUPTED = 128 + signal.SIGINT
"""Exit code after Ctrl-C, as shells report it."""

_STOPS = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
"""Signals of a scheduler that ends the command, and of a terminal that closes: workers do not get them."""


def main() -> None:
    """Run the command line.

    While the command works, Ctrl-C raises KeyboardInterrupt, so that it can clean up. Before and after, there
    is nothing to clean up: the process ends at once.
    """
    _end_at_once_when_stopped()
    if sys.stdout is None:  # it was closed: >&-
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 -- until the process ends
    for stream in (sys.stdout, sys.stderr):  # a terminal may lack a sign, such as that of plus and minus
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    from clbench.cli.main import main as run_command  # takes 0.1 s, in which Ctrl-C must not show a traceback

    try:
        try:
            if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
                interrupts.install()
            for stop in _STOPS:  # they end the workers too, as Ctrl-C does
                _handle(stop, lambda number, _: sys.exit(128 + number))
            run_command()
        finally:
            with contextlib.suppress(OSError, ValueError):  # a closed pipe
                sys.stdout.flush()
            _end_at_once_when_stopped()
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.ENOSPC) or error.filename is not None:
            raise
        # nobody reads the output any more, or its disk is full
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno == errno.ENOSPC:
            print(f"error: the output cannot be written: {error.strerror}.", file=sys.stderr)  # noqa: T201
        sys.exit(1)
    except BaseException:
        # an import can turn the KeyboardInterrupt into an ImportError, a command into an error of its own
        if not _interrupted():
            raise
    if _interrupted():
        _end_at_once_when_stopped()
        print("Stopped. Finished records are kept; repeat the command to continue.", file=sys.stderr)  # noqa: T201
        sys.exit(INTERRUPTED)


def _interrupted() -> bool:
    """Return whether Ctrl-C came."""
    try:
        interrupts.check()
    except KeyboardInterrupt:
        return True
    return False


def _handle(number: signal.Signals, handler: Callable[[int, FrameType | None], object]) -> None:
    """Set the handler of a signal, unless the process was started to ignore the signal."""
    if signal.getsignal(number) is not signal.SIG_IGN:
        signal.signal(number, handler)


def _end_at_once_when_stopped() -> None:
    """Let Ctrl-C and SIGTERM end the process at once, without Python's clean-up at the end."""
    for number in (signal.SIGINT, *_STOPS):
        _handle(number, lambda number, _: os._exit(128 + number))
