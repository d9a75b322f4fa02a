"""The entry point of the command `clbench`: Ctrl-C or SIGTERM ends it at any moment, without a traceback."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import sys

from clbench.base import interrupts

_STOPS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
"""Signals of Ctrl-C, of a scheduler that ends the command, and of a terminal that closes."""


def main() -> None:
    """Run the command line.

    While the command works, these signals raise KeyboardInterrupt, so that it can clean up and end its
    workers. Before and after, there is nothing to clean up: the process ends at once. The exit code is 128
    and the number of the signal, as shells report it.
    """
    _end_at_once_when_stopped()
    for place, name in enumerate(("stdout", "stderr"), 1):
        if getattr(sys, name) is None:  # it was closed: >&-
            # the next open file would get its number, and with it what libraries and children print there
            os.dup2(os.open(os.devnull, os.O_WRONLY), place)
            os.set_inheritable(place, True)
            setattr(sys, name, open(place, "w", encoding="utf-8"))  # noqa: SIM115 -- until the process ends
    for stream in (sys.stdout, sys.stderr):  # a terminal may lack a sign, such as that of plus and minus
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    from clbench.cli.main import main as run_command  # takes 0.1 s, in which Ctrl-C must not show a traceback

    try:
        try:
            interrupts.install(_heeded())
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
        if interrupts.stopped_by() is None:
            raise
    number = interrupts.stopped_by()
    if number is not None:
        _end_at_once_when_stopped()
        with contextlib.suppress(OSError):  # the terminal may be closed
            print("Stopped. Finished records are kept; repeat the command to do the rest.", file=sys.stderr)  # noqa: T201
        sys.exit(128 + number)


def _heeded() -> list[signal.Signals]:
    """Return the signals that stop the command; a process may be started to ignore some of them."""
    return [number for number in _STOPS if signal.getsignal(number) is not signal.SIG_IGN]


def _end_at_once_when_stopped() -> None:
    """Let the signals end the process at once, without Python's clean-up at the end."""
    for number in _heeded():
        signal.signal(number, lambda number, _: os._exit(128 + number))
