"""The command `clbench tune`; its refusals are among those of test_main.py."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from clbench.cli.main import app

TOY = "clbench.testing:clbench/Toy-v0"


def _tune(folder: Path, *arguments: str, method: str = "l2_sp") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "clbench", "tune", TOY, method, "--first-seed", "103", "--seeds", "1"]
    command += arguments
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.long
def test_equal_settings_run_once_and_plain_fine_tuning_is_run_unchanged_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(".")  # and take back what the command puts there
    values = ("--values.step_factor", "1,1.0", "--first-seed", "0", "--seeds", "1")
    words = ("tune", "tiny:me/Tiny-v0", "sft", *values, "--records", str(tmp_path))
    app(words, result_action="return_value")
    printed = capsys.readouterr()
    rows = [line.split() for line in printed.out.splitlines() if " sft" in line]
    assert [row[3] for row in rows] == ["unchanged", "step_factor=1.0"]
    assert "done by another command" not in printed.err
    assert len(list(tmp_path.rglob("seed-0.json"))) == 2


@pytest.mark.slow
def test_tune_compares_settings_without_test_episodes(tmp_path: Path) -> None:
    result = _tune(tmp_path, "--values.strength", "0,1")
    rows = [line.split() for line in result.stdout.splitlines() if "l2_sp" in line or " sft" in line]
    settings = [row[1:4:2] for row in rows]
    assert settings == [["sft", "unchanged"], ["l2_sp", "strength=0.0"], ["l2_sp", "strength=1.0"]]
    assert rows[0][4:] == rows[1][4:]  # at strength 0 it is plain fine-tuning
    paths = list((tmp_path / "leaderboard" / "tuning").rglob("seed-103.json"))
    assert len(paths) == 3
    assert not any('"test"' in path.read_text().partition('"answers"')[0] for path in paths)
    assert "3 of 3 runs have a record already" in _tune(tmp_path, "--values.strength", "0,1").stderr


@pytest.mark.slow
def test_runs_of_fewer_targets_leave_the_records_of_all_targets(tmp_path: Path) -> None:
    _tune(tmp_path, "--values.strength", "1")
    records = tmp_path / "leaderboard" / "tuning"
    before = {path: path.read_bytes() for path in records.rglob("seed-103.json")}
    assert len(before) == 2
    _tune(tmp_path, "--values.strength", "1", "--targets", "1")
    assert {path: path.read_bytes() for path in before} == before
    assert len(list((records / "targets-1").rglob("seed-103.json"))) == 2


@pytest.mark.slow
def test_tune_writes_the_best_of_six_settings(tmp_path: Path) -> None:
    result = _tune(tmp_path, "--write", "tuned/Toy-v0.json")
    file = json.loads((tmp_path / "tuned" / "Toy-v0.json").read_text())
    assert (file["scenario"], file["seeds"]) == ("clbench/Toy-v0", [103])
    found = file["methods"]["l2_sp"]
    tried = [one["settings"] for one in found["tried"]]
    assert [one["step_factor"] for one in tried[:4]] == [1.0, 0.3, 0.1, 0.03]
    assert [one["strength"] for one in tried] == [0.3, 0.3, 0.3, 0.3, 0.1, 1.0]
    assert found["settings"] in tried
    assert "6 of 6 runs" not in result.stderr  # four, then two


@pytest.mark.slow
def test_a_fixed_setting_is_in_every_run_and_in_the_file(tmp_path: Path) -> None:
    _tune(tmp_path, "--set.schedule", "2", "--write", "tuned/Toy-v0.json", method="consft")
    found = json.loads((tmp_path / "tuned" / "Toy-v0.json").read_text())["methods"]["consft"]
    assert {one["settings"]["schedule"] for one in (found, *found["tried"])} == {2.0}
    records = (tmp_path / "leaderboard" / "tuning").rglob("seed-103.json")
    assert [json.loads(path.read_text())["run"]["settings"]["schedule"] for path in records] == [2.0] * 6
