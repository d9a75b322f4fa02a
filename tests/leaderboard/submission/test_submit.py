"""Submitting: a class is checked, run within limits and placed on the board; faults are reported."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.records.paths import record_path
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record

MODULE = """
import dataclasses, time
import clbench
from clbench.spec.limits import Limits
from clbench.testing import TOY
from gymnasium.envs.registration import register

hurried = dataclasses.replace(TOY, id="clbench/Hurried-v0", limits=Limits(seconds=4.0))
kwargs = {"scenario": f"{__name__}:hurried"}
register(id=hurried.id, entry_point="clbench.worlds.scenario_env:ScenarioEnv", kwargs=kwargs)

@dataclasses.dataclass
class Mine(clbench.Method):
    '''Plain fine-tuning, under another name.'''

@dataclasses.dataclass
class Größe(Mine):
    '''Its name is not one of a row.'''

@dataclasses.dataclass
class Broken(clbench.Method):
    '''Its loss is not a scalar.'''
    def loss(self, policy, batch, progress):
        return policy.action_loss(batch)

@dataclasses.dataclass
class Sleeper(clbench.Method):
    '''It never ends.'''
    def prepare(self, policy, prior):
        time.sleep(600)
"""


@pytest.fixture(autouse=True)
def _module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "submitted.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


def submit(method: str, scenario: str = "clbench.testing:clbench/Toy-v0", **rest: Any) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").submit
    command(method, scenario=scenario, **{"seeds": 1, "workers": 1, "records": Path("board/records"), **rest})


@pytest.mark.long
def test_a_sound_class_gets_a_row_and_a_place(
    make_record: Callable[..., Record], capsys: pytest.CaptureFixture[str]
) -> None:
    submit("submitted:Mine")
    printed = capsys.readouterr()
    assert "the method keeps the contract" in printed.err
    assert "Division prior-data-free: place 1 of 1." in printed.out
    hint = "clbench run clbench.testing:clbench/Toy-v0 from_scratch --records board/records"
    assert f"Metrics that compare with from_scratch need its records: {hint}" in printed.out
    path = record_path(Path("board/records"), "clbench/Toy-v0", "submitted:Mine", 0)
    record = read_record(path)
    assert record.status == "success"
    assert "submitted:Mine" in Path("board/site/LEADERBOARD.md").read_text(encoding="utf-8")
    # the same run under another name: the two rows cannot be told apart
    record.run.method = "another:Twin"
    write_record(record, record_path(Path("board/records"), "clbench/Toy-v0", "another:Twin", 0))
    before = path.read_bytes()
    submit("submitted:Mine")
    printed = capsys.readouterr()
    assert "1 of 1 run already has a record." in printed.err
    assert "place 1 of 2; not told apart from another:Twin." in printed.out
    assert path.read_bytes() == before


@pytest.mark.slow
def test_a_record_of_older_code_is_set_aside_and_kept(capsys: pytest.CaptureFixture[str]) -> None:
    path = record_path(Path("board/records"), "clbench/Toy-v0", "submitted:Mine", 0)
    submit("submitted:Mine")
    record = read_record(path)
    record.fingerprint["method"]["source"] = "another"
    write_record(record, path)
    before = path.read_bytes()
    capsys.readouterr()
    submit("submitted:Mine")
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "the code of submitted:Mine has changed since this run. The record is renamed to seed-0.json.old"
        in said
    )
    assert path.with_name("seed-0.json.old").read_bytes() == before
    assert read_record(path).fingerprint["method"]["source"] != "another"


@pytest.mark.long
def test_a_class_that_breaks_the_contract_is_not_run(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        submit("submitted:Broken")
    assert stopped.value.code == 1
    printed = capsys.readouterr().err
    assert "No run was started: submitted:Broken breaks the contract." in printed
    assert "records in" not in printed
    assert "loss()" in printed
    assert not Path("board").exists()


@pytest.mark.slow
def test_a_method_that_goes_beyond_the_limits_of_its_scenario_is_stopped(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stopped:
        submit("submitted:Sleeper", "submitted:clbench/Hurried-v0")
    assert stopped.value.code == 1
    assert "stopped, because it took longer than 4 s" in capsys.readouterr().err
    assert not Path("board").exists()


@pytest.mark.parametrize(
    ("method", "rest", "reason"),
    [
        ("submitted:Mind", {}, "Did you mean 'Mine'?"),
        ("submited:Mine", {}, "No module 'submited' can be imported"),
        ("submitted:Größe", {}, "'submitted:Größe' cannot be the name of a method"),
        ("submitted:Mine", {"scenario": "clbench/Fetsch-v0"}, "Did you mean 'clbench/Fetch-v1'?"),
    ],
)
def test_a_wrong_word_is_named(
    method: str, rest: dict[str, Any], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        submit(method, **rest)
    assert stopped.value.code == 2
    assert reason in " ".join(capsys.readouterr().err.split())
    assert not Path("board").exists()


def test_a_link_in_the_place_of_the_board_is_refused_before_any_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("board").mkdir()
    Path("board/site").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(SystemExit) as stopped:
        submit("submitted:Mine")
    assert stopped.value.code == 2
    assert "site is a symbolic link, which is not followed" in " ".join(capsys.readouterr().err.split())
    assert not Path("board/records").exists()
