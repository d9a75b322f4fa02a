"""The state of runs: which have a record, which are being done, and which failed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal, NamedTuple

from clbench.base.lease import Lease, Owner, Report, lease_path
from clbench.records.reader import RecordError, UnreadableRecordError, check_home, read_record
from clbench.records.record import Record

State = Literal["done", "running", "failed", "damaged", "unreadable", "to do"]


OTHER_SETTINGS = "the record there has other settings, budget or code: `clbench run` replaces it"
"""Reason of a run that is to do although its place has a record."""


class RunState(NamedTuple):
    """The state of one run."""

    path: Path
    """Path of its record."""
    state: State
    """A run is damaged if its record is torn or contradicts itself; `clbench run` does it again. It is
    unreadable if its record may be sound: it is of a newer clbench, or the file system refuses it."""
    owner: Owner | None = None
    """Process that does the run."""
    progress: Report | None = None
    """How far that process is, None if it has not told yet."""
    seconds: float | None = None
    """Seconds that a run with a record took."""
    reason: str | None = None
    """Why a run failed, or why its record cannot be read."""

    @property
    def seconds_left(self) -> float | None:
        """Seconds that a running run needs, None if they are unknown."""
        if self.progress is None or not 0 < self.progress.share <= 1:
            return None
        return self.progress.seconds * (1 / self.progress.share - 1)


def run_state(
    path: Path, check: Callable[[Record], object], is_wanted: Callable[[Record], bool] = lambda _: True
) -> RunState:
    """Return the state of the run whose record has the path.

    Args:
        path: Path of the record.
        check: Refuses the record of a run that succeeded with a `RecordError` if it contradicts itself, such
            as `Scores.from_record`.
        is_wanted: Returns whether such a record is the one that is asked for.
    """
    lease = Lease(path)
    owner = lease.owner
    if owner is not None:
        return RunState(path, "running", owner, lease.progress)
    if not path.exists():
        return RunState(path, "to do")
    try:
        record = read_record(path)
        check_home(record.run, path)
        if record.error is None:
            check(record)
            if not is_wanted(record):
                return RunState(path, "to do", reason=OTHER_SETTINGS)
    except UnreadableRecordError as error:
        return RunState(path, "unreadable", reason=str(error))
    except RecordError as error:
        return RunState(path, "damaged", reason=str(error))
    seconds = record.timing.get("seconds")
    if seconds is not None and not isinstance(seconds, int | float):
        return RunState(path, "damaged", reason=f"timing: seconds must be a number, not {seconds!r}")
    if record.error is not None:
        return RunState(path, "failed", seconds=seconds, reason=record.failure)
    return RunState(path, "done", seconds=seconds)


def found_runs(records: Path) -> list[Path]:
    """Return the paths of the records below a folder, and of those that are being made."""
    made = set(records.glob("*/*/seed-*.json"))
    running = {
        path.with_name(path.name.removeprefix(".").removesuffix(".lease"))
        for path in records.glob(f"*/*/{lease_path(Path('seed-*.json')).name}")
    }
    return sorted(made | running)


def seconds_left(states: Iterable[RunState]) -> float | None:
    """Return the seconds until all runs are done by the processes that are at work, None if unknown.

    A run that is to do takes the mean of the runs that are done.
    """
    states = list(states)
    running = [state for state in states if state.state == "running"]
    known = [state.seconds for state in states if state.state == "done" and state.seconds is not None]
    open_runs = sum(state.state in ("to do", "damaged") for state in states)
    left = [state.seconds_left for state in running]
    if not running or (open_runs and not known) or None in left:
        return None
    mean = sum(known) / len(known) if known else 0.0
    return (sum(value for value in left if value is not None) + open_runs * mean) / len(running)
