"""Arguments of commands: paths that begin with the home folder, and errors of the input alone."""

from pathlib import Path

import pytest

from clbench.cli.arguments import checked_input
from clbench.cli.main import app


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


def test_a_bug_inside_checked_input_is_not_taken_for_wrong_input() -> None:
    with pytest.raises(KeyError, match="no such key"), checked_input():
        raise KeyError("no such key")
