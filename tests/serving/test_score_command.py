"""`clbench score`: what it says, skips, refuses and scores again."""

from pathlib import Path
from typing import Any

import pytest
from agents import ID
from served import serving, write_policy

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.serving.client import ServedPolicy
from clbench.serving.score import score

STAGES = range(3)


@pytest.mark.long
def test_the_command_scores_stage_after_stage_and_skips_what_is_done(
    tmp_path: Path, empty_caches: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_policy(tmp_path)
    command, records = resolve("clbench.cli.runs:score"), tmp_path / "records"
    for stage in STAGES:
        with serving(tmp_path, stage) as (address, _):
            options = {"policy": address, "stage": stage, "method": "me/elsewhere", "records": records}
            command(ID, **options, data="by hand")
    shown = capsys.readouterr().err
    assert "stage 0: left 1.00, up " in shown
    assert "(server: stage 0)" in shown
    assert f"Stages so far: {records / 'Toy-v0/me--elsewhere/seed-0.json.unfinished'}" in shown
    assert "Next: fine-tune on right, serve the policy, and score it with --stage 1." in shown
    assert f"Record: {records / 'Toy-v0/me--elsewhere/seed-0.json'}" in shown
    assert f"Next: clbench leaderboard --records {records}" in shown
    command(ID, **options)  # nobody serves the policy any more
    assert capsys.readouterr().err == "Stage 2 of me/elsewhere, seed 0, is done.\n"
    command(ID, **options, data="by hand", executed=3)
    assert "is done" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        command(ID, **options, executed=1)
    assert "with executed 3, not 1. The record is finished and is never edited." in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        command(ID, **options, restart=True)
    assert "already has a record" in capsys.readouterr().err


@pytest.mark.long
def test_the_command_refuses_what_contradicts_a_done_stage_and_scores_it_again_if_asked(
    tmp_path: Path, empty_caches: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_policy(tmp_path)
    command, records = resolve("clbench.cli.runs:score"), tmp_path / "records"
    with serving(tmp_path, 0) as (address, _):
        options = {"policy": address, "stage": 0, "method": "me/elsewhere", "records": records}
        command(ID, **options, data="by hand", steps=5)
        command(ID, **options, data="by hand", steps=5, executed=3)
        for name, value, other in (("data", "by hand", "mine"), ("steps", 5, 9), ("executed", 3, 2)):
            with pytest.raises(SystemExit, match="2"):
                command(ID, **options, **{name: other})
            shown = capsys.readouterr().err
            assert f" {value!r}, not {other!r}. Score it again with --restart" in shown
        command(ID, **options, executed=2, restart=True)
    capsys.readouterr()
    command(ID, **options, executed=2)
    assert "is done" in capsys.readouterr().err


@pytest.mark.long
def test_the_command_says_that_no_board_shows_a_tuning_seed(
    tmp_path: Path, empty_caches: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy_of = write_policy(tmp_path)
    options: dict[str, Any] = {"method": "me/elsewhere", "seed": 100, "records": tmp_path / "records"}
    for stage in STAGES[:2]:
        score(ID, policy_of(stage), stage=stage, **options)
    with serving(tmp_path, 2) as (address, _):
        resolve("clbench.cli.runs:score")(ID, policy=address, stage=2, **options)
    shown = capsys.readouterr().err
    assert "This is a tuning run on validation episodes, so no board shows it." in shown
    assert "Next:" not in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "localhost:8000"}, "error: The address of a policy is ws://host:port, not"),
        ({"stage": 1}, "error: Stage 0 of me/elsewhere, seed 0, on clbench/Toy-v0 comes next, not 1: "),
        ({"method": "me.module:Class"}, "error: 'me.module:Class' is the name of a class"),
        ({"method": "sft"}, "error: 'sft' is a method of clbench"),
        (
            {"picture_size": 8},
            "--picture-size needs --pictures: name the cameras there.",
        ),
    ],
)
def test_the_command_explains_a_wrong_value_in_one_line(
    options: dict[str, Any],
    message: str,
    tmp_path: Path,
    empty_caches: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = {
        "policy": "ws://localhost:1",
        "stage": 0,
        "method": "me/elsewhere",
        "records": tmp_path,
        **options,
    }
    with pytest.raises(SystemExit, match="2"):
        resolve("clbench.cli.runs:score")(ID, **given)
    assert message in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_named_before_the_server_is_looked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("precious")
    options = {"policy": "ws://127.0.0.1:9", "stage": 0, "method": "me/elsewhere", "records": file}
    with pytest.raises(SystemExit, match="2"):
        resolve("clbench.cli.runs:score")(ID, **options)
    said = " ".join(capsys.readouterr().err.split())
    assert f"--records {file} cannot be written to: Not a directory." in said
    assert file.read_text() == "precious"


@pytest.mark.long
def test_a_stage_that_fails_ends_the_connection(
    tmp_path: Path, empty_caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise InputError("the policy failed")

    closed: list[ServedPolicy] = []
    write_policy(tmp_path)
    monkeypatch.setattr("clbench.serving.score.score", fail)
    monkeypatch.setattr(ServedPolicy, "close", lambda served: closed.append(served))
    command, options = (
        resolve("clbench.cli.runs:score"),
        {"stage": 0, "method": "me/elsewhere", "data": "by hand"},
    )
    with serving(tmp_path, 0) as (address, _), pytest.raises(SystemExit, match="2"):
        command(ID, policy=address, records=tmp_path / "records", **options)
    assert len(closed) == 1
