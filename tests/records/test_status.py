"""The state of runs in a folder of records."""

import dataclasses
from pathlib import Path

import pytest

from clbench.base import lease as leases
from clbench.base.lease import Lease, Owner, Report
from clbench.records.record import Costs
from clbench.records.status import RunState, found_runs, run_state, seconds_left
from clbench.records.writer import write_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.scores import Scores

TOY = "clbench.testing:clbench/Toy-v0"


@pytest.mark.long
def test_every_state_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = RunSpec(TOY, "frozen", seed=0)
    record = execute(spec, tmp_path)
    paths = [spec.path(tmp_path).with_name(f"seed-{seed}.json") for seed in range(5)]
    error = {"where": "stage 1", "type": "ValueError", "message": "went wrong", "traceback": ""}
    failed = dataclasses.replace(record, status="failed", error=error, costs=Costs())
    write_record(dataclasses.replace(failed, run=dataclasses.replace(record.run, seed=1)), paths[1])
    paths[2].write_text("{")
    lease = Lease(paths[3])
    assert lease.take()
    lease.report(0.25)
    states = [run_state(path, Scores.from_record) for path in paths]
    assert [state.state for state in states] == ["done", "failed", "damaged", "running", "to do"]
    assert states[0].seconds == record.timing["seconds"]
    assert states[1].reason == "stage 1: ValueError: went wrong"
    assert states[2].reason is not None
    assert "JSON" in states[2].reason
    assert states[3].owner is not None
    assert states[3].progress is not None
    assert states[3].progress.share == 0.25
    assert found_runs(tmp_path) == paths[:4]
    monkeypatch.setattr(leases, "REPORT_SECONDS", 0.0)
    lease.release()
    assert [path.name for path in paths[3].parent.glob(".*")] == []


@pytest.mark.long
def test_a_copy_of_a_record_under_another_name_is_not_another_run(tmp_path: Path) -> None:
    path = RunSpec(TOY, "frozen", seed=0).path(tmp_path)
    execute(RunSpec(TOY, "frozen", seed=0), tmp_path)
    copy = path.with_name("seed-5.json")
    copy.write_bytes(path.read_bytes())
    state = run_state(copy, Scores.from_record)
    assert state.state == "damaged"
    assert state.reason is not None
    assert "it is the record of Toy-v0/frozen/seed-0.json, and must be there" in state.reason


def test_the_time_left_counts_what_runs_and_what_nobody_has_begun() -> None:
    me = Owner(1, "here")
    done = RunState(Path("a"), "done", seconds=100.0)
    running = RunState(Path("b"), "running", me, Report(0.25, 30.0))
    to_do = RunState(Path("c"), "to do")
    # 90 s are left of the running one, and 2 x 100 s of the others; two are at work
    assert running.seconds_left == 90.0
    assert seconds_left([done, running, running, to_do, to_do]) == (2 * 90 + 2 * 100) / 2
    assert seconds_left([done, to_do]) is None
    assert seconds_left([running, to_do]) is None
    assert seconds_left([done, RunState(Path("b"), "running", me)]) is None
