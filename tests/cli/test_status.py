"""`clbench status`: what is done, running, failed and to do."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest

from clbench.base import lease as leases
from clbench.base.entry_points import resolve
from clbench.base.lease import Lease, Owner, Report
from clbench.cli.main import app
from clbench.cli.status import RunState, found_runs, run_state, seconds_left
from clbench.jobs.recorded import has_record
from clbench.records.reader import read_record
from clbench.records.record import Costs, Record
from clbench.records.writer import write_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

TINY = "tiny:me/Tiny-v0"
TOY = "clbench.testing:clbench/Toy-v0"


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A run of frozen."""
    return execute(RunSpec(TINY, "frozen", seed=0), tmp_path_factory.mktemp("done"))


@pytest.fixture
def records(done: Record, tmp_path: Path) -> Path:
    """Return a folder with one run of frozen that is done, and one of sft that cannot be read."""
    write_record(done, RunSpec(TINY, "frozen", seed=0).path(tmp_path))
    damaged = RunSpec(TINY, "sft", seed=0).path(tmp_path)
    damaged.parent.mkdir()
    damaged.write_text("{", encoding="utf-8")
    return tmp_path


def test_a_record_of_a_newer_clbench_is_unreadable_and_not_damaged(
    records: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    newer = RunSpec(TINY, "sft", seed=0).path(records)
    newer.write_text('{"schema": 99}', encoding="utf-8")
    resolve("clbench.cli.status:status")(records=records)
    shown = capsys.readouterr().out
    assert "me--Tiny-v0/sft/seed-0: unreadable, " in shown
    assert "2 runs: 1 done, 1 unreadable." in shown


def test_it_counts_the_runs_of_a_request_by_their_states(
    records: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lease = Lease(RunSpec(TINY, "frozen", seed=1).path(records))
    assert lease.take()
    lease.report(0.25)
    resolve("clbench.cli.status:status")(TINY, "frozen", "sft", seeds=3, records=records)
    lease.release()
    shown = capsys.readouterr().out
    assert re.search(r"me--Tiny-v0/frozen/seed-1: 25% after \d+:\d\d", shown)
    assert "me--Tiny-v0/sft/seed-0: damaged, " in shown
    assert re.search(r"6 runs: 1 done, 1 running, 1 damaged, 3 to do\. About \d+:\d\d left", shown)


def test_without_a_request_it_shows_what_is_in_the_folder(
    records: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    resolve("clbench.cli.status:status")(records=records, as_json=True)
    found = {entry["run"]: entry["state"] for entry in json.loads(capsys.readouterr().out)}
    assert found == {"me--Tiny-v0/frozen/seed-0": "done", "me--Tiny-v0/sft/seed-0": "damaged"}


def test_a_record_that_run_would_do_again_is_not_done(
    records: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = RunSpec(TINY, "frozen", seed=0).path(records)
    record = read_record(path)
    for column in record.episodes.values():
        del column[-1]
    write_record(record, path)
    assert not has_record(RunSpec(TINY, "frozen", seed=0).resolve(), records)
    resolve("clbench.cli.status:status")(records=records)
    assert "me--Tiny-v0/frozen/seed-0: damaged, " in capsys.readouterr().out


def test_a_record_of_other_settings_is_not_that_of_the_run(
    done: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = {**done.run.settings, "step_factor": 0.25}
    other = dataclasses.replace(done, run=dataclasses.replace(done.run, settings=settings))
    write_record(other, RunSpec(TINY, "frozen", seed=0).path(tmp_path))
    assert not has_record(RunSpec(TINY, "frozen", seed=0).resolve(), tmp_path)
    resolve("clbench.cli.status:status")(TINY, "frozen", seeds=1, records=tmp_path)
    shown = capsys.readouterr().out
    assert (
        "me--Tiny-v0/frozen/seed-0: to do, its record has different settings, budget, device or code" in shown
    )
    assert "1 run: 1 to do." in shown
    resolve("clbench.cli.status:status")(records=tmp_path)
    assert "1 run: 1 done." in capsys.readouterr().out


@pytest.mark.parametrize("option", [{"device": "cuda"}, {"perturb": True}])
def test_status_and_run_agree_on_the_device_and_on_perturbed_episodes(
    option: dict[str, Any], records: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = resolve("clbench.cli.status:status")
    for spec, asked in ((RunSpec(TINY, "frozen", 0, **option), option), (RunSpec(TINY, "frozen", 0), {})):
        status(TINY, "frozen", seeds=1, records=records, **asked)
        done = has_record(spec.resolve(), records)
        assert f"1 run: 1 {'done' if done else 'to do'}." in capsys.readouterr().out
        assert done == (not asked)


def test_a_record_of_another_device_is_to_do_as_run_repeats_it(
    done: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = dataclasses.replace(done, run=dataclasses.replace(done.run, device="cuda"))
    write_record(other, RunSpec(TINY, "frozen", seed=0).path(tmp_path))
    resolve("clbench.cli.status:status")(TINY, "frozen", seeds=1, records=tmp_path)
    assert "1 run: 1 to do." in capsys.readouterr().out
    resolve("clbench.cli.status:status")(TINY, "frozen", seeds=1, records=tmp_path, device="cuda")
    assert "1 run: 1 done." in capsys.readouterr().out


def test_a_record_of_another_definition_which_run_refuses_is_not_done(
    records: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("clbench.jobs.recorded.other_parts", lambda *_: ["worlds"])
    resolve("clbench.cli.status:status")(TINY, "frozen", seeds=1, records=records)
    shown = capsys.readouterr().out
    assert "me--Tiny-v0/frozen/seed-0: unreadable, " in shown
    assert "was made with another definition of me/Tiny-v0: worlds differ." in shown


def test_a_scenario_alone_shows_its_runs_in_the_folder(
    records: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = records / "Toy-v0" / "sft" / "seed-0.json"
    sized = records / "me--Tiny-v0+flow-base" / "sft" / "seed-7.json"
    for path in (other, sized):
        path.parent.mkdir(parents=True)
        path.write_text("{", encoding="utf-8")
    resolve("clbench.cli.status:status")(TINY, records=records, as_json=True)
    found = {entry["run"]: entry["state"] for entry in json.loads(capsys.readouterr().out)}
    assert found == {
        "me--Tiny-v0/frozen/seed-0": "done",
        "me--Tiny-v0/sft/seed-0": "damaged",
        "me--Tiny-v0+flow-base/sft/seed-7": "damaged",
    }


def test_a_scenario_without_runs_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        resolve("clbench.cli.status:status")("clbench/Fetch-v1", records=tmp_path)
    said = " ".join(capsys.readouterr().err.split())
    assert "There are no runs of clbench/Fetch-v1 in" in said


def test_an_empty_folder_is_said_to_be_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        resolve("clbench.cli.status:status")(records=tmp_path)
    assert stopped.value.code == 2
    assert "There are no runs in" in capsys.readouterr().err


@pytest.mark.parametrize(
    "option", [["--all"], ["--seeds", "2"], ["--set.step_factor", "2"], ["--perturb"], ["--device", "cuda"]]
)
def test_an_option_that_chooses_among_the_runs_of_a_scenario_needs_one(
    option: list[str], records: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(".")  # and take back what the command puts there
    with pytest.raises(SystemExit) as stopped:
        app(["status", "--records", str(records), *option])
    assert stopped.value.code == 2
    expected = f"{option[0]} needs a scenario: name the scenario first."
    assert expected in " ".join(capsys.readouterr().err.split())


def test_a_long_reason_is_cut_and_names_the_record(
    done: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = {"where": "stage 1", "type": "ValueError", "message": "x" * 3000, "traceback": ""}
    path = RunSpec(TINY, "frozen", seed=0).path(tmp_path)
    write_record(dataclasses.replace(done, status="failed", error=error), path)
    resolve("clbench.cli.status:status")(records=tmp_path)
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "failed, stage 1" in line)
    assert len(line) < 600
    assert line.endswith("xxx [... me--Tiny-v0/frozen/seed-0.json has the rest]")


def test_names_of_folders_control_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "\x1b[2JToy" / "a[b]"
    folder.mkdir(parents=True)
    (folder / "seed-0.json").write_text("{", encoding="utf-8")
    resolve("clbench.cli.status:status")(records=tmp_path)
    shown = capsys.readouterr().out
    assert "\x1b[2J" not in shown
    assert r"\x1b[2JToy/a[b]/seed-0: damaged" in shown


def test_a_long_name_of_a_scenario_hides_no_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / f"me--{'Long' * 20}-v0" / "frozen"
    folder.mkdir(parents=True)
    (folder / "seed-0.json").write_text("{", encoding="utf-8")
    monkeypatch.setenv("COLUMNS", "80")
    resolve("clbench.cli.status:status")(records=tmp_path)
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    assert any("│ frozen │" in row for row in rows)


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
    states = [run_state(path) for path in paths]
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
    state = run_state(copy)
    assert state.state == "damaged"
    assert state.reason is not None
    assert "it belongs at Toy-v0/frozen/seed-0.json in the folder of records" in state.reason


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
