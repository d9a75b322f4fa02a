"""The command `clbench tune`; its refusals are among those of test_main.py."""

import dataclasses
import errno
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import ClassVar

import pytest
from torch import Tensor

from clbench.cli.main import app
from clbench.learning.method import Method, Progress
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.spec import ResolvedRun

TINY = "tiny:me/Tiny-v0"

Tune = Callable[..., tuple[str, str]]


@pytest.fixture
def tune(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Tune:
    """Return a function that tunes a method in an empty folder and returns what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(".")  # and take back what the command puts there

    def tune(*arguments: str, method: str = "l2_sp", first_seed: int = 103) -> tuple[str, str]:
        words = ("tune", TINY, method, "--first-seed", str(first_seed), "--seeds", "1", *arguments)
        app(words, result_action="return_value")
        return capsys.readouterr()

    return tune


@pytest.mark.long
def test_equal_settings_run_once_and_plain_fine_tuning_is_run_unchanged_too(
    tune: Tune, tmp_path: Path
) -> None:
    values = ("--values.step_factor", "1,1.0", "--records", str(tmp_path))
    out, err = tune(*values, method="sft", first_seed=0)
    rows = [line.split() for line in out.splitlines() if " sft" in line]
    assert [row[3] for row in rows] == ["unchanged", "step_factor=1.0"]
    assert "done by another command" not in err
    assert len(list(tmp_path.rglob("seed-0.json"))) == 2


@pytest.mark.long
def test_tune_compares_settings_without_test_episodes(tune: Tune, tmp_path: Path) -> None:
    out, _ = tune("--values.strength", "0,1")
    rows = [line.split() for line in out.splitlines() if "l2_sp" in line or " sft" in line]
    settings = [row[1:4:2] for row in rows]
    assert settings == [["sft", "unchanged"], ["l2_sp", "strength=0.0"], ["l2_sp", "strength=1.0"]]
    paths = list((tmp_path / "leaderboard" / "tuning").rglob("seed-103.json"))
    records = {record.run.method + str(record.run.changes): record for record in map(read_record, paths)}
    plain, none, some = (
        records[name] for name in ("sft{}", "l2_sp{'strength': 0.0}", "l2_sp{'strength': 1.0}")
    )
    assert len(records) == 3
    assert (plain.policy, plain.episodes) == (
        none.policy,
        none.episodes,
    )  # at strength 0 it is plain fine-tuning
    assert plain.policy != some.policy
    assert all("test" not in record.episodes["split"] for record in records.values())
    assert "3 of 3 runs already have a record" in tune("--values.strength", "0,1")[1]


@pytest.mark.long
def test_runs_of_fewer_targets_leave_the_records_of_all_targets(tune: Tune, tmp_path: Path) -> None:
    tune("--values.strength", "1")
    records = tmp_path / "leaderboard" / "tuning"
    before = {path: path.read_bytes() for path in records.rglob("seed-103.json")}
    assert len(before) == 2
    tune("--values.strength", "1", "--targets", "1")
    assert {path: path.read_bytes() for path in before} == before
    assert len(list((records / "targets-1").rglob("seed-103.json"))) == 2


@pytest.mark.long
def test_tune_writes_the_best_of_six_settings(tune: Tune, tmp_path: Path) -> None:
    out, err = tune("--write", "tuned/Tiny-v0.json")
    file = json.loads((tmp_path / "tuned" / "Tiny-v0.json").read_text())
    assert (file["scenario"], file["seeds"]) == ("me/Tiny-v0", [103])
    found = file["methods"]["l2_sp"]
    tried = [one["settings"] for one in found["tried"]]
    assert [one["step_factor"] for one in tried[:4]] == [1.0, 0.3, 0.1, 0.03]
    assert [one["strength"] for one in tried] == [0.3, 0.3, 0.3, 0.3, 0.1, 1.0]
    assert found["settings"] in tried
    chosen = " ".join(f"{name}={value}" for name, value in found["settings"].items())
    assert f"l2_sp: {chosen} is chosen. No setting has learned 0.8, so" in out  # bold is lost in a file
    assert all(one["learned"] < 0.8 for one in found["tried"])
    assert "6 of 6 runs" not in err  # four, then two


@pytest.mark.long
def test_a_fixed_setting_is_in_every_run_and_in_the_file(tune: Tune, tmp_path: Path) -> None:
    tune("--set.schedule", "2", "--write", "tuned/Tiny-v0.json", method="consft")
    found = json.loads((tmp_path / "tuned" / "Tiny-v0.json").read_text())["methods"]["consft"]
    assert {one["settings"]["schedule"] for one in (found, *found["tried"])} == {2.0}
    records = (tmp_path / "leaderboard" / "tuning").rglob("seed-103.json")
    assert [json.loads(path.read_text())["run"]["settings"]["schedule"] for path in records] == [2.0] * 6


@pytest.mark.long
def test_a_method_is_tuned_on_another_policy_in_a_table_of_its_own(tune: Tune, tmp_path: Path) -> None:
    out, err = tune("--policy", "discrete_diffusion", "--write", "mine.json", method="sft")
    assert json.loads((tmp_path / "mine.json").read_text())["scenario"] == "me/Tiny-v0+discrete_diffusion"
    assert "me/Tiny-v0+discrete_diffusion, 1 tuning seed" in out
    assert "me--Tiny-v0+discrete_diffusion.json" in " ".join(err.split()).replace(" ", "")
    (folder,) = (tmp_path / "leaderboard" / "tuning").iterdir()
    assert folder.name == "me--Tiny-v0+discrete_diffusion"


@dataclasses.dataclass
class Diverging(Method):
    """A method that fails at the learning rates from `fails_from` on."""

    fails_from: ClassVar[float] = 1.0

    def loss(self, policy: Policy, batch: Batch, progress: Progress) -> Tensor:
        return policy.action_loss(batch).mean() / (self.step_factor < self.fails_from)


@dataclasses.dataclass
class Hopeless(Diverging):
    """A method that fails at every learning rate."""

    fails_from: ClassVar[float] = 0.0


@pytest.mark.long
def test_a_setting_that_fails_is_not_chosen_and_a_method_that_always_fails_stops_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(".")
    names = [f"{__name__}:{cls.__name__}" for cls in (Diverging, Hopeless)]
    with pytest.raises(SystemExit, match="1"):
        app(["tune", TINY, *names, "--first-seed", "103", "--seeds", "1", "--write", "mine.json"])
    said = capsys.readouterr()
    assert f"Failed at every learning rate: {names[1]}." in said.err
    assert "me--Tiny-v0.json: copy mine.json there, on every machine" in " ".join(said.err.split())
    chosen = json.loads((tmp_path / "mine.json").read_text())["methods"][names[0]]["settings"]["step_factor"]
    advice = f"Make these values the defaults of the class, or run it with --set.step_factor {chosen}."
    assert f"is chosen. {advice}" in " ".join(said.out.split())
    there = tmp_path / "tuned.json"
    there.write_bytes((tmp_path / "mine.json").read_bytes())
    monkeypatch.setattr("clbench.runs.tuning.tuned_file", lambda _: there)
    app(
        ["tune", TINY, names[0], "--first-seed", "103", "--seeds", "1", "--write", "mine.json"],
        result_action="return_value",
    )
    told = " ".join(capsys.readouterr().err.split())
    assert f"repeat this command with --write {there}, which keeps its other methods, on" in told
    methods = json.loads((tmp_path / "mine.json").read_text())["methods"]
    assert list(methods) == names[:1]
    tried = methods[names[0]]["tried"]
    assert (tried[0]["settings"], tried[0]["learned"], tried[0]["final_average"]) == (
        {"step_factor": 1.0},
        None,
        None,
    )
    assert methods[names[0]]["settings"]["step_factor"] < 1.0
    assert len(tried) == 6
    assert "failed" in said.out


def test_the_best_mean_over_the_seeds_is_refined_and_chosen(
    make_record: Callable[..., Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = {(1.0, 0.3): (0.9, 0.0), (0.3, 0.3): (0.5, 0.7), (0.1, 0.3): (0.5, 0.5), (0.03, 0.3): (0.2, 0.2)}
    kept |= {(0.3, 0.1): (0.4, 0.4), (0.3, 1.0): (0.7, 0.9)}
    asked = []

    def do_runs(runs: Iterable[ResolvedRun], records: Path, workers: object) -> bool:
        for run in runs:
            settings = run.info.settings["step_factor"], run.info.settings["strength"]
            asked.append((*settings, run.spec.seed))
            rate = kept.get(settings, (0.1, 0.1))[run.spec.seed - 100]
            success = [[1, 1, 0, 0, 0], [1, 1, 0.9, 0, 0], [rate, rate, rate, 0.9, 0]]
            record = make_record(success, steps=(100,), episodes=10, split="validation", seed=run.spec.seed)
            write_record(record, run.path(records))
        return True

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(".")
    monkeypatch.setattr("clbench.cli.tune.do_runs", do_runs)
    options = ("--seeds", "2", "--write", "tuned.json")
    app(["tune", "tiny:me/Tiny-v0", "l2_sp", *options], result_action="return_value")
    found = json.loads((tmp_path / "tuned.json").read_text(encoding="utf-8"))["methods"]["l2_sp"]
    assert asked == [(*one, seed) for one in kept for seed in (100, 101)]
    finals = [(3 * sum(rates) / 2 + 0.9) / 4 for rates in kept.values()]
    assert [one["final_average"] for one in found["tried"]] == pytest.approx(finals, abs=1e-4)
    assert {one["learned"] for one in found["tried"]} == {0.9}
    assert found["settings"] == {"strength": 1.0, "step_factor": 0.3}


def test_a_file_of_settings_that_does_not_fit_on_the_disk_is_named(
    make_record: Callable[..., Record],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def do_runs(runs: Iterable[ResolvedRun], records: Path, workers: object) -> bool:
        for run in runs:
            success = [[1, 1, 0, 0, 0], [1, 1, 0.9, 0, 0], [1, 1, 1, 0.9, 0]]
            record = make_record(success, steps=(100,), episodes=10, split="validation", seed=run.spec.seed)
            write_record(record, run.path(records))
        return True

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(".")
    monkeypatch.setattr("clbench.cli.tune.do_runs", do_runs)
    monkeypatch.setattr("clbench.runs.tuning.write_tuned", full)
    with pytest.raises(SystemExit, match="2"):
        app(["tune", TINY, "l2_sp", "--seeds", "1", "--write", "tuned.json"])
    assert "error: tuned.json cannot be written: No space left on device." in capsys.readouterr().err


@pytest.mark.long
def test_a_comparison_with_a_failed_setting_shows_it_and_ends_with_exit_code_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(".")
    with pytest.raises(SystemExit, match="1"):
        app(["tune", TINY, f"{__name__}:Hopeless", "--seeds", "1", "--values.step_factor", "1"])
    assert "failed" in capsys.readouterr().out
