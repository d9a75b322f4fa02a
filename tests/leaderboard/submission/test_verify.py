"""Verification: an honest record earns each tier; a forged one is denied it, with the reason."""

import hashlib
import importlib
import json
import math
import shutil
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from helpers import sealed
from verification import TOY, edit, failures, flip, verify

import clbench
from clbench.cli.main import app
from clbench.learning.pretraining import pretrained_policy
from clbench.records.paths import label_of, record_path
from clbench.records.reader import read_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.testing import TOY as TOY_SCENARIO
from clbench.testing import ToyWorld

tiers = importlib.import_module("clbench.leaderboard.board.tiers")


@pytest.mark.long
@pytest.mark.parametrize("tier", ["recomputed", "replayed", "retrained"])
def test_an_honest_record_earns_every_tier_and_is_not_touched(tier: str, mine: Path, honest: Path) -> None:
    before = mine.read_bytes()
    assert tiers.tier_of(mine) == "self-reported"
    checks = verify(mine, tier, honest)
    assert failures(checks) == ""
    assert tiers.tier_of(mine) == tier
    assert mine.read_bytes() == before
    stored = json.loads(tiers.verification_path(mine).read_text(encoding="utf-8"))
    assert stored["verifier"]["versions"]["torch"]
    assert [check["name"] for check in stored["checks"]] == [check.name for check in checks]


@pytest.mark.long
def test_a_run_in_another_order_of_the_targets_is_verified_in_that_order(tmp_path: Path) -> None:
    spec = RunSpec(TOY, "frozen", 0, order=1)
    execute(spec, tmp_path / "records")
    path = spec.path(tmp_path / "records")
    assert failures(verify(path, "retrained")) == ""
    assert tiers.tier_of(path) == "retrained"
    edit(path, lambda values: values["scenario"].update(balanced=True))
    assert "run: order must be 0: each seed of its scenario" in failures(verify(path, "recomputed"))
    edit(path, lambda values: values["scenario"].update(balanced=False, target=["right", "down"]))
    assert "is missing at stage 1" in failures(verify(path, "recomputed"))


@pytest.mark.long
def test_perturbed_episodes_are_replayed_like_test_episodes(tmp_path: Path) -> None:
    spec = RunSpec(TOY, "frozen", 0, perturb=True)
    execute(spec, tmp_path / "records")
    path = spec.path(tmp_path / "records")
    checks = verify(path, "retrained")
    assert failures(checks) == ""
    assert any(check.found.startswith("146 of 146 replayed") for check in checks)  # 90, 48 and 8
    edit(path, lambda values: flip_perturbed(values))
    assert "left perturbed episode " in failures(verify(path, "replayed"))
    assert tiers.tier_of(path) == "recomputed"


def flip_perturbed(values: dict[str, Any]) -> None:
    """Turn a failure in a perturbed episode into a success, or make a success take a step less."""
    episodes = values["episodes"]
    row = episodes["split"].index("perturbed")
    episodes["length"][row] -= episodes["success"][row]
    episodes["success"][row] = 1


TARGETS = {0: "", 1: "right", 2: "down"}
"""Target of each stage of the toy."""


@pytest.mark.long
def test_a_record_that_claims_perturbed_episodes_of_a_world_without_is_denied(
    mine: Path, honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def claim(values: dict[str, Any]) -> None:
        values["run"]["perturb"] = True
        rows = list(zip(*values["episodes"].values(), strict=True))
        ends = [
            row
            for row in rows
            if row[1] in (0, 60) and row[3] == "test" and row[2] in ("left", "up", TARGETS[row[0]])
        ]
        for row in ends:
            for column, value in zip(values["episodes"].values(), row, strict=True):
                column.append("perturbed" if value == "test" else value)

    edit(mine, claim)
    assert "episodes: " in failures(verify(mine, "replayed", honest))
    steady = lambda render_mode=None: ToyWorld(render_mode)  # noqa: E731 - a world that takes no `perturbed`
    monkeypatch.setattr("clbench.testing.ToyWorld", steady)
    assert "what was run: The task 'left' cannot be perturbed" in failures(verify(mine, "replayed", honest))


@pytest.mark.long
def test_the_table_shows_the_least_tier_of_a_row(mine: Path, honest: Path) -> None:
    verify(mine, "replayed", honest)
    records = next(folder for folder in mine.parents if folder.name == "records")
    load = clbench.load_board
    assert list(load(records).tier) == ["replayed"]
    other = mine.with_name("seed-1.json")
    shutil.copy(mine, other)
    edit(other, lambda values: values["run"].update(seed=1))
    assert list(load(records).tier) == ["self-reported"]


@pytest.mark.slow
def test_the_pretraining_is_repeated_on_request_and_its_policy_compared(mine: Path, honest: Path) -> None:
    checks = verify(mine, "retrained", honest, pretrain=True)
    assert not failures(checks)
    (pretraining,) = (check for check in checks if check.name == "pretraining")
    pretrained = read_record(mine).fingerprint["pretrained"]
    assert pretraining.found == f"repeated, it gives the same policy {pretrained}"


@pytest.mark.long
def test_a_policy_that_pretraining_does_not_give_is_found_before_the_run_is_repeated(
    mine: Path, honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "clbench.leaderboard.submission.verify.pretrain",
        lambda scenario, seed, progress: pretrained_policy(scenario, seed + 1)[0],
    )
    checks = verify(mine, "retrained", honest, pretrain=True)
    assert "pretraining: repeated, it gives the policy " in failures(checks)
    assert checks[-1].name == "pretraining"
    assert tiers.tier_of(mine) == "replayed"


def test_the_file_says_who_verified_last_and_when_and_with_which_versions(mine: Path, honest: Path) -> None:
    begin = datetime.now(UTC).replace(microsecond=0)
    for name in ("Ada", "Bo"):  # the second time the record has this tier already
        verify(mine, "recomputed", by=name)
        found = json.loads(tiers.verification_path(mine).read_text(encoding="utf-8"))
        assert found["by"] == name
    assert begin <= datetime.fromisoformat(found["time"]) <= datetime.now(UTC)
    assert found["verifier"]["versions"] == read_record(mine).fingerprint["versions"]


@pytest.mark.slow
def test_a_fault_that_only_the_whole_run_shows_is_found_by_doing_it_again(mine: Path, honest: Path) -> None:
    edit(mine, lambda values: flip(values, 0, 30))  # on the way: no policy of that moment is kept
    edit(mine, lambda values: values["costs"].update(bytes_kept=1))
    edit(mine, lambda values: values["diagnostics"].update({"1": {"energy": 0.5}}))
    found = failures(verify(mine, "retrained", honest))
    parts = "episodes (success), costs (bytes_kept), diagnostics (1)"
    assert found == f"whole run: repeated, {parts} differ"
    assert tiers.tier_of(mine) == "replayed"


@pytest.mark.long
@pytest.mark.parametrize(("stage", "check"), [(2, "method: sft failed in"), (1, "whole run: it failed:")])
def test_a_method_that_fails_when_it_is_repeated_denies_its_record(
    stage: int, check: str, mine: Path, honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail = lambda self, policy, about: policy.parameters() if about.number != stage else 1 / 0  # noqa: E731
    monkeypatch.setattr("clbench.methods.sft.SFT.start_task", fail)  # a replay goes on with stage 2
    found = failures(verify(mine, "retrained", honest))
    assert found == f"{check} stage {stage} ({TARGETS[stage]}): ZeroDivisionError: division by zero"


@pytest.mark.parametrize(("count", "looked_at"), [(90, 10), (1160, 40), (40, 40), (5, 1)])
def test_the_least_lie_that_is_found_is_the_least_whose_chance_to_hide_is_5_percent(
    count: int, looked_at: int
) -> None:
    found = importlib.import_module("clbench.leaderboard.submission.replay").least_found(count, looked_at)
    hides = [math.comb(count - lies, looked_at) / math.comb(count, looked_at) for lies in range(count + 1)]
    assert hides[found] <= 0.05 < hides[found - 1]


@pytest.mark.long
def test_the_episodes_of_another_seed_are_found(mine: Path, honest: Path) -> None:
    other = mine.with_name("seed-1.json")
    shutil.move(mine, other)
    edit(other, lambda values: values["run"].update(seed=1))
    found = failures(verify(other, "replayed"))
    assert "pretraining does not give the same policy here" in found


def test_a_tier_is_lost_with_the_first_changed_byte(mine: Path, honest: Path) -> None:
    verify(mine, "recomputed", honest)
    mine.write_bytes(mine.read_bytes() + b"\n")
    assert tiers.tier_of(mine) == "self-reported"


def test_a_record_that_changes_while_it_is_verified_has_no_tier(
    mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = importlib.import_module("clbench.leaderboard.submission.subject")
    take = subject.fingerprint

    def change_and_take(scenario: Any) -> Any:
        edit(mine, lambda values: flip(values, 0, 60))
        return take(scenario)

    monkeypatch.setattr(subject, "fingerprint", change_and_take)
    assert failures(verify(mine, "recomputed")) == ""
    assert tiers.tier_of(mine) == "self-reported"


def test_the_verification_of_another_record_counts_for_nothing(mine: Path, honest: Path) -> None:
    verify(mine, "recomputed", honest)
    other = mine.with_name("seed-1.json")
    other.write_bytes(mine.read_bytes().replace(b'"seed": 0', b'"seed": 1'))
    shutil.copy(tiers.verification_path(mine), tiers.verification_path(other))
    assert tiers.tier_of(other) == "self-reported"


@pytest.mark.parametrize(
    "content", ["", "[]", '{"tier": "retrained"}', '{"tier": "best", "record": "0"}', "[" * 9999]
)
def test_a_torn_verification_counts_for_nothing(content: str, mine: Path) -> None:
    tiers.verification_path(mine).write_text(content, encoding="utf-8")
    assert tiers.tier_of(mine) == "self-reported"


def test_a_failed_check_takes_an_earlier_tier_back(mine: Path, honest: Path) -> None:
    verify(mine, "recomputed", honest)
    edit(mine, lambda values: flip(values, 1))
    verify(mine, "recomputed", honest)
    assert not tiers.verification_path(mine).exists()


@pytest.mark.long
def test_the_file_of_a_higher_tier_stays_unless_a_check_fails(mine: Path, honest: Path) -> None:
    verify(mine, "replayed", honest)
    file = tiers.verification_path(mine)
    stored = file.read_bytes()
    assert failures(verify(mine, "recomputed", honest)) == ""
    assert file.read_bytes() == stored
    edit(mine, lambda values: flip(values, 1))
    claimed = {"tier": "replayed", "record": hashlib.sha256(mine.read_bytes()).hexdigest()}
    file.write_text(tiers.verification_text(claimed), encoding="utf-8")
    assert tiers.tier_of(mine) == "replayed"
    verify(mine, "recomputed", honest)
    assert not file.exists()


@pytest.mark.long
@pytest.mark.parametrize("named", ["typo:clbench/Toy-v0", f"{TOY}x", "clbench/Fetch-v1"])
def test_a_wrong_name_of_the_verifier_takes_no_tier_back(named: str, mine: Path, honest: Path) -> None:
    verify(mine, "replayed", honest)
    stored = tiers.verification_path(mine).read_bytes()
    checks = verify(mine, "replayed", honest, scenario=named)
    assert not any(check.passed is False for check in checks)
    assert tiers.verification_path(mine).read_bytes() == stored


@pytest.mark.parametrize("levels", [-1, 1])
def test_a_wrong_folder_of_records_takes_no_tier_back(
    levels: int, mine: Path, honest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verify(mine, "recomputed", honest)
    stored = tiers.verification_path(mine).read_bytes()
    records = mine.parents[2]
    wrong = records.parent if levels < 0 else mine.parents[1]
    with pytest.raises(SystemExit) as stopped:
        app(["verify", str(mine), "--records", str(wrong)])
    assert stopped.value.code == 2
    assert f"add --records {records}." in " ".join(capsys.readouterr().err.split())
    assert tiers.verification_path(mine).read_bytes() == stored


def test_a_record_that_cannot_be_read_here_keeps_its_tier(mine: Path, honest: Path) -> None:
    verify(mine, "recomputed", honest)
    stored = tiers.verification_path(mine).read_bytes()
    edit(mine, lambda values: values.update(schema=99))
    (check,) = verify(mine, "recomputed", honest)
    assert check.passed is None
    assert tiers.verification_path(mine).read_bytes() == stored


@pytest.mark.long
def test_a_check_that_fails_leaves_the_tier_below(mine: Path, honest: Path) -> None:
    edit(mine, lambda values: flip(values, 0, 60))
    claimed = {"tier": "retrained", "record": hashlib.sha256(mine.read_bytes()).hexdigest()}
    tiers.verification_path(mine).write_text(tiers.verification_text(claimed), encoding="utf-8")
    assert "episodes: 1 of" in failures(verify(mine, "replayed", honest))
    assert tiers.tier_of(mine) == "recomputed"


@pytest.mark.long
def test_a_record_that_is_named_twice_is_verified_once(
    mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").verify
    records = next(folder for folder in mine.parents if folder.name == "records")
    options: dict[str, Any] = {"tier": "recomputed", "scenario": TOY, "records": records, "workers": 1}
    command(mine.parent, mine, as_json=True, **options)
    assert len(json.loads(capsys.readouterr().out)) == 1


@pytest.mark.parametrize("changes", [{}, {"step_factor": 0.3}])
def test_a_module_that_a_record_names_is_not_imported_unless_the_verifier_allows_it(
    changes: dict[str, float], mine: Path, honest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace = f"import pathlib\npathlib.Path({str(tmp_path / 'ran')!r}).touch()\n"
    (tmp_path / "stranger.py").write_text(f"{trace}class Mine: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "stranger", raising=False)
    record = read_record(mine)
    place = record_path(mine.parents[2], "clbench/Toy-v0", label_of("stranger:Mine", changes), 0)
    place.parent.mkdir()
    settings = {**record.run.settings, **changes}
    run = {**vars(record.run), "method": "stranger:Mine", "settings": settings, "changes": changes}
    values = {**json.loads(mine.read_text(encoding="utf-8")), "run": run}
    place.write_text(json.dumps(sealed(values)), encoding="utf-8")
    checks = verify(place, "replayed", honest)
    assert "stranger:Mine is not installed: name it with --method" in failures(checks)
    assert tiers.tier_of(place) == "recomputed"
    assert not (tmp_path / "ran").exists()
    verify(place, "replayed", honest, method="stranger:Mine")
    assert (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"budget": {**vars(TOY_SCENARIO.budget), "demonstrations": 10**6}}, "scenario.budget"),
        ({"balanced": True}, "scenario.balanced"),
        ({}, ""),
    ],
)
def test_a_method_that_is_not_installed_has_the_scenario_of_all_others(
    fields: dict[str, Any], reason: str, mine: Path
) -> None:
    place = record_path(mine.parents[2], "clbench/Toy-v0", "stranger:Mine", 0)
    place.parent.mkdir()
    shutil.move(mine, place)
    edit(place, lambda values: values["run"].update(method="stranger:Mine"))
    edit(place, lambda values: values["scenario"].update(fields))
    expected = f"what was run: {reason} differ from the installed code" if fields else ""
    assert failures(verify(place, "recomputed")) == expected
    assert tiers.tier_of(place) == ("self-reported" if fields else "recomputed")


def test_a_run_on_a_device_that_is_missing_here_is_recomputed_and_no_more(mine: Path, honest: Path) -> None:
    edit(mine, lambda values: values["run"].update(device="cuda:9"))
    assert "policies: The device 'cuda:9' cannot be used" in failures(verify(mine, "retrained", honest))
    assert tiers.tier_of(mine) == "recomputed"


@pytest.mark.long
def test_the_command_lists_its_checks(mine: Path, honest: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").verify
    records = next(folder for folder in mine.parents if folder.name == "records")
    command(mine, tier="recomputed", scenario=TOY, records=records, workers=1)
    assert "recomputed" in capsys.readouterr().out
    edit(mine, lambda values: flip(values, 1))
    with pytest.raises(SystemExit) as stopped:
        command(mine.parent, tier="recomputed", scenario=TOY, records=records, workers=1)
    assert stopped.value.code == 1
    assert "NOT ends of episodes" in capsys.readouterr().out


@pytest.mark.long
def test_a_strangers_text_in_a_check_does_not_control_the_terminal(
    mine: Path, honest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").verify
    edit(mine, lambda values: values["fingerprint"]["rollouts"].update({"[red]\x1b[2Jw\n  ok  b": "0"}))
    with pytest.raises(SystemExit):
        command(mine, tier="recomputed", scenario=TOY, records=mine.parents[2], workers=1)
    shown = capsys.readouterr().out
    assert "the rollouts of [red]\\x1b[2Jw\\n  ok  b differ" in shown
    assert "\x1b" not in shown


@pytest.mark.long
def test_a_record_elsewhere_is_refused_with_the_option_that_finds_it(
    mine: Path, honest: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").verify
    records = next(folder for folder in mine.parents if folder.name == "records")
    monkeypatch.chdir(records.parent)
    beside = Path("records") / mine.relative_to(records)
    with pytest.raises(SystemExit) as stopped:
        command(beside, tier="recomputed", scenario=TOY, workers=1)
    assert stopped.value.code == 2
    assert f"{mine} is not below " in (error := capsys.readouterr().err)
    assert "set --records to the folder in which the record is SCENARIO/METHOD/seed-N.json" in error
    with pytest.raises(SystemExit, match="2"):
        command(mine, tier="recomputed", records=records.parent, workers=1)
    assert f"{mine} belongs below {records}: add --records {records}." in capsys.readouterr().err
    command(beside, tier="recomputed", scenario=TOY, records=Path("records"), workers=1)
    assert f"{beside}: recomputed" in capsys.readouterr().out


@pytest.mark.long
def test_the_command_prints_json_of_good_and_bad_records(
    mine: Path, honest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").verify
    records = next(folder for folder in mine.parents if folder.name == "records")
    bad = mine.with_name("seed-1.json")
    bad.write_text("{}")
    mine.with_name("seed-2.json").mkdir()
    with pytest.raises(SystemExit) as stopped:
        command(mine.parent, tier="recomputed", scenario=TOY, records=records, workers=1, as_json=True)
    assert stopped.value.code == 1
    good, bad_one, folder = json.loads(capsys.readouterr().out)
    assert "seed-2.json: cannot be read (Is a directory)" in folder["failure"]
    assert good["path"] == str(mine)
    assert (good["passed"], good["tier"], good["failure"]) == (True, "recomputed", None)
    assert good["checks"]
    assert all(check["passed"] for check in good["checks"])
    assert (bad_one["passed"], bad_one["tier"]) == (False, "self-reported")
    assert [(check["name"], check["passed"]) for check in bad_one["checks"]] == [("record", False)]
    assert str(bad) in bad_one["path"]
    assert bad_one["failure"]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"pretrain": True}, "add --tier retrained"),
        ({"tier": "replay"}, "Did you mean 'replayed'?"),
        ({"checkpoints": Path("nowhere")}, "There is no folder nowhere. --checkpoints names the folder"),
        ({"paths": ["nowhere.json"]}, "There is no record at nowhere.json"),
        ({"paths": []}, "There is no record to verify"),
        ({"records": Path("elsewhere/records")}, "elsewhere/records: set --records to the folder"),
    ],
)
def test_a_wrong_word_on_the_command_line_is_named(
    arguments: dict[str, Any], reason: str, mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = importlib.import_module("clbench.leaderboard.cli").verify
    paths = arguments.pop("paths", [mine])
    with pytest.raises(SystemExit) as stopped:
        command(*map(Path, paths), **arguments)
    assert stopped.value.code == 2
    assert reason in capsys.readouterr().err
