"""Ctrl-C at any moment of a run: the command ends with 130, leaves no process, and continues if repeated."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from helpers import printed

from clbench.base import interrupts
from clbench.jobs.bars import Bars
from clbench.jobs.job import Event, Job
from clbench.jobs.scheduler import run_jobs

TOY = "clbench.testing:clbench/Toy-v0"
MOMENTS = 50
GONE = 10.0
"""Seconds within which every process of an interrupted command must be gone."""


def _command(records: Path) -> list[str]:
    return [sys.executable, "-m", "clbench", "run", TOY, "sft", "--seeds", "1", "--records", str(records)]


def _start(records: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        _command(records),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        # tests that run in the background of a shell ignore Ctrl-C, and so would this process
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _is_gone(group: int) -> bool:
    deadline = time.monotonic() + GONE
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


class Swallows:
    """A worker within which a library swallows Ctrl-C: it does one job at each look."""

    def __init__(self) -> None:
        self._job: Job | None = None

    def free(self) -> int:
        return 1 if self._job is None else 0

    def start(self, job: Job) -> None:
        self._job = job

    def events(self) -> Iterator[Event]:
        job, self._job = self._job, None
        assert job is not None
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        yield Event(job, "done", "went well")

    def close(self) -> None:
        pass


def test_no_job_starts_after_a_ctrl_c_that_a_library_has_swallowed(
    bars: Bars, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    before = signal.getsignal(signal.SIGINT)
    interrupts.install()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_jobs([Job("first", str, {}, 1.0), Job("second", str, {}, 1.0)], Swallows(), bars)
    finally:
        interrupts.install(())  # forgets the signal
        signal.signal(signal.SIGINT, before)
    assert printed(bars).startswith("first: went well")
    assert "second" not in printed(bars)


@pytest.mark.slow
def test_ctrl_c_at_fifty_random_moments_ends_a_run_with_130_and_the_same_command_completes_it(
    tmp_path: Path, empty_caches: Path, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    # the first collects demonstrations and pretrains too
    subprocess.run(_command(tmp_path / "whole"), check=True, capture_output=True)
    begin = time.monotonic()
    subprocess.run(_command(tmp_path / "again"), check=True, capture_output=True)
    seconds = time.monotonic() - begin
    whole = lasting_records(tmp_path / "whole")
    moments = random.Random(0)
    stopped, number = 0, -1
    while stopped < MOMENTS:  # a run that ended before its moment does not count
        number += 1
        records = tmp_path / str(number)
        process = _start(records)
        # in the first moments Python itself starts, and ends with its own code
        time.sleep(moments.uniform(0.1, 0.9 * seconds))
        over = process.poll() is not None
        if not over:
            os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=600)
        # while Python and clbench load, the signal itself ends the process: shells report that as 130 too
        assert over or process.returncode in (130, -signal.SIGINT), (
            f"{number}: {process.returncode}\n{output}"
        )
        assert over or process.returncode != 130 or "Traceback" not in output, f"{number}: {output}"
        assert _is_gone(process.pid), f"{number}: a process is left"
        stopped += not over
        if number % 10 == 0:
            subprocess.run(_command(records), check=True, capture_output=True)
            assert lasting_records(records) == whole
