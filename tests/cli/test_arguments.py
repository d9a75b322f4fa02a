"""Arguments of commands: seeds have limits, and paths may begin with the home folder."""

from pathlib import Path

import pytest

from clbench.cli.main import app


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "clbench/Fetch-v1", "sft", "--seeds", "10001"], "--seeds. Must be <= 10000."),
        (["run", "clbench/Fetch-v1", "sft", "--first-seed", str(2**64)], f"Must be <= {2**64 - 1}."),
        (["run", "clbench/Fetch-v1", "sft", "--order", str(2**64)], f"Must be <= {2**64 - 1}."),
        (
            ["run", "clbench/Fetch-v1", "sft", "--seeds", "2", "--first-seed", str(2**64 - 1)],
            f"seed of a run must be below 2^64, not {2**64}.",
        ),
        (["pretrain", "clbench/Fetch-v1", "--seed", str(2**64)], f"Must be <= {2**64 - 1}."),
    ],
)
def test_a_seed_that_no_record_could_hold_is_refused_and_so_are_too_many(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(tmp_path)  # and take back what the command puts there
    with pytest.raises(SystemExit) as ended:
        app(arguments)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("words", [["--records=~/somewhere"], ["--records", "~/somewhere"]])
def test_a_path_may_begin_with_the_home_folder(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(tmp_path)  # and take back what the command puts there
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit):
        app(["status", *words], result_action="return_value")
    assert f"There are no runs in {tmp_path}/somewhere" in capsys.readouterr().err
