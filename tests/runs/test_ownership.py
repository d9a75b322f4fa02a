"""Runs that meet each other, or a machine that fails: nothing is lost, and no method is blamed."""

import contextlib
import dataclasses
import errno
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from tiny import TINY

from clbench.base import lease as leases
from clbench.base.cache import CacheError, cache_folder
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.base.lease import LeaseLostError
from clbench.jobs.recorded import has_record, has_settings_of, set_aside
from clbench.learning.method import Method
from clbench.policy.policy import Policy
from clbench.records.reader import UnreadableRecordError, read_record
from clbench.records.record import SCHEMA
from clbench.records.writer import write_record, write_result
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.runs.stages import MachineError, make_stages
from clbench.scoring.scores import Scores

TOY = "clbench.testing:clbench/Toy-v0"
TYPED = f"tiny:{TINY.id}"

DEADLY = """
import dataclasses, os, signal
from clbench.learning.method import Method

@dataclasses.dataclass
class Deadly(Method):
    def start_task(self, policy, stage):
        {death}
"""

COMMAND = [sys.executable, "-m", "clbench", "run", TOY, "sft", "frozen", "--seeds", "1", "--workers", "2"]


@contextlib.contextmanager
def _largest_file(size: int) -> Iterator[None]:
    """Let no file grow beyond `size` bytes inside, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@dataclasses.dataclass
class _Raises(Method):
    """A method whose own file is missing."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        Path("/nowhere/weights").read_bytes()


@pytest.mark.slow  # 12 s: two commands with workers
def test_commands_that_start_together_do_each_run_once(tmp_path: Path) -> None:
    # their workers import the toy, pretrained in the cache of the tests
    command = [*COMMAND, "--records", str(tmp_path / "records")]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate()[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    lines = [line for text in said for line in text.splitlines()]
    for label in ("sft", "frozen"):
        ends = [line for line in lines if line.startswith(f"Toy-v0 {label} seed 0: ")]
        assert sum("adaptation" in line for line in ends) == 1, lines
        record = read_record(tmp_path / "records" / "Toy-v0" / label / "seed-0.json")
        assert record.status == "success"
    assert len(list((tmp_path / "records").rglob(".*"))) == 0


@pytest.mark.long
def test_a_full_disk_is_no_failure_of_the_method(tmp_path: Path) -> None:
    spec = RunSpec(TINY.id, "sft", seed=0)
    execute(dataclasses.replace(spec, method="frozen"), tmp_path)  # the policy and the data are in the cache
    with _largest_file(2000), pytest.raises(CacheError, match="cannot be written"):
        execute(spec, tmp_path)
    assert not spec.path(tmp_path).exists()
    assert [path for path in cache_folder().rglob("*.partial") if path.is_dir()] == []
    assert execute(spec, tmp_path).status == "success"


def test_an_error_of_the_file_system_inside_a_hook_is_a_failure_of_the_method(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(TINY.id, stranger(_Raises), seed=0), tmp_path)
    assert record.error is not None
    assert record.error["type"] == "FileNotFoundError"
    assert record.error["where"] == "prepare"


@dataclasses.dataclass
class _Waits(Method):
    """A method during which another process takes its run over, as if this machine was suspended."""

    def end_task(self, policy: Policy, stage: Any) -> None:
        for lease in (cache_folder() / "runs").glob(".*.lease"):
            lease.unlink()
        time.sleep(1.0)


@pytest.mark.long
def test_a_run_that_another_process_took_over_writes_nothing_more(
    tmp_path: Path,
    empty_caches: Path,
    stranger: Callable[[type[Method]], str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(leases, "SECONDS", 0.3)
    spec = RunSpec(TINY.id, stranger(_Waits), seed=0)
    with pytest.raises(
        LeaseLostError,
        match=r"This process lost .*: it did not answer for \d+ s and another process took over",
    ):
        execute(spec, tmp_path / "records")
    assert not (tmp_path / "records").exists()
    assert [path.name for path in cache_folder().glob("runs/*/stage-*")] == ["stage-0"]


@dataclasses.dataclass
class _StartsLate(Method):
    """A method whose run another process takes over, and begins, before this one begins."""

    def __post_init__(self) -> None:
        for lease in (cache_folder() / "runs").glob(".*.lease"):
            lease.unlink()
            (lease.parent / lease.name[1:].removesuffix(".lease") / "stage-1").mkdir(parents=True)


def test_a_run_that_another_process_took_over_before_it_began_leaves_the_stages_there(
    tmp_path: Path, empty_caches: Path, stranger: Callable[[type[Method]], str]
) -> None:
    with pytest.raises(
        LeaseLostError,
        match=r"This process lost .*: it did not answer for \d+ s and another process took over",
    ):
        execute(RunSpec(TINY.id, stranger(_StartsLate), seed=0), tmp_path)
    assert [path.name for path in cache_folder().glob("runs/*/stage-*")] == ["stage-1"]


@dataclasses.dataclass
class _Exits(Method):
    """A method that wants to end the process."""

    def end_task(self, policy: Policy, stage: Any) -> None:
        raise SystemExit(3)


@dataclasses.dataclass
class _Interrupts(Method):
    """A method that raises what Ctrl-C would."""

    def end_task(self, policy: Policy, stage: Any) -> None:
        raise KeyboardInterrupt


@pytest.mark.long
def test_an_interrupt_is_the_methods_where_ctrl_c_is_ignored_and_the_users_elsewhere(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    spec = RunSpec(TINY.id, stranger(_Interrupts), seed=0)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        record = execute(spec, tmp_path)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        with pytest.raises(KeyboardInterrupt):
            execute(spec, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert record.error is not None
    assert record.error["message"] == "The hook raised KeyboardInterrupt()."


@dataclasses.dataclass
class _Writes(Method):
    """A method that writes where there is no room."""

    _fault: ClassVar[tuple[int, str]] = errno.ENOSPC, "notes.txt"

    def end_task(self, policy: Policy, stage: Any) -> None:
        number, name = self._fault
        raise OSError(number, os.strerror(number), name)


@dataclasses.dataclass
class _Reads(_Writes):
    """A method that reads from a folder of another machine."""

    _fault: ClassVar[tuple[int, str]] = errno.ESTALE, "data.pt"


@dataclasses.dataclass
class _Computes(Method):
    """A method whose GPU fails."""

    _code: ClassVar[int] = 214

    def end_task(self, policy: Policy, stage: Any) -> None:
        error = torch.AcceleratorError("CUDA error: uncorrectable ECC error\nCompile with TORCH_USE_CUDA_DSA")
        error.error_code = self._code  # type: ignore[attr-defined]
        raise error


@dataclasses.dataclass
class _Asserts(_Computes):
    """A method whose index is out of range on a GPU."""

    _code: ClassVar[int] = 710


def test_an_assertion_on_the_gpu_is_a_failure_of_the_method(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(TINY.id, stranger(_Asserts), seed=0), tmp_path)
    assert record.error is not None
    assert record.error["where"] == "end_task() of stage 1 (right)"


def test_what_the_file_system_refuses_to_clbench_is_no_failure_of_the_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/home/colleague/stage-0")

    monkeypatch.setattr("clbench.runs.run.drop_stages", refuse)
    with pytest.raises(MachineError, match=r"denied: '/home/colleague/stage-0'\. The method is not"):
        execute(RunSpec(TINY.id, "sft", seed=0), tmp_path / "records", checkpoints=tmp_path / "kept")
    assert not (tmp_path / "records").exists()


@pytest.mark.parametrize(
    ("cls", "fault"),
    [
        (_Writes, "The machine has no room: .*No space left on device: 'notes.txt'"),
        (_Reads, "The machine failed: .*'data.pt'"),
        (_Computes, "The machine failed: CUDA error: uncorrectable ECC error"),
    ],
)
def test_a_full_disk_or_a_failing_network_is_not_the_methods_fault_and_leaves_no_record(
    tmp_path: Path, stranger: Callable[[type[Method]], str], cls: type[Method], fault: str
) -> None:
    spec = RunSpec(TINY.id, stranger(cls), seed=0)
    match = f"{fault}. The method is not to blame"
    with pytest.raises(MachineError, match=match):
        execute(spec, tmp_path)
    with pytest.raises(MachineError, match=match):
        make_stages(spec.resolve())
    assert not list(tmp_path.rglob("*.json"))


def test_a_method_that_exits_is_named_with_its_hook(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(TINY.id, stranger(_Exits), seed=0), tmp_path)
    assert record.error is not None
    assert record.error["where"] == "end_task() of stage 1 (right)"
    assert record.error["message"] == "The hook raised SystemExit(3)."


@pytest.mark.long
@pytest.mark.parametrize(
    ("death", "end"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "exit code -11, SIGSEGV"),
        pytest.param("os._exit(3)", "exit code 3", marks=pytest.mark.slow),
    ],
)
def test_a_method_that_kills_its_process_is_named_with_its_hook(
    tmp_path: Path,
    write_module: Callable[[str, str], None],
    capsys: pytest.CaptureFixture[str],
    death: str,
    end: str,
) -> None:
    write_module("deadly", DEADLY.format(death=death))
    with pytest.raises(SystemExit):
        resolve("clbench.cli.runs:run")(TYPED, "deadly:Deadly", seeds=1, records=tmp_path / "records")
    said = capsys.readouterr().err
    assert f"its process ended in stage 1 (right) without a result ({end})" in said
    assert re.search(r"0 of 1 run in \d+\.\d minutes", said)
    assert not list(tmp_path.glob("records/*/*/*.json"))


@pytest.mark.long
def test_a_run_that_fails_leaves_a_good_record_of_another_configuration_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    spec = RunSpec(TINY.id, "sft", seed=0)
    execute(spec, tmp_path)
    before = spec.path(tmp_path).read_bytes()

    def fail(*_: Any) -> None:
        raise ValueError("went wrong")

    monkeypatch.setattr("clbench.learning.trainer.Trainer.learn", fail)
    record = execute(dataclasses.replace(spec, perturb=True), tmp_path)
    assert record.status == "failed"
    assert spec.path(tmp_path).read_bytes() == before
    assert "stays: its run succeeded" in caplog.text
    assert "its record is seed-0.json.failed." in caplog.text


@pytest.mark.long
@pytest.mark.parametrize("damage", ["torn", "incomplete"])
def test_a_damaged_record_is_named_set_aside_and_made_again(
    tmp_path: Path, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = RunSpec(TINY.id, "frozen", seed=0).path(tmp_path)
    record = execute(RunSpec(TINY.id, "frozen", seed=0), tmp_path)
    if damage == "torn":
        path.write_text("{", encoding="utf-8")
    else:
        for column in record.episodes.values():
            del column[-1]
        write_record(record, path)
    damaged = path.read_bytes()
    resolve("clbench.cli.runs:run")(TYPED, "frozen", seeds=1, records=tmp_path)
    said = capsys.readouterr().err
    assert f"{path.name}.damaged, and the run is repeated." in said
    assert ("cannot be read as JSON" if damage == "torn" else "is missing at stage 2, step 8") in said
    assert path.with_name(f"{path.name}.damaged").read_bytes() == damaged
    assert Scores.from_record(read_record(path)).success.shape[0] == 3


def test_a_record_of_a_newer_clbench_stays_where_it_is(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    spec = RunSpec(TINY.id, "frozen", seed=0, targets=1)
    path = spec.path(tmp_path)
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"schema": SCHEMA + 1}))
    newer = path.read_bytes()
    for refuses in (has_record, set_aside):
        with pytest.raises(UnreadableRecordError, match=f"newer than {SCHEMA}: update clbench"):
            refuses(spec.resolve(), tmp_path)
    failed = execute(RunSpec(TINY.id, stranger(_Raises), seed=0), tmp_path / "other")
    assert failed.status == "failed"
    write_result(failed, path)
    assert path.read_bytes() == newer


def test_a_record_of_other_settings_is_kept_next_to_the_new_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spec = RunSpec(TINY.id, "frozen", seed=0, targets=1)
    path, old = spec.path(tmp_path), spec.path(tmp_path).with_name("seed-0.json.old")
    record = execute(spec, tmp_path)
    perturbed = dataclasses.replace(record, run=dataclasses.replace(record.run, perturb=True))
    write_result(perturbed, path)  # it holds all episodes of the first one
    assert read_record(path).run.perturb
    assert not old.exists()
    on_a_gpu = dataclasses.replace(record, run=dataclasses.replace(record.run, device="cuda"))
    before = path.read_bytes()
    write_result(on_a_gpu, path)
    assert read_record(path).run.device == "cuda"
    assert old.read_bytes() == before
    assert "it is kept as seed-0.json.old" in caplog.text
    write_result(record, path)
    assert read_record(path.with_name("seed-0.json.old")).run.perturb
    assert path.with_name("seed-0.json.old1").exists()


def test_a_setting_that_a_record_lacks_was_added_later(tmp_path: Path) -> None:
    spec = RunSpec(TINY.id, "frozen", seed=0, targets=1)
    record = execute(spec, tmp_path)
    settings = {name: value for name, value in record.run.settings.items() if name != "step_factor"}
    assert len(settings) < len(record.run.settings)
    older = dataclasses.replace(record, run=dataclasses.replace(record.run, settings=settings))
    write_record(older, spec.path(tmp_path))
    assert has_record(spec.resolve(), tmp_path)
    changed = dataclasses.replace(spec, changes={"step_factor": 0.5}).resolve()
    assert not has_settings_of(older, changed)


def test_records_that_are_set_aside_one_after_the_other_all_stay(tmp_path: Path) -> None:
    spec = RunSpec(TOY, "frozen", seed=0, targets=1)
    path = spec.path(tmp_path)
    path.parent.mkdir(parents=True)
    for text in ("first", "second", "third"):
        path.write_text(text)
        assert set_aside(spec.resolve(), tmp_path) is not None
    names = (f"{path.name}.damaged{number}" for number in ("", "1", "2"))
    assert [path.with_name(name).read_text() for name in names] == ["first", "second", "third"]


def test_a_damaged_record_that_cannot_be_renamed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    spec = RunSpec(TOY, "frozen", seed=0, targets=1)
    path = spec.path(tmp_path)
    path.parent.mkdir(parents=True)
    path.write_text("{")
    monkeypatch.setattr("pathlib.Path.replace", refuse)
    with pytest.raises(InputError, match=rf"^{path}: .*, and it cannot be renamed: Permission denied\.$"):
        set_aside(spec.resolve(), tmp_path)


def test_a_record_that_does_not_fit_on_the_disk_is_named_and_its_run_goes_on_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *arguments: Any, **options: Any) -> Any:
        is_record = path.is_relative_to(tmp_path)  # those of the checkpoints are in the cache
        return open("/dev/full", "w") if is_record else open(path, *arguments, **options)

    spec = RunSpec(TINY.id, "frozen", seed=0, targets=1)
    monkeypatch.setattr("clbench.records.writer.open", full, raising=False)
    with pytest.raises(
        MachineError, match=rf"has no room: .* on device: '{spec.path(tmp_path)}'\. The method"
    ):
        execute(spec, tmp_path)
    assert not list(tmp_path.rglob("*.json"))
    monkeypatch.undo()
    assert execute(spec, tmp_path).timing["resumed_after"] == 1


def test_a_run_that_lost_its_lease_at_the_end_writes_no_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lose(*_: object) -> float:
        for lease in (cache_folder() / "runs").glob(".*.lease"):
            lease.unlink()
        return 1.0

    monkeypatch.setattr("clbench.runs.run.step_ratio", lose)
    with pytest.raises(LeaseLostError):
        execute(RunSpec(TINY.id, "frozen", 0, targets=1), tmp_path)
    assert not list(tmp_path.rglob("*.json"))
