"""`clbench demonstrations` with its export, `clbench pretrain`, and `clbench experts measure`."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from clbench.base.cache import cache_folder
from clbench.cli.data import DEMONSTRATIONS
from clbench.cli.main import app
from clbench.jobs.job import Job
from clbench.jobs.work import pretrain
from clbench.learning import pretraining
from clbench.spec.registry import load_scenario

TOY = "clbench.testing:clbench/Toy-v0"


def _clbench(*arguments: str) -> None:
    app(arguments, result_action="return_value")


@pytest.fixture(autouse=True)
def _restored_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(".")  # and take back what the command puts there


@pytest.mark.long
def test_a_policy_is_pretrained_unless_it_is_in_the_cache(capsys: pytest.CaptureFixture[str]) -> None:
    _clbench("pretrain", TOY)
    folder = pretraining.pretrained_folder(load_scenario(TOY), 0)
    assert folder.is_relative_to(cache_folder() / "pretrained")
    assert f"clbench/Toy-v0 pretraining seed 0: in {folder}" in capsys.readouterr().err
    times = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    _clbench("pretrain", TOY)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == times


@pytest.mark.parametrize("name", ["flow-base", "discrete_diffusion-large"])
def test_a_policy_of_any_size_is_pretrained(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def note(jobs: Sequence[Job], *_: object) -> dict[Job, str]:
        made.extend(job.arguments["policy"] for job in jobs if job.function is pretrain)
        return {}

    monkeypatch.setattr("clbench.jobs.scheduler.run_with_bars", note)
    _clbench("pretrain", TOY, "--policy", name)
    assert made == [name]


def test_no_bar_is_drawn_for_a_policy_that_is_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, folder = pretraining.pretrained_policy(load_scenario(TOY), 0)
    monkeypatch.setattr("clbench.jobs.bars.Bars.__init__", lambda *_: pytest.fail("a bar"))
    _clbench("pretrain", TOY)
    assert capsys.readouterr().err == f"clbench/Toy-v0 pretraining seed 0: in {folder}\n"


@pytest.mark.parametrize(
    ("policy", "said"),
    [("my:P", "No module 'my' can be imported"), ("json:JSONDecoder", "is not a subclass of clbench.Policy")],
)
def test_what_is_no_policy_is_refused_in_one_line_before_anything_is_made(
    policy: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        _clbench("pretrain", TOY, "--policy", policy)
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: ")
    assert said in printed
    assert "pretraining seed" not in printed


def test_a_policy_ships_from_a_checkout_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = tmp_path / "clbench" / "pretrained"
    monkeypatch.setattr(pretraining, "SHIPPED", shipped)
    with pytest.raises(SystemExit) as ended:
        _clbench("pretrain", TOY, "--ship")
    assert ended.value.code == 2
    assert "error: --ship needs a checkout of clbench" in capsys.readouterr().err
    (tmp_path / "pyproject.toml").touch()
    cached = pretraining.pretrained_folder(load_scenario(TOY), 0)
    for _ in range(2):  # the second time, the policy that ships is the one that is used
        _clbench("pretrain", TOY, "--ship")
        (folder,) = shipped.iterdir()
        assert folder.name == "clbench--Toy-v0-seed-0"
        assert pretraining.pretrained_folder(load_scenario(TOY), 0) == folder
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
        path.name: path.read_bytes() for path in cached.iterdir()
    }


@pytest.mark.long
def test_a_scenario_of_the_working_folder_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = ("import clbench", f"clbench.load_scenario({TOY!r})")
    (tmp_path / "toy_of_mine.py").write_text("\n".join(lines), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    _clbench("experts", "measure", "toy_of_mine:clbench/Toy-v0", "--episodes", "1")
    assert "Experts of clbench/Toy-v0, 1 episode each" in capsys.readouterr().out
    _clbench("demonstrations", "toy_of_mine:clbench/Toy-v0")
    assert "left: retained, 10 episodes" in capsys.readouterr().out


@pytest.mark.long
def test_demonstrations_are_exported_after_those_that_are_missing_are_collected(
    empty_caches: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = empty_caches / "out"
    _clbench("demonstrations", "export", TOY, "up", "left", "--format", "hdf5", "--output", str(output))
    assert capsys.readouterr().out == f"2 tasks of clbench/Toy-v0 in {output}\n"
    assert {path.name for path in output.iterdir()} == {"up_demo.hdf5", "left_demo.hdf5"}
    assert len(list((empty_caches / "minari").rglob("main_data.hdf5"))) == 2


def test_pretraining_after_an_expert_that_fails_ends_with_exit_code_1_and_names_the_expert(
    write_module: Callable[[str, str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    write_module(
        "lazy_left",
        """
import dataclasses
import clbench
import numpy
from clbench.testing import TOY

def lazy(task):
    return lambda state: numpy.zeros(2, numpy.float32)

LEFT = dataclasses.replace(TOY.task("left"), suite="lazy", expert="lazy_left:lazy")
SCENARIO = dataclasses.replace(TOY, id="me/Lazy-v0", retained=(LEFT,))
clbench.register("me/Lazy-v0", "lazy_left:SCENARIO")
""",
    )
    with pytest.raises(SystemExit) as ended:
        _clbench("pretrain", "lazy_left:me/Lazy-v0")
    assert ended.value.code == 1
    (line,) = (one for one in capsys.readouterr().err.splitlines() if "expert of" in one)
    assert "demonstrations left: " in line
    assert "The expert of 'left' succeeded 0 times in 20 attempts" in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["export", TOY, "lft", "--format", "hdf5", "--output", "x"], "Did you mean 'left'?"),
        (["export", TOY, "--format", "hdf", "--output", "x"], 'Invalid value "hdf" for --format'),
        (["export", TOY, "--format", "hdf5"], "--output requires an argument"),
        (
            ["export", TOY, "--format", "hdf5", "--output", "x", "--picture-size", "64"],
            "--picture-size needs --pictures",
        ),
        (["export", TOY, "--format", "hdf5", "--output", "x", "--pictures", "front"], "has no pictures"),
        (["import", TOY, "left", "x.hdf5"], "There is no file x.hdf5."),
        (["import", TOY, "left", "x.hdf5", "--state"], "The state must name datasets of a demonstration"),
    ],
)
def test_an_export_or_import_of_bad_input_ends_with_exit_code_2_and_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        app(["demonstrations", *arguments])
    printed = "".join(capsys.readouterr())
    assert ended.value.code == 2
    assert message in printed
    assert len(printed.splitlines()) == 1


@pytest.mark.parametrize("command", DEMONSTRATIONS)
@pytest.mark.parametrize("rest", [[], [TOY], [TOY, "--format", "hdf5"]])
def test_a_command_of_demonstrations_with_a_typing_error_is_named_with_the_right_one(
    command: str, rest: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = command.replace("o", "")
    with pytest.raises(SystemExit) as ended:
        app(["demonstrations", wrong, *rest])
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert f"error: No command or scenario is called {wrong!r}. Did you mean {command!r}?" in printed


def test_a_task_that_learns_from_a_recording_has_no_expert_to_measure(
    write_module: Callable[[str, str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    write_module(
        "recorded_right",
        """
import dataclasses
import clbench
from clbench.exchange.recorded import expert_of
from clbench.testing import TOY

RIGHT = dataclasses.replace(TOY.task("right"), expert=expert_of("0123456789abcdef"))
SCENARIO = dataclasses.replace(TOY, id="me/Shown-v0", target=(RIGHT,))
clbench.register("me/Shown-v0", "recorded_right:SCENARIO")
""",
    )
    with pytest.raises(SystemExit) as ended:
        _clbench("experts", "measure", "recorded_right:me/Shown-v0", "right")
    assert ended.value.code == 2
    assert " ".join(capsys.readouterr().err.split()) == (
        "error: The task right has no expert: it learns from the recording 0123456789abcdef."
    )
    _clbench("experts", "measure", "recorded_right:me/Shown-v0", "--episodes", "2")
    printed = capsys.readouterr().out
    assert "left" in printed
    assert "right" not in printed
