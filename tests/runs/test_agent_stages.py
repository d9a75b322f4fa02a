"""Stages of agents that learn by trial and error: in order, one program at a time, and none is lost."""

import dataclasses
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from agents import ID, LEARNED, Knowing, stage_env

import clbench
from clbench.base.errors import InputError
from clbench.base.lease import LeaseLostError
from clbench.cli.status import found_runs
from clbench.evaluation.definition import definition
from clbench.records.reader import RecordError, read_record
from clbench.records.record import Costs
from clbench.runs.agents import next_stage
from clbench.runs.spec import describe_scenario


def test_stages_are_evaluated_once_and_in_order(evaluate: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="Stage 0 of me/knows, seed 0, on clbench/Toy-v0 comes next, not 1"):
        evaluate(Knowing(), stage_env(1))
    evaluate(Knowing(), stage_env(0))
    evaluate(Knowing(), stage_env(1))
    with pytest.raises(ValueError, match=r"Stage 2 of .* comes next, not 1: the last evaluated stage is 1"):
        evaluate(Knowing(), stage_env(1))
    with pytest.raises(ValueError, match=r"settings of .* are \{'speed': 4\}, but were \{\} in stage 0"):
        evaluate(Knowing(), stage_env(2), settings={"speed": 4})


@pytest.mark.long
def test_a_finished_record_is_never_edited(evaluate: Callable[..., Any]) -> None:
    for stage in range(3):
        evaluate(Knowing(), stage_env(stage))
    for stage in (0, 2):
        with pytest.raises(ValueError, match=r"already has a record, .*seed-0\.json, which is never edited"):
            evaluate(Knowing(), stage_env(stage))
    evaluate(Knowing(), stage_env(0), seed=1)


def files_below(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_stages_lie_beside_their_record_and_need_no_cache(
    evaluate: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate(Knowing(), stage_env(0))
    monkeypatch.setenv("CLBENCH_CACHE", str(tmp_path / "another cache"))
    moved = tmp_path / "moved"
    shutil.copytree(tmp_path / "records", moved, ignore=shutil.ignore_patterns("*.lease"))
    for records in (tmp_path / "records", moved):
        assert next_stage(ID, method="me/knows", records=records) == 1
    evaluate(Knowing(), stage_env(1), records=moved)
    assert next_stage(ID, method="me/knows", records=moved) == 2


def test_new_code_of_learning_and_another_pytorch_discard_no_stage(
    evaluate: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate(Knowing(), stage_env(0))
    monkeypatch.setattr("clbench.learning.trainer.source_hash", lambda *_: "newer")
    monkeypatch.setattr("clbench.runs.fingerprint.versions", lambda names: dict.fromkeys(names, "9.9"))
    assert next_stage(ID, method="me/knows", records=tmp_path / "records") == 1
    evaluate(Knowing(), stage_env(1))


@pytest.mark.parametrize(
    ("name", "other", "reason"),
    [
        ("clbench.runs.fingerprint.rollout_hash", lambda *_: "0123", "clbench.testing:ToyWorld differ"),
        (
            "clbench.evaluation.definition.definition",
            lambda scenario: {**definition(scenario), "task left": "0123"},
            "task left differ",
        ),
        (
            "clbench.runs.agents.describe_scenario",
            lambda scenario: dataclasses.replace(
                describe_scenario(scenario), budget={**dataclasses.asdict(scenario.budget), "batch_size": 99}
            ),
            "budget differ",
        ),
    ],
)
def test_stages_of_another_scenario_or_simulator_are_refused_with_the_reason(
    name: str,
    other: Any,
    reason: str,
    evaluate: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evaluate(Knowing(), stage_env(0))
    monkeypatch.setattr(name, other)
    monkeypatch.setattr("clbench.runs.agents.simulator_versions", lambda _: {"numpy": "9.9"})
    reason += ", numpy was .* and is 9.9 now"
    message = (
        rf"Stage 0 of me/knows, seed 0, on clbench/Toy-v0 was evaluated with another version of .*{reason}"
    )
    with pytest.raises(InputError, match=message):
        next_stage(ID, method="me/knows", records=tmp_path / "records")
    with pytest.raises(InputError, match=message):
        evaluate(Knowing(), stage_env(1))
    evaluate(Knowing(), stage_env(0))
    assert next_stage(ID, method="me/knows", records=tmp_path / "records") == 1


def test_a_run_with_a_damaged_file_can_only_start_over(
    evaluate: Callable[..., Any], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    evaluate(Knowing(), stage_env(0))
    (path,) = (tmp_path / "records").rglob("*.unfinished")
    path.write_bytes(path.read_bytes()[:100])
    again = (
        r"seed-0\.json\.unfinished: cannot be read as JSON .* Evaluate all stages again .* or remove the file"
    )
    with pytest.raises(RecordError, match=again):
        next_stage(ID, method="me/knows", records=tmp_path / "records")
    with pytest.raises(RecordError, match=again):
        evaluate(Knowing(), stage_env(1))
    evaluate(Knowing(), stage_env(0))
    assert "starts over: its unfinished record is damaged" in caplog.text
    assert next_stage(ID, method="me/knows", records=tmp_path / "records") == 1


@pytest.mark.long
def test_evaluating_stage_0_again_starts_over(
    evaluate: Callable[..., Any], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for stage in range(2):
        evaluate(Knowing(), stage_env(stage))
    evaluate(Knowing(*LEARNED[0]), stage_env(0))
    assert "me/knows, seed 0, on clbench/Toy-v0 starts over: its stages 0 to 1 are dropped." in caplog.text
    assert next_stage(ID, method="me/knows", records=tmp_path / "records") == 1


def test_starting_over_with_an_agent_that_cannot_act_loses_no_stage(
    evaluate: Callable[..., Any], tmp_path: Path
) -> None:
    for stage in range(2):
        evaluate(Knowing(), stage_env(stage))
    with pytest.raises(ValueError, match="action has the shape"):
        evaluate(lambda _: [0.0], stage_env(0))
    assert next_stage(ID, method="me/knows", records=tmp_path / "records") == 2


KILLED = """
import os, sys, gymnasium, clbench
for stage in range(clbench.next_stage("{id}", method="me/still", records="records"), 3):
    if stage == {last}:
        os._exit(9)
    env = gymnasium.make("{id}", stage=stage)
    clbench.evaluate_agent(lambda _: [0, 0], env, method="me/still", steps=stage, records="records")
"""


@pytest.mark.slow
def test_a_killed_program_continues_with_the_stage_that_was_running(empty_caches: Path) -> None:
    environment = {**os.environ, "CLBENCH_CACHE": str(empty_caches / "cache")}

    def run(last: int) -> int:
        command = [sys.executable, "-c", KILLED.format(id=ID, last=last)]
        return subprocess.run(command, cwd=empty_caches, env=environment, check=False).returncode

    records = empty_caches / "records"
    assert run(last=2) == 9
    assert found_runs(records) == []
    assert clbench.load_records(records).empty
    assert next_stage(ID, method="me/still", records=records) == 2
    assert next_stage(ID, method="me/still", seed=1, records=records) == 0
    assert run(last=9) == 0
    assert next_stage(ID, method="me/still", records=records) == 3
    record = read_record(records / "Toy-v0/me--still/seed-0.json")
    assert record.costs == Costs(environment_steps=3)
    assert files_below(records) == ["Toy-v0/me--still/seed-0.json"]


OTHER = """
import gymnasium, clbench
for stage in range(3):
    env = gymnasium.make("{id}", stage=stage)
    clbench.evaluate_agent(lambda _: [0, 0], env, method="me/knows", steps=7, records="records")
    print(stage, flush=True)
    input()
"""


@pytest.mark.long
def test_two_programs_do_not_mix_their_stages(evaluate: Callable[..., Any], empty_caches: Path) -> None:
    command = [sys.executable, "-c", OTHER.format(id=ID)]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=empty_caches, **pipes) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        for stage in range(3):
            assert other.stdout.readline() == f"{stage}\n"
            message = f"belongs to process {other.pid} on " if stage < 2 else "already has a record"
            for mine in range(3):  # while the other one trains for its next stage
                with pytest.raises(InputError, match=message):
                    evaluate(Knowing(), stage_env(mine))
            print(file=other.stdin, flush=True)
    assert other.returncode == 0
    assert read_record(empty_caches / "records/Toy-v0/me--knows/seed-0.json").costs.environment_steps == 21
    for stage in range(3):
        evaluate(Knowing(), stage_env(stage), seed=1)
    assert files_below(empty_caches / "records") == [f"Toy-v0/me--knows/seed-{seed}.json" for seed in (0, 1)]


BEGINS = """
import gymnasium, clbench
env = gymnasium.make("{id}", stage=0)
clbench.evaluate_agent(lambda _: [0, 0], env, method="me/knows", records="records")
"""


@pytest.mark.long
def test_a_program_that_was_refused_a_stage_does_not_keep_the_run(
    evaluate: Callable[..., Any], empty_caches: Path
) -> None:
    with pytest.raises(InputError, match="comes next, not 1"):
        evaluate(Knowing(), stage_env(1), records=empty_caches / "records")
    subprocess.run([sys.executable, "-c", BEGINS.format(id=ID)], cwd=empty_caches, check=True)


def losing(folder: Path) -> Callable[[object], list[int]]:
    """Return an agent that removes the leases below a folder whenever it acts."""

    def act(_: object) -> list[int]:
        for lease in folder.rglob(".*.lease"):
            lease.unlink()
        return [0, 0]

    return act


def test_a_stage_of_a_process_that_lost_its_lease_is_not_kept(
    evaluate: Callable[..., Any], tmp_path: Path
) -> None:
    with pytest.raises(LeaseLostError):
        evaluate(losing(tmp_path / "records"), stage_env(0))
    assert not list((tmp_path / "records").rglob("*.unfinished"))


def test_a_run_whose_lease_was_lost_can_be_taken_again(evaluate: Callable[..., Any], tmp_path: Path) -> None:
    evaluate(Knowing(), stage_env(0))
    shutil.rmtree(tmp_path / "records")
    with pytest.raises(LeaseLostError):
        evaluate(Knowing(), stage_env(0))
    evaluate(Knowing(), stage_env(0))
    assert next_stage(ID, method="me/knows", records=tmp_path / "records") == 1


def test_a_stage_that_was_not_kept_can_be_evaluated_again(
    evaluate: Callable[..., Any], tmp_path: Path
) -> None:
    evaluate(Knowing(), stage_env(0))
    with pytest.raises(LeaseLostError):
        evaluate(losing(tmp_path / "records"), stage_env(1))
    assert set(evaluate(Knowing(), stage_env(1)).episodes["stage"]) == {0, 1}
