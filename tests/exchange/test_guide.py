"""The guide to data in and out: its commands and its scenario do what it says."""

import re
import shlex
from pathlib import Path

import pytest
from helpers import blocks_of, scenario_or_skip

from clbench import export_demonstrations
from clbench.cli.main import app
from clbench.testing import TOY

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "data.md"
TOY_ID = "clbench.testing:clbench/Toy-v0"


def _commands() -> list[list[str]]:
    return [shlex.split(line)[1:] for block in blocks_of(PAGE, "console") for line in block.splitlines()]


def test_its_commands_on_a_recording_do_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The toy stands for Fetch, and its task `right` for `press`; its budget has 10 demonstrations."""

    def on_the_toy(text: str) -> str:
        return text.replace("clbench/Fetch-v1", TOY_ID).replace("press", "right").replace("=50", "=10")

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    export_demonstrations(TOY, "out", format="hdf5", tasks=["right"]).joinpath("right_demo.hdf5").rename(
        "my_right.hdf5"
    )
    _, _, check, imported, _ = (list(map(on_the_toy, command)) for command in _commands())
    with pytest.raises(SystemExit):
        app(check)
    (told,) = re.findall(r'(expert=".+?")', printed := capsys.readouterr().err)
    expected = re.sub(r"\W+", " ", on_the_toy(blocks_of(PAGE, "text")[0])).replace("clbench testing ", "")
    named = re.sub(r"(?<=demonstrations_)\w+", "0123456789abcdef", printed)
    assert re.sub(r"\W+", " ", named).replace("clbench testing ", "") == expected
    source = on_the_toy(blocks_of(PAGE, "python")[1])
    Path("recorded.py").write_text(re.sub('expert=".+?"', told, source), encoding="utf-8")
    app(imported, result_action="return_value")
    assert re.fullmatch(r"clbench/toy/[0-9a-f]{16}/right-v0\n", capsys.readouterr().out)


def test_its_export_with_pictures_is_a_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (block,) = blocks_of(PAGE, "shell")
    _, *command = shlex.split(block.replace("\\\n", " "))
    scenario_or_skip(command[2])
    with pytest.raises(SystemExit):
        app([*command[:-1], str(tmp_path)])
    assert f"{tmp_path} already exists: name a new folder for the export" in capsys.readouterr().err
    # the scene has these cameras: an unknown name would be refused before any work
    place = command.index("--pictures") + 1
    with pytest.raises(SystemExit):
        app([*command[:place], f"{command[place]},agent", *command[place + 1 : -1], str(tmp_path / "new")])
    assert "Did you mean 'agentview'?" in capsys.readouterr().err


def test_its_exports_are_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(tmp_path)  # and take back what the command puts there
    for command in _commands()[:2]:
        with pytest.raises(SystemExit):  # a folder that exists is refused after all other checks
            app([*command[:-1], str(tmp_path)])
        assert f"{tmp_path} already exists: name a new folder for the export" in capsys.readouterr().err
