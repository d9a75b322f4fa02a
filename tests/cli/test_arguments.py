"""Arguments of commands: paths that begin with the home folder, and errors of the input alone."""

import subprocess
import sys
from pathlib import Path

import pytest

from clbench.base.errors import InputError
from clbench.cli.arguments import (
    checked_input,
    checked_writing,
    error_line,
    items_of,
)
from clbench.cli.main import app


def test_a_file_that_does_not_fit_on_the_disk_is_named() -> None:
    full = Path("/dev/full")
    with (
        pytest.raises(InputError, match=r"^/dev/full cannot be written: No space left on device\.$"),
        checked_writing(full),
    ):
        full.write_text("a film")


def test_an_error_is_one_line_with_the_spaces_of_its_names() -> None:
    assert error_line("a  file\n  is gone\n").plain == "error: a  file is gone"


def test_a_comma_inside_brackets_separates_no_items() -> None:
    assert items_of("--values.layers", "[1,2], none,[3]") == ["[1,2]", "none", "[3]"]
    assert items_of("--values.layers", "[[1,2],[3]],[[4]]") == ["[[1,2],[3]]", "[[4]]"]


def test_a_working_directory_that_is_gone_is_named_before_anything_is_imported(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    code = f"import os; os.rmdir({str(gone)!r}); from clbench.cli.entry import main; main()"
    # -P: no module is looked up in the folder, as with the installed command; Python 3.13.0 fails there
    command = [sys.executable, "-P", "-c", code, "pretrain", "clbench/Fetch-v1"]
    ended = subprocess.run(command, cwd=gone, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "error: The working directory no longer exists: change to another one.\n"


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["run", "clbench/Fecth-v1", "sft"],
            "No scenario is called 'clbench/Fecth-v1'. Did you mean 'clbench/Fetch-v1'",
        ),
        (["run", "clbench/Fetch-v1", "stf"], "No method is called 'stf'. Did you mean 'sft'?"),
        (["run", "clbench/Fetch-v1"], "Name at least one method"),
        (
            ["run", "clbench/Fetch-v1", "sft", "--sedes", "3"],
            "Unknown option: --sedes. Did you mean --seeds?",
        ),
        (["run", "clbench/Fetch-v1", "sft", "--seeds", "0"], 'Invalid value "0" for --seeds. Must be >= 1.'),
        (["run", "clbench/Fetch-v1", "sft", "--seeds", "many"], "--seeds"),
        (
            ["run", "clbench/Fetch-v1", "sft", "--seeds", "1.5"],
            "--seeds: it must be a whole number, not '1.5'",
        ),
        (
            ["film", "clbench/Fetch-v1", "sft", "--episode", "1.5"],
            "--episode: it must be a whole number, not '1.5'",
        ),
        (["run", "clbench/Fetch-v1", "sft", "--workers", "1.4"], "it must be a whole number, not '1.4'"),
        (["run", "../../etc:clbench/X-v0", "sft"], "No module '../../etc' can be imported for"),
        (
            ["run", "clbench/Fetch-v1", "sft", "--workers", "0"],
            'Invalid value "0" for --workers. Must be >= 1.',
        ),
        (["run", "clbench/Fetch-v1", "sft", "--set.rate", "1"], "sft has no hyper-parameter 'rate'"),
        (
            ["run", "clbench/Fetch-v1", "experience_replay", "--set.replay", "x"],
            "replay must be a number, not 'x'",
        ),
        (
            ["run", "clbench/Fetch-v1", "experience_replay", "--set.replay", "7"],
            "replay must be from 0 to 1, not 7.0",
        ),
        (["run", "clbench/Fetch-v1", "sft", "--device", "gpu"], "The device 'gpu' cannot be used"),
        (["run", "clbench/Fetch-v1", "sft", "--device", "mps"], "reproducible only on cpu and cuda.\n"),
        (["tune", "clbench/Fetch-v1", "sft", "--device", "gpu"], "The device 'gpu' cannot be used"),
        (["submit", "sft", "--device", "gpu"], "The device 'gpu' cannot be used"),
        (["run", "clbench/Fetch-v1,clbench/PointMase-v1", "sft"], "Did you mean 'clbench/PointMaze-v1'?"),
        (["run", "clbench/Fetch-v1", "sft", "--shard", "0/8"], "--shard must be i/n with i from 1 to n"),
        (["run", "clbench/Fetch-v1", "sft", "--shard", "9/8"], "--shard must be i/n with i from 1 to n"),
        (["run", "clbench/Fetch-v1", "sft", "--shard", "half"], "for example 2/8, not 'half'"),
        (["run", "clbench/Fetch-v1", "sft", "--seeds", "1_0"], "it must be a whole number, not '1_0'"),
        (["run", "clbench/Fetch-v1", "sft", "--seeds", "_5"], "it must be a whole number, not '_5'"),
        (["run", "clbench/Fetch-v1", "sft", "--records", ""], "--records must not be empty."),
        (["leaderboard", "--records="], "--records must not be empty."),
        (
            ["run", "sft", "clbench/Fetch-v1"],
            "'sft' is a method: the scenario comes first",
        ),
        (["run", "clbench/Fetch-v1", "my_method.py"], "a class of this file, as 'my_method:Class'?"),
        (["demonstrations", "clbench/Fetch"], "Did you mean 'clbench/Fetch-v"),
        (["demonstrations", "clbench/Fetch-v1", "--workers", "0"], "Must be >= 1."),
        (["pretrain", "clbench/Fetch"], "Did you mean 'clbench/Fetch-v"),
        (["pretrain", "clbench/Fetch-v1", "--seed", "-1"], "Must be >= 0."),
        (["submit", "sft", "--seeds", "0"], 'Invalid value "0" for --seeds. Must be >= 1.'),
        (["submit", "sft", "--first-seed", "-1"], "Must be >= 0."),
        (["verify", "x.json", "--episodes", "0"], 'Invalid value "0" for --episodes. Must be >= 1.'),
        (["scenario-card", "--episodes", "0"], 'Invalid value "0" for --episodes. Must be >= 1.'),
        (["cache", "--older-than", "-1"], "Must be >= 0."),
        (
            ["film", "clbench/Fetch-v1", "sft", "--size", "20"],
            'Invalid value "20" for --size. Must be >= 96.',
        ),
        (["tune", "clbench/Fetch-v1", "sft", "--values.x", "1", "--targets", "0"], "Must be >= 1."),
        (["tune", "clbench/Fetch-v1", "sft", "--targets", "1"], "--targets needs --values"),
        (
            ["tune", "clbench/Fetch-v1", "sft", "--values.step_factor", "1", "--write", "chosen.json"],
            "--write cannot be used with --values",
        ),
        (["tune", "clbench/Fetch-v1", "consft", "--set.tau_start", "1"], "Tuning ConSFT sets tau_start"),
        (["tune", "clbench/Fetch-v1", "sft", "--values.x", "1", "--set.y", "1"], "--set cannot be used"),
        (
            ["tune", "clbench/Fetch-v1", "sft", "shuffled_weights"],
            "uses its settings: tune consft_calibrated instead.",
        ),
        (
            ["tune", "clbench/Fetch-v1", "consft", "--values.kapa", "1,2"],
            "consft has no hyper-parameter 'kapa'. Did you mean 'kappa'?",
        ),
        (
            ["tune", "clbench/Fetch-v1", "consft", "--values.omega_min", "0.1,2"],
            "omega_min must be from 0 to 1, not 2.0",
        ),
        (
            ["tune", "clbench/Fetch-v1", "sft", "--first-seed", "0", "--write", "chosen.json"],
            "--write needs seeds that no board has: --first-seed must be at least 100, not 0.",
        ),
        (["tune", "clbench/Fetch-v1", "sft", "--values.x", "1,,2"], "--values.x has an empty item: '1,,2'."),
        (["run", "clbench/Fetch-v1, ", "sft"], "SCENARIOS has an empty item: 'clbench/Fetch-v1, '."),
        (
            ["run", "clbench/Fetch-v1", "sft", "--records", "/proc/x", "--dry-run"],
            "/proc/x cannot be written",
        ),
        (["status", "--seeds", "99"], "--seeds needs a scenario: name the scenario"),
        (["status", "--order", "0"], "--order needs a scenario: name the scenario"),
        (["status", "clbench/Fetch-v1", "--seeds", "4"], "Name at least one method"),
        (["status", "clbench/Fetch-v1", "sft", "--policy", ""], "No policy is called ''"),
        (["status", "clbench/Fetch-v1", "sft", "--seeds", "0"], "Must be >= 1."),
        (["list", "foo"], "list does not take 'foo': see clbench list --help."),
        (["claims", "--records", "nowhere"], "There is no folder of records at nowhere."),
        (["findings", "--records", "nowhere"], "There is no folder of records at nowhere."),
        (["metrics", "forgeting"], "No metric is called 'forgeting'. Did you mean 'forgetting'?"),
        (["metrics", "--json", "--markdown", "m.md"], "--markdown writes a page, and --json prints JSON"),
        (["metrics", "rates.txt"], "There is no file 'rates.txt'."),
        (["metrics", "/"], "'/' is a folder, not a file."),
        (["leaderbord"], "No command is called 'leaderbord'. Did you mean 'leaderboard'?"),
        (["run"], "SCENARIOS requires an argument"),
        (["experts", "mesure"], "No command is called 'mesure'. Did you mean 'measure'?"),
        (["experts", "train", "cartpole_lft"], "Did you mean 'cartpole_left'?"),
        (["experts", "train", "cartpole_left", "--steps", "1500"], "for a multiple of 1,000 steps"),
        (["experts", "measure", "clbench/Fetch"], "Did you mean 'clbench/Fetch-v"),
        (["experts", "measure", "clbench/Fetch-v1", "pres"], "Did you mean 'press'?"),
        (["run", "clbench/Fetch-v1", "sft", "--seeds", "10001"], "--seeds. Must be <= 10000."),
        (["run", "clbench/Fetch-v1", "sft", "--first-seed", str(2**64)], f"Must be <= {2**64 - 1}."),
        (["run", "clbench/Fetch-v1", "sft", "--order", str(2**64)], f"Must be <= {2**64 - 1}."),
        (
            ["run", "clbench/Fetch-v1", "sft", "--seeds", "2", "--first-seed", str(2**64 - 1)],
            f"RunSpec.seed must be at most {2**64 - 1}, not {2**64}.",
        ),
        (["pretrain", "clbench/Fetch-v1", "--seed", str(2**64)], f"Must be <= {2**64 - 1}."),
    ],
)
def test_bad_input_ends_with_exit_code_2_and_the_nearest_right_name(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # and take back what the command puts there
    with pytest.raises(SystemExit) as ended:
        app(arguments)
    printed = "".join(capsys.readouterr())
    assert ended.value.code == 2
    assert printed.startswith("error: ")
    assert len(printed.splitlines()) == 1
    assert message in printed
    assert list(tmp_path.iterdir()) == []


def test_a_bug_inside_checked_input_is_not_taken_for_wrong_input() -> None:
    with pytest.raises(KeyError, match="no such key"), checked_input():
        raise KeyError("no such key")
