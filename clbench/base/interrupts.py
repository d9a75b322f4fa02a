"""Ctrl-C that cannot get lost.

Python raises KeyboardInterrupt wherever the main thread happens to be. In a destructor or a callback the
exception is printed and dropped, and a library may swallow it. The handler therefore also remembers it: long
work calls `check`.
"""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from types import FrameType

_interrupted = False
_AGAIN_SECONDS = 0.01


def install() -> None:
    """Remember each Ctrl-C from now on, and raise it again if a destructor or a callback dropped it."""
    global _interrupted
    _interrupted = False  # an earlier command in this process may have been stopped
    signal.signal(signal.SIGINT, _handle)
    sys.unraisablehook = _raise_again


def check() -> None:
    """Raise the Ctrl-C that came earlier, if it got lost.

    Raises:
        KeyboardInterrupt: There was one.
    """
    if _interrupted:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    global _interrupted
    _interrupted = True
    raise KeyboardInterrupt


def _raise_again(unraisable: sys.UnraisableHookArgs) -> None:
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        # a moment later, as Python drops exceptions raised here too
        threading.Timer(_AGAIN_SECONDS, _interrupt_main).start()
    else:
        sys.__unraisablehook__(unraisable)


def _interrupt_main() -> None:
    """Send SIGINT to the main thread, from another thread."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)  # also interrupts a system call, such as a sleep
    else:
        _thread.interrupt_main()
