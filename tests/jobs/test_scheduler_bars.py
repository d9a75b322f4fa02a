"""What the scheduler shows: bars that count each job once, and a line for each job that is left out."""

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from clbench.base.lease import Lease
from clbench.jobs.bars import Bars
from clbench.jobs.job import Ending, Event, Job, Product
from clbench.jobs.scheduler import run_jobs


class Scripted:
    """One worker that reports half of a job, and then ends it as told; every job without an ending is done.

    Args:
        endings: How each start of a job ends, by title.
    """

    def __init__(self, **endings: list[Ending]) -> None:
        self._endings = endings
        self._events: list[Event] = []

    def free(self) -> int:
        return 0 if self._events else 1

    def start(self, job: Job) -> None:
        left = self._endings.get(job.title)
        ending = left.pop(0) if left else "done"
        self._events += [Event(job, "progress", job.length / 2), Event(job, ending, "it ended")]

    def events(self) -> Iterator[Event]:
        while self._events:
            yield self._events.pop(0)

    def close(self) -> None:
        pass


def _lines(jobs: list[Job], workers: Scripted, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Do the jobs, and return what is printed, with the share of all work at each step."""
    monkeypatch.setattr("clbench.jobs.bars.LINE_SECONDS", 0.0)
    monkeypatch.setattr("clbench.jobs.bars.AT_ONCE", 0.0)  # these jobs take no second, and count all the same
    file = io.StringIO()
    with Bars(sum(job.duration for job in jobs), Console(file=file, width=200)) as bars:
        run_jobs(jobs, workers, bars)
        bars.tick()
    return file.getvalue().splitlines()


def test_a_job_that_is_left_out_is_named_and_counts_as_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = Job("wrong", str, {}, 60.0)
    hopeless = Job("hopeless", str, {}, 30.0, (wrong,))
    jobs = [wrong, hopeless, Job("worse", str, {}, 10.0, (hopeless,)), Job("fine", str, {}, 20.0)]
    lines = _lines(jobs, Scripted(wrong=["failed"]), monkeypatch)
    assert "hopeless: left out, because wrong failed" in lines
    assert "worse: left out, because hopeless failed" in lines
    assert lines[-1].startswith("100%")


def test_jobs_that_are_left_out_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = Job("wrong", str, {}, 60.0)
    jobs = [wrong, *(Job(f"hopeless {number}", str, {}, 10.0, (wrong,)) for number in range(3))]
    lines = _lines(jobs, Scripted(wrong=["failed"]), monkeypatch)
    assert not any("waiting for" in line for line in lines)


def test_a_job_without_events_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(Scripted):
        """A worker that says nothing at its first look."""

        looks = 0

        def events(self) -> Iterator[Event]:
            self.looks += 1
            return iter(()) if self.looks == 1 else super().events()

    first, *_ = _lines([Job("patient", str, {}, 10.0)], Silent(), monkeypatch)
    assert first == "  0%: patient"


def test_other_commands_are_told_which_share_of_a_job_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares: list[float] = []
    monkeypatch.setattr(Lease, "report", lambda lease, share: shares.append(share))
    made = Product(tmp_path / "made", exists=lambda: False)
    _lines([Job("run", str, {}, 10.0, product=made)], Scripted(), monkeypatch)
    assert shares == [0.5]


def test_a_job_that_another_process_takes_over_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [Job("taken", str, {}, 110.0), Job("other", str, {}, 90.0)]
    lines = _lines(jobs, Scripted(taken=["taken", "done"]), monkeypatch)
    shares = [line[:4] for line in lines if line[:3].strip().isdecimal()]
    # half of the first job, taken back, and both from the start
    assert list(dict.fromkeys(shares)) == [" 28%", "  0%", " 22%", " 45%", " 72%", "100%"]
