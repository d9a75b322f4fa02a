"""`clbench.run`: a method from Python, even one that no other process can import."""

import importlib
import io
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from rich.console import Console
from torch import nn

import clbench
from clbench.base.errors import ClbenchError
from clbench.base.leftovers import unfinished
from clbench.base.progress import ProgressCallback
from clbench.jobs.grid import missing, run_missing
from clbench.jobs.job import Job
from clbench.jobs.processes import Here
from clbench.jobs.scheduler import run_with_bars
from clbench.learning.method import Stage
from clbench.policy.policy import Policy
from clbench.records.writer import write_record
from clbench.runs.run import execute
from clbench.runs.spec import ResolvedRun, RunSpec
from clbench.runs.stages import has_stages, keep_stages
from clbench.spec.limits import Limits

TOY = "clbench.testing:clbench/Toy-v0"
TINY = "tiny:me/Tiny-v0"

METHOD = """
from dataclasses import dataclass

import clbench


@dataclass
class Slow(clbench.Method):
    step_factor: float = 0.5
"""

SCRIPT = f"""{METHOD}

(record,) = clbench.run("{TOY}", Slow, seeds=1, records="records")
print(record.run.method, record.status, record.run.seed, record.run.settings["step_factor"])
"""


def run_script(text: str, folder: Path) -> subprocess.CompletedProcess[str]:
    (folder / "script.py").write_text(text, encoding="utf-8")
    command = [sys.executable, "script.py"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)


@pytest.mark.slow  # 19 s: three processes, each imports PyTorch
def test_a_class_of_the_script_itself_runs_and_its_change_is_noticed(tmp_path: Path) -> None:
    execute(RunSpec(TOY, "frozen", 0), tmp_path)  # all that the runs need is in the cache
    result = run_script(SCRIPT, tmp_path)
    assert result.stdout == "__main__:Slow success 0 0.5\n"  # once: no process did the script again
    again = run_script(SCRIPT, tmp_path)
    assert "1 of 1 run already has a record." in again.stderr
    changed = run_script(SCRIPT.replace("0.5", "0.25", 1), tmp_path)
    assert changed.stdout == "__main__:Slow success 0 0.25\n"
    assert (
        "the code of __main__:Slow has changed since this run. The record is renamed to seed-0.json.old"
        in changed.stderr
    )
    kept = sorted(path.name for path in (tmp_path / "records").rglob("*.json*"))
    assert kept == ["seed-0.json", "seed-0.json.old"]


@pytest.mark.long
def test_a_class_of_a_module_runs_in_processes_and_its_change_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "slow.py").write_text(METHOD, encoding="utf-8")
    module = importlib.import_module("slow")
    (record,) = clbench.run(TINY, module.Slow, seeds=1, records=tmp_path / "records")
    assert (record.run.method, record.run.seed) == ("slow:Slow", 0)
    assert clbench.run(TINY, module.Slow, seeds=1, records=tmp_path / "records") == [record]
    (tmp_path / "slow.py").write_text(f"{METHOD}    _speed = 1\n", encoding="utf-8")
    capsys.readouterr()
    (again,) = clbench.run(TINY, importlib.reload(module).Slow, seeds=1, records=tmp_path / "records")
    assert "the code of slow:Slow has changed since" in capsys.readouterr().err
    assert again.fingerprint["method"] != record.fingerprint["method"]
    assert again.episodes == record.episodes


@pytest.mark.long
def test_an_installed_method_is_named_by_its_class(tmp_path: Path) -> None:
    settings = {"step_factor": 0.5}
    records = clbench.run(
        TINY, clbench.load_method("frozen"), seeds=1, first_seed=3, settings=settings, records=tmp_path
    )
    assert [(one.run.method, one.run.seed, one.run.changes) for one in records] == [("frozen", 3, settings)]


@pytest.mark.long
def test_a_failed_run_raises_with_its_reason(
    tmp_path: Path, write_module: Callable[[str, str], None]
) -> None:
    loss = """
    def loss(self, policy, batch, progress):
        raise ArithmeticError("no loss today")
"""
    write_module("lossless", METHOD + loss)
    with pytest.raises(clbench.RunsFailedError, match=r"Slow seed 0: .*ArithmeticError: no loss today"):
        clbench.run(TINY, "lossless:Slow", seeds=1, records=tmp_path / "records")


@pytest.mark.long
def test_a_method_that_changes_the_folder_leaves_its_record_where_it_was_asked_for(
    tmp_path: Path, write_module: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    start_task = """
    def start_task(self, policy, stage):
        import os
        os.chdir("/")
        return policy.parameters()
"""
    write_module("moving", METHOD + start_task)
    monkeypatch.chdir(tmp_path)
    (record,) = clbench.run(TINY, "moving:Slow", seeds=1, records="records", workers=1)
    assert record.status == "success"
    assert (tmp_path / "records/me--Tiny-v0/moving.Slow/seed-0.json").is_file()


@pytest.mark.long
def test_a_class_of_the_script_that_changes_the_folder_leaves_its_record_where_it_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass
    class Moving(clbench.Method):
        def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
            os.chdir("/")
            return policy.parameters()

    Moving.__module__, Moving.__qualname__ = "__main__", "Moving"
    monkeypatch.setattr(sys.modules["__main__"], "Moving", Moving, raising=False)
    monkeypatch.chdir(tmp_path)
    (record,) = clbench.run(TINY, Moving, seeds=1, records="records")
    assert record.status == "success"
    assert (tmp_path / "records/me--Tiny-v0/__main__.Moving/seed-0.json").is_file()


def test_runs_that_failed_are_not_counted_and_neither_are_the_jobs_that_they_share(
    tmp_path: Path, empty_caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [RunSpec(TOY, method, 1).resolve() for method in ("sft", "frozen")]

    def fail(jobs: Sequence[Job], *_: Any) -> dict[Job, str]:
        """Let the pretraining and one run fail; the other one ends without a record."""
        pretraining = next(job for job in jobs if "pretraining" in job.title)
        return {pretraining: "no room", next(job for job in jobs if job.product): "no room"}

    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", fail)
    console = Console(file=io.StringIO(), width=200)
    failed = run_missing(runs, tmp_path / "records", Here, console)
    assert len(failed) == 3
    assert isinstance(console.file, io.StringIO)
    lost, last = console.file.getvalue().splitlines()
    assert "it ended without a record of this run at" in lost
    assert re.match(r"0 of 2 runs in \d+\.\d minutes; records in ", last)


def test_after_a_check_that_fails_no_run_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(jobs: Sequence[Job], *_: Any) -> dict[Job, str]:
        return dict.fromkeys(jobs, "left out")

    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", fail)
    check, console = Job("check", str, {}, 1.0), Console(file=io.StringIO(), width=200)
    failed = run_missing([RunSpec(TOY, "sft", 1).resolve()], tmp_path, Here, console, check=check)
    assert check in failed
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue() == ""


def test_what_killed_commands_left_beside_records_and_policies_is_removed(
    tmp_path: Path, empty_caches: Path
) -> None:
    left = []
    for folder in (tmp_path / "records", tmp_path / "kept"):
        folder.mkdir()
        path = unfinished(folder / "made")
        left.append(path.with_name(path.name.replace(f"{os.getpid():08x}", f"{2**22 - 1:08x}", 1)))
        left[-1].touch()
    run_missing([], tmp_path / "records", Here, Console(file=io.StringIO()), checkpoints=tmp_path / "kept")
    assert not any(path.exists() for path in left)


@pytest.mark.long
@pytest.mark.parametrize("first", ["edit", "run"])
def test_a_method_that_is_edited_before_its_run_begins_or_ends_is_named(
    first: str, tmp_path: Path, write_module: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "edited", raising=False)
    write_module("edited", METHOD)
    run = RunSpec(TINY, "edited:Slow", 0).resolve()

    def edit_and_run(*_: Any) -> dict[Job, str]:
        """Do the run as another process would, which imports the module anew."""
        if first == "run":
            execute(run, tmp_path)
        write_module("edited", METHOD.replace("0.5", "0.25"))
        if first == "edit":
            importlib.reload(sys.modules["edited"])
            execute(RunSpec(TINY, "edited:Slow", 0), tmp_path)
        return {}

    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", edit_and_run)
    (reason,) = run_missing([run], tmp_path, Here, Console(file=io.StringIO())).values()
    assert "has other code or settings of edited:Slow than this command began with" in reason


@pytest.mark.long
def test_a_record_that_another_command_wrote_for_another_device_is_no_sign_of_an_edit(
    tmp_path: Path, write_module: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_module("unedited", METHOD)
    spec = RunSpec(TINY, "unedited:Slow", 0)
    record = execute(spec, tmp_path)
    record.run.device = "cuda"
    write_record(record, spec.path(tmp_path))
    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", lambda *_: {})
    (reason,) = run_missing([spec.resolve()], tmp_path, Here, Console(file=io.StringIO())).values()
    assert reason.startswith("it ended without a record of this run")


def test_inputs_that_fail_are_tried_once_and_told_once(
    tmp_path: Path, empty_caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def fail(jobs: Sequence[Job], *_: Any) -> dict[Job, str]:
        calls.append([job.title for job in jobs])
        return dict.fromkeys(jobs, "no room")

    monkeypatch.setattr(sys.modules["__main__"], "Typed", clbench.load_method("frozen"), raising=False)
    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", fail)
    with pytest.raises(clbench.RunsFailedError) as failed:
        clbench.run(TOY, "__main__:Typed", seeds=1, records=tmp_path / "records")
    (titles,) = calls
    assert "Toy-v0 pretraining seed 0" in titles
    assert str(failed.value).splitlines() == [f"{title}: no room" for title in titles]


def test_records_are_read_twice_at_most_if_no_policies_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = []

    def look(run: ResolvedRun, _: Path) -> bool:
        reads.append(run.spec.seed)
        return False

    for module in ("grid", "plan"):
        monkeypatch.setattr(f"clbench.jobs.{module}.has_record", look)
    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", lambda *_: {})
    runs = [RunSpec(TOY, "frozen", seed).resolve() for seed in range(2)]
    run_missing(runs, tmp_path / "records", Here, Console(file=io.StringIO()))
    assert sorted(reads) == [0, 0, 1, 1]  # before the jobs and after them


def test_a_class_inside_a_function_is_refused(tmp_path: Path) -> None:
    class Hidden(clbench.Method):
        pass

    with pytest.raises(TypeError, match="cannot be imported by its name: define the class at the top"):
        clbench.run(TOY, Hidden, records=tmp_path)


@pytest.mark.long
def test_a_run_of_another_command_that_kept_no_policies_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, records = RunSpec(TINY, "frozen", 0), tmp_path / "records"

    def elsewhere(jobs: Sequence[Job], *_: Any) -> dict[Job, str]:
        """Do the run as another command does, which names no folder for policies."""
        execute(spec, records)
        return {}

    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", elsewhere)
    printed = io.StringIO()
    console = Console(file=printed, width=200)
    failed = run_missing([spec.resolve()], records, Here, console, tmp_path / "kept")
    assert f"Another command did 1 run but kept no policies in {tmp_path / 'kept'}." in printed.getvalue()
    ((job, reason),) = failed.items()
    assert str(job) == "me--Tiny-v0 frozen seed 0"
    assert reason.startswith("another command did this run but kept no policies in ")
    monkeypatch.undo()
    printed = io.StringIO()
    run_missing([spec.resolve()], records, Here, Console(file=printed, width=200), tmp_path / "kept")
    assert has_stages(spec.resolve(), tmp_path / "kept")
    assert "Another command" not in printed.getvalue()


@pytest.mark.long
def test_policies_that_another_command_has_made_again_meanwhile_are_not_made_twice(tmp_path: Path) -> None:
    run, records, kept = RunSpec(TINY, "frozen", 0).resolve(), tmp_path / "records", tmp_path / "kept"
    execute(run, records)
    jobs = missing([run], records, kept).plan(records, kept).jobs
    keep_stages(run, kept)  # the other command began at the same time, and was faster
    before = {path: path.stat().st_ino for path in kept.rglob("*")}
    printed = io.StringIO()
    assert run_with_bars(jobs, Here(), Console(file=printed, width=200)) == {}
    assert "me--Tiny-v0 stages of frozen seed 0: done by another command" in printed.getvalue()
    assert {path: path.stat().st_ino for path in kept.rglob("*")} == before


@pytest.mark.long
def test_making_policies_of_a_submitted_method_again_has_the_limits_of_its_check(tmp_path: Path) -> None:
    run, records, kept = RunSpec(TINY, "frozen", 0).resolve(), tmp_path / "records", tmp_path / "kept"
    execute(run, records)
    limits = Limits(seconds=60.0)
    check = Job("check", str, {}, 1.0, limits=limits)
    *_, stages = missing([run], records, kept).plan(records, kept, check=check).jobs
    assert (stages.title, stages.limits) == ("me--Tiny-v0 stages of frozen seed 0", limits)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seeds": 1.5}, "seeds must be a whole number from 1, not 1.5"),
        ({"seeds": 0}, "seeds must be a whole number from 1, not 0"),
        ({"seeds": 10_001}, "seeds must be at most 10,000, not 10001"),
        ({"seeds": 10_000, "method": "stf"}, "Did you mean 'sft'"),  # so many may be asked for
        ({"seeds": np.int64(10_001)}, "seeds must be at most 10,000, not 10001"),
        (
            {"first_seed": 2**64},
            "RunSpec.seed must be at most 18446744073709551615, not 18446744073709551616",
        ),
        ({"workers": True}, "workers must be a whole number from 1, not True"),
        ({"first_seed": -1}, "seed must be at least 0, not -1"),
        ({"scenario": "clbench/Fetsh-v1"}, "Did you mean 'clbench/Fetch-v1'"),
        ({"method": "stf"}, "Did you mean 'sft'"),
        ({"method": 3}, "A method must be a class or the name of a method, not 3"),
        ({"device": "mps"}, "The device 'mps' cannot be used: runs are reproducible only on cpu and cuda"),
    ],
)
def test_wrong_values_are_named_before_anything_runs(
    tmp_path: Path, wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(ClbenchError, match=message):
        clbench.run(**{"scenario": TOY, "method": "sft", "records": tmp_path, **wrong})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("call", ['run("clbench/Fetsh-v1", "sft")', f'compare("{TOY}", "frosen")'])
def test_a_wrong_name_does_not_wait_for_pytorch(tmp_path: Path, call: str) -> None:
    caught = f"try: clbench.{call}\nexcept LookupError as error: print(error, 'torch' in sys.modules)"
    said = run_script(f"import sys, clbench\n{caught}", tmp_path).stdout
    assert "Did you mean" in said
    assert said.endswith(" False\n")


def test_a_job_of_this_process_ends_when_its_worker_is_closed() -> None:
    reached = []

    def endless(progress: ProgressCallback) -> str:
        while True:
            progress(1.0)
            reached.append(1)

    worker = Here()
    worker.start(Job("endless", endless, {}, 1.0))
    assert worker.free() == 0
    next(worker.events())
    worker.close()
    count = len(reached)
    assert count > 0
    time.sleep(0.05)  # in which a job that still ran would go on
    assert len(reached) == count


MINE = """
import dataclasses

import clbench
from clbench.testing import TOY

SCENARIO = dataclasses.replace(TOY, id="me/Imported-v0")
clbench.register("me/Imported-v0", f"{__name__}:SCENARIO")
"""


@pytest.mark.long
def test_other_processes_import_the_scenario_that_the_program_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(gymnasium.registry, "me/Imported-v0", None)  # the end of the test forgets it
    del gymnasium.registry["me/Imported-v0"]
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "imported_scenario.py").write_text(MINE, encoding="utf-8")
    importlib.import_module("imported_scenario")
    (record,) = clbench.run("me/Imported-v0", "frozen", seeds=1, records=tmp_path / "records")
    assert (record.status, record.run.scenario) == ("success", "me/Imported-v0")


def test_what_a_notebook_defines_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(gymnasium.registry, "me/Typed-v0", None)  # the end of the test forgets it
    del gymnasium.registry["me/Typed-v0"]
    clbench.register("me/Typed-v0", "__main__:SCENARIO")
    message = "me/Typed-v0 is defined in a notebook or script, which other processes cannot import: put it"
    with pytest.raises(ValueError, match=message):
        clbench.run("me/Typed-v0", "frozen", records=tmp_path)
    with pytest.raises(ValueError, match="A policy must be in a module"):
        clbench.run(TOY, "frozen", policy="__main__:Policy", records=tmp_path)
    assert list(tmp_path.iterdir()) == []
