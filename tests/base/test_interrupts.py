"""Ctrl-C: remembered until the next command in the same process."""

import signal
import sys
from collections.abc import Iterator

import pytest

from clbench.base import interrupts


@pytest.fixture(autouse=True)
def _own_process_state(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Restore what `install` sets in its process."""
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    handler = signal.getsignal(signal.SIGINT)
    yield
    interrupts.install()  # forgets the Ctrl-C
    signal.signal(signal.SIGINT, handler)


def test_a_ctrl_c_that_was_caught_is_raised_again_until_the_next_command() -> None:
    interrupts.install()
    interrupts.check()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        interrupts.check()
    interrupts.install()
    interrupts.check()
