"""Ctrl-C and the other signals that stop a command: none of them can get lost.

Python raises KeyboardInterrupt wherever the main thread happens to be. In a destructor or a callback the
exception is printed and dropped, and a library may swallow it. The handler therefore also remembers the
signal, and long-running code calls `check`. A compiled module that meets the exception while it loads may
abort the process, so the handler lets imports finish first.
"""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Iterable
from types import FrameType

_first: tuple[int, float] | None = None
"""Number and time of the first signal."""

_AGAIN_SECONDS = 0.01

_IMPORT_SECONDS = 10.0
"""Longest wait for an import, in seconds. PyTorch takes 1 s, or several on a busy machine; an import that
never ends must not block Ctrl-C."""


def install(numbers: Iterable[int] = (signal.SIGINT,)) -> None:
    """Make signals raise KeyboardInterrupt, and raise it again if a destructor or a callback dropped it.

    The first signal is remembered for `stopped_by` and `check`.

    Args:
        numbers: Numbers of the signals.
    """
    global _first
    _first = None  # an earlier command in this process may have been stopped
    for number in numbers:
        signal.signal(number, _handle)
    sys.unraisablehook = _raise_again


def stopped_by() -> int | None:
    """Return the number of the first signal, None if there was none."""
    return None if _first is None else _first[0]


def check() -> None:
    """Raise KeyboardInterrupt if a signal came earlier, in case the first exception got lost.

    Raises:
        KeyboardInterrupt: A signal has come since `install`.
    """
    if _first is not None:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    global _first
    now = time.monotonic()
    if _first is None:
        _first = number, now
    if _imports(frame) and now - _first[1] < _IMPORT_SECONDS:
        _soon_again()
    else:
        raise KeyboardInterrupt


def _imports(frame: FrameType | None) -> bool:
    """Return whether a frame, or one of its callers, is importing a module."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _raise_again(unraisable: sys.UnraisableHookArgs) -> None:
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _soon_again()  # Python drops exceptions raised here too
    else:
        sys.__unraisablehook__(unraisable)


def _soon_again() -> None:
    threading.Timer(_AGAIN_SECONDS, _interrupt_main).start()


def _interrupt_main() -> None:
    """Send the signal to the main thread again, from another thread."""
    main, number = threading.main_thread().ident, stopped_by() or signal.SIGINT
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)  # also interrupts a system call, such as a sleep
    else:
        _thread.interrupt_main(signal.Signals(number))
