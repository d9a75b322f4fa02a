"""Ctrl-C: remembered until the next command in the same process."""

import importlib
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

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


def _import_and_wait(module: str) -> None:
    importlib.import_module(module)
    time.sleep(60)


def test_a_ctrl_c_that_was_caught_is_raised_again_until_the_next_command() -> None:
    interrupts.install()
    interrupts.check()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        interrupts.check()
    interrupts.install()
    interrupts.check()


def test_a_ctrl_c_during_an_import_waits_for_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "interrupted_module.py").write_text(
        "import signal\nsignal.raise_signal(signal.SIGINT)\nFINISHED = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    interrupts.install()
    with pytest.raises(KeyboardInterrupt):
        _import_and_wait("interrupted_module")
    assert sys.modules.pop("interrupted_module").FINISHED


def test_an_import_that_does_not_end_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "endless_module.py").write_text(
        "import signal, time\nsignal.raise_signal(signal.SIGINT)\ntime.sleep(60)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(interrupts, "_IMPORT_SECONDS", 0.1)
    interrupts.install()
    with pytest.raises(KeyboardInterrupt):
        importlib.import_module("endless_module")
    assert "endless_module" not in sys.modules
