"""The command line as people type it; some tests need a process of their own."""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from clbench import __version__
from clbench.base.errors import InputError
from clbench.cli.main import COMMANDS, app
from clbench.jobs.job import Job
from clbench.jobs.work import do_run
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

TOY = "clbench.testing:clbench/Toy-v0"
TINY = "tiny:me/Tiny-v0"

PLACES = {name: place for commands in COMMANDS.values() for name, place in commands.items()}
"""Entry points of all commands."""


def _clbench(*arguments: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "clbench", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=600, check=False)


@pytest.mark.long
def test_names_are_checked_before_pytorch_is_imported() -> None:
    commands = [
        ["run", "clbench/Fetch-v1", "sfft"],
        ["tune", "clbench/Fetsch-v1", "sft"],
        ["film", "clbench/Fetch-v1", "sfft"],
        ["submit", "sfft"],
    ]
    code = f"""
import sys
from clbench.cli.main import app
for command in {commands}:
    try:
        app(command)
    except SystemExit as end:
        print(end.code, "torch" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["2 False"] * len(commands)
    assert done.stderr.count("Did you mean") == len(commands)


@pytest.mark.long
def test_a_wrong_name_ends_the_process_without_a_traceback(tmp_path: Path) -> None:
    result = _clbench("run", "clbench/Fecth-v1", "sft", folder=tmp_path)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("error: No scenario is called ")
    assert "Traceback" not in result.stderr


@pytest.mark.long
def test_the_shards_of_a_command_do_each_of_its_runs_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    done: list[str] = []

    def note(jobs: Sequence[Job], *_: object) -> dict[Job, str]:
        found = [job for job in jobs if job.function is do_run]
        done.extend(job.title for job in found)
        return dict.fromkeys(found, "not done here")

    def run(*words: str) -> None:
        with pytest.raises(SystemExit):
            app([*runs, *words], result_action="return_value")

    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", note)
    runs = ["run", f"{TOY},clbench/Fetch-v1", "sft", "frozen", "lora", "--seeds", "3"]
    run()
    whole, parts = sorted(done), []
    for part in range(1, 6):
        done.clear()
        run("--shard", f"{part}/5")
        parts.append(list(done))
    assert len(whole) == 18
    assert sorted(name for part in parts for name in part) == whole
    assert {len(part) for part in parts} == {3, 4}


@pytest.mark.parametrize("option", ["--records", "--checkpoints", "CLBENCH_CACHE", "MINARI_DATASETS_PATH"])
def test_a_folder_that_cannot_be_written_to_is_named_before_work_begins(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", lambda *_: pytest.fail("work began"))
    file = tmp_path / "a file"
    file.write_text("precious")
    before = sorted(tmp_path.iterdir())
    arguments = ["run", TOY, "sft", "--seeds", "1"]
    if option.startswith("--"):
        arguments += [option, str(file)]
    else:
        monkeypatch.setenv(option, str(file))
    with pytest.raises(SystemExit) as stopped:
        app(arguments, result_action="return_value")
    assert stopped.value.code == 2
    message = " ".join(capsys.readouterr().err.split())
    assert f"error: {option} {file} cannot be written to: Not a directory." in message
    assert file.read_text() == "precious"
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(("first_seed", "is_shown"), [(99, True), (100, False)])
def test_a_run_names_the_board_only_if_the_board_shows_its_seeds(
    first_seed: int,
    is_shown: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("clbench.cli.runs.do_runs", lambda *_: True)
    words = ["run", TOY, "sft", "--first-seed", str(first_seed), "--seeds", "2"]
    app(words, result_action="return_value")
    assert ("Next: clbench leaderboard" in capsys.readouterr().err) == is_shown


def test_a_record_that_is_refused_after_the_runs_is_an_error_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> bool:
        raise InputError("it was made with another definition")

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("clbench.cli.runs.do_runs", lambda *_: False)
    monkeypatch.setattr("clbench.jobs.recorded.has_record", refuse)
    with pytest.raises(SystemExit, match="2"):
        app(["run", TOY, "sft", "--seeds", "1"], result_action="return_value")
    assert capsys.readouterr().err.splitlines()[-1] == "error: it was made with another definition"


def test_a_folder_with_markup_in_its_name_is_shown_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("clbench.jobs.grid.run_with_bars", lambda *_: {})
    records = tmp_path / "[" / "red]x"
    with pytest.raises(SystemExit) as ended:
        app(["run", TOY, "sft", "--seeds", "1", "--records", str(records)], result_action="return_value")
    said = capsys.readouterr().err.replace("\n", "")
    assert f"records in {records}." in said
    assert f"it ended without a record of this run at {records}/Toy-v0/sft/seed-0.json." in said
    assert ended.value.code == 1


@pytest.mark.long
def test_help_shows_every_command_with_its_summary_and_imports_none() -> None:
    program = "import sys; from clbench.cli.main import app; app('--help', result_action='return_value')"
    command = [sys.executable, "-c", f"{program}; print({{'clbench.cli.runs', 'torch'}} & set(sys.modules))"]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    titles = [line.strip("╭─╮ ") for line in lines if line.startswith("╭")]
    assert titles == [*COMMANDS, "Options"]
    for name in (*PLACES, "experts"):
        (line,) = (line for line in lines if line.startswith(f"│ {name} "))
        assert line.removeprefix(f"│ {name} ").strip(" │")
    assert lines[-1] == "set()"


@pytest.mark.long
def test_the_first_line_of_a_commands_help_names_its_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    for name in PLACES:
        app([name, "--help"], result_action="return_value")
        assert "ARGS" not in capsys.readouterr().out
    app(["run", "--help"], result_action="return_value")
    first = capsys.readouterr().out.splitlines()[0]
    assert first == "Usage: clbench run [OPTIONS] SCENARIOS [METHODS...]"


@pytest.mark.long
def test_help_of_a_command_shows_its_limits_and_does_not_wait_for_pytorch() -> None:
    commands = [name for name, place in PLACES.items() if place.startswith("clbench.cli.")]
    code = f"""
import sys
from clbench.cli.main import app
for command in {commands}:
    app([command, "--help"], result_action="return_value")
    print(command, "torch" in sys.modules)
"""
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    lines = output.splitlines()
    assert [line for line in lines if line.endswith((" False", " True"))] == [
        f"{command} False" for command in commands
    ]
    assert output.count("--workers ") == output.count("--workers INT>=1") > 0
    assert output.count("--seed ") == output.count("--seed INT>=0") > 0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["run", "clbench/F"], "clbench/Fetch-v1"),
        (["run", "clbench/Fetch-v1", "sft", "con"], "consft"),
        (["submit", "con"], "consft"),
        (["film", "clbench/Fetch-v1", ""], "lora"),
        (["status", "clbench/F"], "clbench/Fetch-v1"),
        (["scenario-card", ""], "clbench/PointMaze-v1"),
    ],
)
def test_tab_completes_scenarios_and_methods(
    words: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    app(["__complete", *words], result_action="return_value")
    assert expected in capsys.readouterr().out.splitlines()


@pytest.mark.long
def test_lists_metrics_and_the_machine_come_as_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    def printed(*words: str) -> Any:
        app([*words, "--json"], result_action="return_value")
        return json.loads(capsys.readouterr().out)

    found = printed("list")
    (fetch,) = (one for one in found["scenarios"] if one["id"] == "clbench/Fetch-v1")
    assert "push_right" in fetch["target"]
    (replay,) = (one for one in found["methods"] if one["name"] == "experience_replay")
    assert (replay["demonstrations"], replay["questions"]) == ("throughout", "never")
    every = printed("metrics")
    (one,) = printed("metrics", "forgetting")
    assert one in every
    machine = printed("doctor")
    assert (machine["ready"], machine["fix"]) == (True, [])
    assert machine["clbench"] == __version__
    assert "torch" in machine["packages"]


@pytest.mark.long
def test_doctor_says_what_to_fix_if_something_needed_is_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "clbench.cli.catalogue.version", lambda name: "0.1" if name == "scipy" else metadata.version(name)
    )
    with pytest.raises(SystemExit) as ended:
        app(["doctor"])
    assert ended.value.code == 1
    last = " ".join(capsys.readouterr().out.split("cannot run here yet:")[1].split())
    assert last == "pip install 'scipy<1.18,>=1.17'"


@pytest.mark.long
def test_doctor_shows_versions_and_rendering(capsys: pytest.CaptureFixture[str]) -> None:
    app(["doctor"], result_action="return_value")
    shown = capsys.readouterr().out
    assert "mujoco" in shown
    assert "rendering: egl" in shown
    assert f"clbench {__version__} is ready." in shown


def test_a_dry_run_says_what_would_be_done_and_does_nothing(
    empty_caches: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(empty_caches)
    monkeypatch.syspath_prepend(empty_caches)
    app(
        ["run", TOY, "sft", "lora", "--seeds", "2", "--workers", "1", "--checkpoints", "kept", "--dry-run"],
        result_action="return_value",
    )
    done, jobs, duration, disk = capsys.readouterr().out.splitlines()
    assert done == "0 of 4 runs done already."
    assert jobs == (
        "To do: 4 datasets to collect or read, 1 set of questions to collect or read, 2 policies to "
        "pretrain, 2 pretrained policies to evaluate, 4 runs."
    )
    assert re.fullmatch(
        r"Time: about \d+ minutes? with 1 at once, at \d+ ms for an optimiser step here\.", duration
    )
    sizes = r"up to .* in the caches, .* more while runs go on, 400 kB of records, .* of policies in kept"
    assert re.fullmatch(rf"Disk: {sizes}\.", disk)
    assert not any(path.is_file() for path in empty_caches.rglob("*"))


@pytest.mark.long
def test_a_dry_run_on_a_cluster_tells_the_time_of_one_core_and_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", TOY, "sft", "--records", str(tmp_path / "records"), "--ray", "auto", "--dry-run"]
    app(command, result_action="return_value")
    assert "with 1 at once, at " in capsys.readouterr().out
    app([*command, "--workers", "2"], result_action="return_value")
    assert "with 2 at once, at " in capsys.readouterr().out


@pytest.mark.parametrize("words", [["step_factor=0.3"], ["step_factor", "0.3"]])
def test_a_hyper_parameter_set_in_the_usual_way_is_told_the_right_one(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        app(["run", TOY, "sft", "--set", *words])
    assert "error: The name is part of the option: write --set.step_factor" in capsys.readouterr().err


@pytest.mark.long
def test_a_dry_run_counts_recorded_runs_whose_policies_would_be_made_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    execute(RunSpec(TINY, "frozen", 0), tmp_path / "records")
    command = ["run", TINY, "frozen", "--seeds", "1", "--records", str(tmp_path / "records")]
    app([*command, "--dry-run"], result_action="return_value")
    assert capsys.readouterr().out == "1 of 1 run done already.\n"
    app([*command, "--dry-run", "--checkpoints", str(tmp_path / "kept")], result_action="return_value")
    done, jobs, _, disk = capsys.readouterr().out.splitlines()
    assert done == "1 of 1 run done already."
    assert "1 run to train again for its policies." in jobs
    assert " 0 kB of records, " in disk


@pytest.mark.long
def test_a_quiet_run_prints_failures_alone(
    tmp_path: Path, write_module: Callable[[str, str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    write_module("loud", METHOD)  # a name of its own: the module stays imported
    app(
        ["run", TINY, "frozen", "--seeds", "1", "-q", "--records", str(tmp_path)],
        result_action="return_value",
    )
    assert capsys.readouterr() == ("", "")
    with pytest.raises(SystemExit):
        app(["run", TINY, "loud:Broken", "--seeds", "1", "-q", "--records", str(tmp_path)])
    said = capsys.readouterr().err
    assert said.startswith(
        "me--Tiny-v0 loud:Broken seed 0: failed in loss() of stage 1 (right): ValueError: no idea"
    )


@pytest.mark.slow
def test_demonstrations_are_collected_and_shown(empty_caches: Path) -> None:
    result = _clbench("demonstrations", TOY)
    assert result.returncode == 0, result.stderr
    assert re.search(
        r"left: retained, 10 episodes, \d noisy, success 1.00, mean length [\d.]+\n"
        r"    clbench/toy/[0-9a-f]{16}/left-v0\n",
        result.stdout,
    )
    assert "demonstrations left: 10 episodes" in result.stderr


METHOD = """
from dataclasses import dataclass
from clbench import Method

@dataclass
class Gentle(Method):
    strength: float = 0.5
    def loss(self, policy, batch, progress):
        return self.strength * policy.action_loss(batch).mean()

@dataclass
class Broken(Method):
    def loss(self, policy, batch, progress):
        raise ValueError("no idea")
"""


@pytest.mark.slow
def test_a_stranger_runs_a_class_from_the_working_directory_and_sees_it_on_the_board(
    tmp_path: Path, empty_caches: Path
) -> None:
    (tmp_path / "mine.py").write_text(METHOD)
    result = _clbench("run", TOY, "mine:Gentle", "mine:Broken", "sft", "--seeds", "1", folder=tmp_path)
    assert result.returncode == 1  # the broken one; the others went on
    assert "mine:Broken seed 0: failed in loss() of stage 1 (right): ValueError: no idea" in result.stderr
    assert "Traceback" not in result.stderr  # it is in the record
    assert "1 failed: Toy-v0 mine:Broken seed 0" in result.stderr
    records = sorted(
        path.relative_to(tmp_path).as_posix() for path in (tmp_path / "leaderboard").rglob("*.json")
    )
    assert records == [
        f"leaderboard/records/Toy-v0/{name}/seed-0.json" for name in ("mine.Broken", "mine.Gentle", "sft")
    ]
    assert "success 1.00 on the retained skills" in result.stderr
    assert "Next: clbench leaderboard\n" in result.stderr
    broken = _clbench("run", TOY, "mine:Broken", "--seeds", "1", folder=tmp_path)
    assert broken.returncode == 1
    assert "Next:" not in broken.stderr  # there is nothing to see on the board
    again = _clbench("run", TOY, "mine:Gentle", "sft", "--seeds", "1", folder=tmp_path)
    assert again.returncode == 0
    assert "2 of 2 runs already have a record" in again.stderr
    board = _clbench("leaderboard", folder=tmp_path)
    assert board.returncode == 0, board.stderr
    assert "mine:Gentle" in board.stdout
    text = (tmp_path / "leaderboard" / "site" / "LEADERBOARD.md").read_text()
    assert "mine:Gentle" in text
    assert "no idea" in text  # why the failed run is not a row
