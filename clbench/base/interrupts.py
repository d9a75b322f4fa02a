"""Ctrl-C that cannot get lost.

Python raises KeyboardInterrupt wherever the main thread happens to be. In a destructor or a callback the
exception is printed and dropped, and a library may swallow it. The handler therefore also remembers it: long
work calls `check`. A compiled module that meets the exception while it loads may abort the process, so the
handler lets imports finish first.
"""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from types import FrameType

_interrupted_at: float | None = None
"""Time of the first Ctrl-C."""

_AGAIN_SECONDS = 0.01

_IMPORT_SECONDS = 10.0
"""PyTorch is imported in 1 s, on a busy machine in several. One that never ends must not block Ctrl-C."""


def install() -> None:
    """Remember each Ctrl-C from now on, and raise it again if a destructor or a callback dropped it."""
    global _interrupted_at
    _interrupted_at = None  # an earlier command in this process may have been stopped
    signal.signal(signal.SIGINT, _handle)
    sys.unraisablehook = _raise_again


def check() -> None:
    """Raise the Ctrl-C that came earlier, if it got lost.

    Raises:
        KeyboardInterrupt: There was one.
    """
    if _interrupted_at is not None:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    global _interrupted_at
    now = time.monotonic()
    if _interrupted_at is None:
        _interrupted_at = now
    if _imports(frame) and now - _interrupted_at < _IMPORT_SECONDS:
        _soon_again()
    else:
        raise KeyboardInterrupt


def _imports(frame: FrameType | None) -> bool:
    """Return whether an import is under way in a frame or in those that called it."""
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
    """Send SIGINT to the main thread, from another thread."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # also interrupts a system call, such as a sleep
    else:
        _thread.interrupt_main()
