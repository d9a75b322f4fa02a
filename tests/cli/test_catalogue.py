"""`clbench list` and `clbench metrics` in terminals of any width."""

import copy
import json
from importlib import metadata
from pathlib import Path

import gymnasium
import pytest
from helpers import lose_home

from clbench import load_scenario
from clbench.cli.main import app
from clbench.metrics.definitions import DEFINITIONS
from clbench.scoring.metrics import METRICS
from clbench.spec.identifiers import built_in_methods


@pytest.mark.parametrize("width", [60, 80, 120])
def test_lists_fit_the_terminal_and_cut_no_name(
    width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    scenarios = [load_scenario(f"clbench/{name}") for name in ("Fetch-v1", "MetaWorldCW-v0", "PointMaze-v1")]
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


@pytest.mark.long
def test_doctor_advises_the_extra_of_a_package_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(
        "clbench.cli.catalogue.version", lambda name: "0.1" if name == "minari" else metadata.version(name)
    )
    with pytest.raises(SystemExit, match="1"):
        app(["doctor"])
    shown = capsys.readouterr().out
    advice = "pip install 'minari[hdf5]<0.6,>=0.5.4'"
    assert shown.count(advice) == 2  # in the table, and at the end
    assert shown.splitlines()[-1].endswith(f"cannot run here yet: {advice}")


@pytest.mark.long
def test_doctor_does_not_miss_packages_for_other_versions_of_python(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = ["numpy>=2", "no-simulator==1; python_version < '3'"]
    monkeypatch.setattr("clbench.cli.catalogue.requires", lambda _: wanted)
    app(["doctor"], result_action="return_value")
    shown = capsys.readouterr().out
    assert "numpy" in shown
    assert "no-simulator" not in shown
    assert shown.splitlines()[-1].endswith("is ready.")


@pytest.mark.long
@pytest.mark.parametrize("fault", ["cannot be written to: Not a directory", "no home folder"])
def test_doctor_says_that_nothing_can_run_without_a_folder_for_data(
    fault: str, empty_caches: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if fault == "no home folder":
        lose_home(monkeypatch)
    else:
        (empty_caches / "cache").write_text("a file")
    with pytest.raises(SystemExit, match="1"):
        app(["doctor", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert not found["ready"]
    (fix,) = found["fix"]
    assert fault in fix


def test_methods_are_listed_by_the_prior_data_that_they_use(capsys: pytest.CaptureFixture[str]) -> None:
    app(["list"], result_action="return_value")
    shown = capsys.readouterr().out
    free, _, others = shown.partition("Methods that use no prior data")[2].partition("Methods that use")
    assert "  l2_sp " in free
    assert "  experience_replay " in others.partition("prior demonstrations throughout")[2]


def test_a_scenario_that_cannot_be_loaded_hides_no_other(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = copy.copy(gymnasium.registry["clbench/Fetch-v1"])
    broken.kwargs = {"scenario": "no_such_module:SCENARIO"}
    monkeypatch.setitem(gymnasium.registry, "me/Broken-v0", broken)
    app(["list"], result_action="return_value")
    shown = " ".join(capsys.readouterr().out.split())
    assert "me/Broken-v0 cannot be loaded: No module 'no_such_module' can be imported" in shown
    assert "clbench/Fetch-v1 retained" in shown
    app(["list", "--json"], result_action="return_value")
    found = {one["id"]: one for one in json.loads(capsys.readouterr().out)["scenarios"]}
    assert found["me/Broken-v0"]["retained"] is None
    assert "no_such_module" in found["me/Broken-v0"]["fault"]
    assert found["clbench/Fetch-v1"]["fault"] is None


def test_everything_about_one_metric_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    app(["metrics", "worst_case_accuracy"], result_action="return_value")
    assert "Formula: R[K][K] / K + (1 - 1 / K) minimum_accuracy\n" in capsys.readouterr().out


TABLE = """method,seed,stage,reach,push,lift
experience_replay,0,1,90,60,10
experience_replay,0,2,80,50,70
experience_replay,1,1,80,50,0
experience_replay,1,2,90,50,80
sft,0,1,50,70,10
sft,0,2,20,30,90
sft,1,1,60,80,0
sft,1,2,30,20,80
"""


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_metrics_of_a_table_fit_the_terminal_and_cut_no_name(
    width: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    path = tmp_path / "table.csv"
    path.write_text(TABLE, encoding="utf-8")
    for words in ([str(path), "--retained", "reach"], ["robocasa365.csv"]):
        app(["metrics", *words], result_action="return_value")
        shown = capsys.readouterr().out
        assert max(map(len, shown.splitlines())) <= width
        assert METRICS.keys() <= {word.strip(",:") for word in shown.split()}
    assert "read as per cent, since the greatest is 41.5" in " ".join(shown.split())


def test_the_metrics_of_a_table_are_printed_as_json_with_reasons_and_flips(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "table.csv"
    path.write_text(TABLE, encoding="utf-8")
    app(["metrics", str(path), "--retained", "reach", "--json"], result_action="return_value")
    printed = json.loads(capsys.readouterr().out)
    assert (printed["unit"], printed["target"]) == ("percent", ["push", "lift"])
    by_name = {one["name"]: one for one in printed["metrics"]}
    assert by_name.keys() == METRICS.keys()
    assert all(by_name[name]["assumption"] for name in DEFINITIONS)
    assert by_name["retention"]["values"]["experience_replay"]["value"] == pytest.approx(0.85)
    missing = by_name["zero_shot"]["values"]["sft"]
    assert missing["value"] is None
    assert missing["reason"].startswith("There are no held-out tasks")
    assert {"family", "first", "second", "first_is_better", "second_is_better"} == printed["flips"][0].keys()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["robocasa.csv"], "Did you mean 'robocasa365.csv'?"),
        (["forgetting", "--unit", "share"], "need a CSV file"),
        (["robocasa365.csv", "--retained", "atomics"], "Did you mean 'atomic'?"),
        (["robocasa365.csv", "--markdown", "page.md"], "give a name or --markdown, not both"),
        (["--markdown", "."], ". cannot be written: Is a directory"),
    ],
)
def test_a_wrong_table_or_page_is_an_error_in_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        app(["metrics", *words], result_action="return_value")
    assert ended.value.code == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1
