"""`clbench list` and `clbench metrics` in terminals of any width."""

import pytest

from clbench import load_scenario
from clbench.cli.main import app
from clbench.scoring.metrics import METRICS
from clbench.spec.identifiers import built_in_methods


@pytest.mark.parametrize("width", [60, 80, 120])
def test_lists_fit_the_terminal_and_cut_no_name(
    width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    scenarios = [load_scenario(f"clbench/{name}") for name in ("Fetch-v1", "MetaWorldCW-v0", "PointMaze-v0")]
    tasks = {task.name for one in scenarios for task in one.tasks}
    for command, names in (
        ("list", {*(one.id for one in scenarios), *built_in_methods(), *tasks}),
        ("metrics", METRICS.keys()),
    ):
        app([command], result_action="return_value")
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= width
        words = {word.rstrip(",:") for line in lines for word in line.split()}
        assert names <= words


def test_methods_are_listed_by_the_prior_data_that_they_use(capsys: pytest.CaptureFixture[str]) -> None:
    app(["list"], result_action="return_value")
    shown = capsys.readouterr().out
    free, _, others = shown.partition("Methods that use no prior data")[2].partition("Methods that use")
    assert "  l2_sp " in free
    assert "  experience_replay " in others.partition("prior demonstrations throughout")[2]


def test_everything_about_one_metric_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    app(["metrics", "worst_case_accuracy"], result_action="return_value")
    assert "Formula: R[K][K] / K + (1 - 1 / K) minimum_accuracy\n" in capsys.readouterr().out
