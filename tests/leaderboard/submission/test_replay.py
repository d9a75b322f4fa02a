"""Replaying: the policies that a run kept must begin where pretraining ends."""

import dataclasses
import hashlib
import importlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from eager import EAGER
from rich.console import Console
from safetensors.torch import load_file, save_file
from verification import TOY, edit, failures, flip, verify

from clbench.base.cache import MANIFEST, cached
from clbench.base.progress import listen
from clbench.evaluation.rollouts import Evaluator
from clbench.jobs.job import Job
from clbench.learning.method import Method
from clbench.policy.policy import Policy
from clbench.records.paths import record_name
from clbench.records.reader import read_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.spec.registry import load_scenario

tiers = importlib.import_module("clbench.leaderboard.board.tiers")
subject = importlib.import_module("clbench.leaderboard.submission.subject")
verifier = importlib.import_module("clbench.leaderboard.submission.verify")


@pytest.fixture
def elsewhere(honest: Path, tmp_path: Path) -> Path:
    """Return a copy of the honest run whose policies all have another normalisation, by 1e-7."""
    for stage in (honest / "checkpoints").rglob("stage-*"):
        inputs = json.loads((stage / MANIFEST).read_text(encoding="utf-8"))["made_from"]

        def write(folder: Path, stage: Path = stage) -> None:
            shutil.copytree(stage, folder, dirs_exist_ok=True)
            tensors = load_file(stage / "policy.safetensors")
            tensors["state_mean"] += 1e-7
            save_file(tensors, folder / "policy.safetensors")

        place = tmp_path / "elsewhere" / stage.relative_to(honest)
        place.parent.mkdir(parents=True, exist_ok=True)
        cached(place, inputs, write)
    return tmp_path / "elsewhere"


@pytest.mark.long
def test_policies_that_follow_from_another_start_than_pretraining_gives_are_refused(
    mine: Path, elsewhere: Path
) -> None:
    checks = verify(mine, "replayed", elsewhere)
    found = {check.name: check.passed for check in checks}
    assert found["from stage to stage"] is True
    assert found["start"] is False
    assert tiers.tier_of(mine) == "recomputed"


@pytest.mark.long
def test_a_record_may_hold_its_episodes_in_any_order(mine: Path, honest: Path) -> None:
    def turn_round(values: dict[str, Any]) -> None:
        values["episodes"] = {name: column[::-1] for name, column in values["episodes"].items()}

    edit(mine, turn_round)
    assert all(check.passed for check in verify(mine, "replayed", honest))
    assert tiers.tier_of(mine) == "replayed"


def test_the_record_of_a_machine_that_pretrains_otherwise_cannot_be_replayed_here(
    mine: Path, honest: Path
) -> None:
    edit(
        mine,
        lambda values: values["fingerprint"].update(pretrained="0" * 16, hardware={"instructions": "NEON"}),
    )
    (check,) = (check for check in verify(mine, "replayed", honest) if check.passed is None)
    assert "(its processor: unknown with NEON; here: " in check.found
    assert tiers.tier_of(mine) == "recomputed"


def from_another_maker(values: dict[str, Any]) -> None:
    values["fingerprint"]["hardware"]["processor"] = "Abacus 9000"


@pytest.mark.long
def test_equal_results_on_another_processor_prove_a_record_to_those_who_try(mine: Path, honest: Path) -> None:
    edit(mine, from_another_maker)
    checks = verify(mine, "replayed", honest, any_processor=True)
    assert all(check.passed for check in checks)
    (policies,) = (check for check in checks if check.name == "policies")
    assert policies.found.startswith("kept by the run, played on another processor (its processor: Abacus")
    assert tiers.tier_of(mine) == "replayed"


@pytest.mark.long
def test_other_results_on_another_processor_prove_nothing(mine: Path, honest: Path) -> None:
    edit(mine, from_another_maker)
    edit(mine, lambda values: flip(values, 0, 60))
    (check,) = (one for one in verify(mine, "replayed", honest, any_processor=True) if not one.passed)
    assert check.passed is None
    assert "1 of " in check.found
    assert "its processor: Abacus" in check.found
    assert tiers.tier_of(mine) == "recomputed"


@pytest.mark.long
def test_another_version_of_clbench_excuses_no_other_outcome(mine: Path, honest: Path) -> None:
    edit(mine, lambda values: values["fingerprint"]["versions"].update(clbench="0.0.1"))
    edit(mine, lambda values: flip(values, 0, 60))
    checks = verify(mine, "replayed", honest)
    assert {one.name: one.passed for one in checks}["episodes"] is False


@pytest.mark.long
def test_a_whole_run_that_ends_otherwise_when_it_is_repeated_takes_that_tier_away(
    mine: Path, honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claimed = {"tier": "retrained", "record": hashlib.sha256(mine.read_bytes()).hexdigest()}
    tiers.verification_path(mine).write_text(tiers.verification_text(claimed), encoding="utf-8")
    assert tiers.tier_of(mine) == "retrained"
    again = read_record(mine)
    again.costs.bytes_kept = 1
    monkeypatch.setattr(verifier, "execute", lambda *_: again)
    *_, last = verify(mine, "retrained", honest)
    assert (last.name, last.passed) == ("whole run", False)
    assert "costs (bytes_kept) differ" in last.found
    assert tiers.tier_of(mine) == "replayed"


@pytest.mark.long
def test_the_replayed_episodes_are_drawn_at_random_from_the_ends_of_all_stages(
    mine: Path, honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[list[Any]] = []

    class Listing(Evaluator):
        """Notes the episodes that are asked for, and ends the verification after them."""

        def play(self, policy: Any, trials: Any, *arguments: Any, **options: Any) -> Any:
            looks[-1].append([(one.task.name, one.split, one.number) for one in trials])
            return []

        def close(self) -> None:
            super().close()
            raise RuntimeError("enough was seen")

    monkeypatch.setattr("clbench.leaderboard.submission.replay.Evaluator", Listing)
    for seed in range(6):
        looks.append([])
        with pytest.raises(RuntimeError, match="enough was seen"):
            verify(mine, "replayed", honest, episodes=10, seed=seed)
    assert [sum(map(len, stages)) for stages in looks] == [10] * 6
    assert all(sum(len(stages[number]) for stages in looks) > 6 for number in range(3))
    assert len({str(stages) for stages in looks}) == 6


@pytest.mark.long
@pytest.mark.parametrize(
    ("tier", "change", "message"),
    [
        ("replayed", {"hardware": {"instructions": "NEON"}}, " with NEON; here: "),
        ("retrained", {"versions": {"torch": "1.0"}}, "torch was 1.0 and is "),
        ("recomputed", {"versions": {"mujoco": "1.0"}, "rollouts": {}}, "mujoco was 1.0 and is "),
    ],
)
def test_a_machine_that_cannot_tell_takes_no_tier_away(
    mine: Path,
    honest: Path,
    monkeypatch: pytest.MonkeyPatch,
    tier: str,
    change: dict[str, Any],
    message: str,
) -> None:
    module = "clbench.leaderboard.submission.verify"
    monkeypatch.setattr(f"{module}.simulator_versions", lambda tasks: {"mujoco": "3.0"})
    verify(mine, "recomputed", honest)
    earned = tiers.verification_path(mine)
    stored = json.loads(earned.read_text(encoding="utf-8"))

    def made_elsewhere(values: dict[str, Any]) -> None:
        for part, entries in change.items():
            values["fingerprint"][part] = {**values["fingerprint"][part], **entries} if entries else entries

    edit(mine, made_elsewhere)
    digest = hashlib.sha256(mine.read_bytes()).hexdigest()
    earned.write_text(tiers.verification_text({**stored, "tier": "retrained", "record": digest}))
    (check,) = (check for check in verify(mine, tier, honest) if not check.passed)
    assert message in check.found
    assert check.passed is None
    assert tiers.tier_of(mine) == "retrained"


@pytest.mark.long
def test_a_stage_that_is_said_to_have_learned_its_target_earlier_is_refused(tmp_path: Path) -> None:
    spec = RunSpec(EAGER.id, "sft", 0)
    record = execute(spec, tmp_path / "records")
    path = spec.path(tmp_path / "records")
    ends = [row.step for row in record.check_rows() if row.stage == 1]
    assert len(ends) >= 3

    def end_earlier(values: dict[str, Any]) -> None:
        """Leave out the check before the last one of stage 1, and give the last one its step."""
        for column in values["checks"].values():
            column.pop(len(ends) - 2)
        values["checks"]["step"][len(ends) - 2] = ends[-2]
        for table in ("episodes", "answers", "policy"):
            steps = zip(values[table]["stage"], values[table]["step"], strict=True)
            values[table]["step"] = [ends[-2] if row == (1, ends[-1]) else row[1] for row in steps]

    edit(path, end_earlier)
    found = failures(verify(path, "replayed", scenario=EAGER.id))
    assert f"ends of stages: after [{ends[-2]}, " in found
    assert f"trained again, after [{ends[-1]}, " in found
    edit(path, lambda values: values["costs"].update(optimiser_steps=1))
    assert "costs: 1 optimiser steps are fewer than" in failures(
        verify(path, "recomputed", scenario=EAGER.id)
    )


@pytest.mark.long
def test_every_episode_is_replayed_with_the_one_thread_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = RunSpec(EAGER.id, "frozen", 0)
    execute(spec, tmp_path / "records")
    play, threads = Evaluator.play, []

    def watched(*arguments: Any, **options: Any) -> Any:
        threads.append(torch.get_num_threads())
        return play(*arguments, **options)

    monkeypatch.setattr(Evaluator, "play", watched)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert failures(verify(spec.path(tmp_path / "records"), "replayed", scenario=EAGER.id)) == ""
    finally:
        torch.set_num_threads(before)
    stages = len(EAGER.target)
    assert len(threads) >= (stages + 1) + stages  # the ends of stages, and the last checks of the targets
    assert set(threads) == {1}


@pytest.mark.long
def test_a_tuning_run_is_verified_like_any_other(tmp_path: Path) -> None:
    spec = RunSpec(TOY, "frozen", 100, {"step_factor": 0.3}, split="validation")
    execute(spec, tmp_path / "records")
    path = spec.path(tmp_path / "records")
    assert failures(verify(path, "retrained")) == ""
    assert tiers.tier_of(path) == "retrained"


def test_a_test_run_with_a_tuning_seed_is_refused(tmp_path: Path) -> None:
    spec = RunSpec(TOY, "frozen", 100)
    execute(spec, tmp_path / "records")
    path = spec.path(tmp_path / "records")
    assert "seeds from 100 are for tuning" in failures(verify(path, "recomputed"))


@dataclasses.dataclass
class Masking(Method):
    """Keeps a mask in a buffer of the policy, as methods that prune do."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_buffer("mask", torch.ones(3, dtype=torch.bool))

    def load_state(self, policy: Policy, state: Any) -> None:
        self.prepare(policy, None)


@pytest.mark.long
def test_kept_policies_with_a_mask_are_compared(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    spec = RunSpec(TOY, stranger(Masking), 0)
    execute(spec, tmp_path / "records", checkpoints=tmp_path / "checkpoints")
    path = spec.path(tmp_path / "records")
    checks = verify(path, "replayed", tmp_path, method=spec.method)
    assert failures(checks) == ""
    assert "from stage to stage" in {check.name for check in checks}


@pytest.mark.slow
def test_a_step_that_is_said_to_be_much_cheaper_or_dearer_leaves_the_tier_open(tmp_path: Path) -> None:
    spec = RunSpec(TOY, "l2_sp", 0)
    execute(spec, tmp_path / "records")
    path = spec.path(tmp_path / "records")
    assert failures(verify(path, "retrained")) == ""

    def found(ratio: float) -> str:
        edit(path, lambda values: values["timing"].update(step_ratio=ratio))
        return failures(verify(path, "retrained"))

    for ratio in (0.05, 50.0):
        assert f"time of a step: {ratio:.2f} times that of sft in the record" in found(ratio)
        assert tiers.tier_of(path) == "replayed"
    edit(path, lambda values: values["timing"].pop("step_ratio"))
    (said,) = (one.found for one in verify(path, "retrained") if one.name == "time of a step")
    assert said.startswith("not in the record, ")


@pytest.mark.long
def test_a_record_can_be_replayed_from_policies_that_are_made_again(mine: Path) -> None:
    places: list[str] = []
    listen(lambda place, remark: places.append(place))
    try:
        checks = verify(mine, "replayed", episodes=20)
    finally:
        listen(None)
    assert places[0] == "pretraining"  # it may take minutes
    assert failures(checks) == ""
    assert any(check.found.startswith("20 of ") for check in checks)
    assert any(check.found == "trained again" for check in checks)


def test_the_worlds_are_closed_if_a_replay_fails(
    mine: Path, honest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []

    class Broken(Evaluator):
        def play(self, *arguments: Any, **options: Any) -> Any:
            raise RuntimeError("the simulator crashed")

        def close(self) -> None:
            closed.append(self)
            super().close()

    monkeypatch.setattr("clbench.leaderboard.submission.replay.Evaluator", Broken)
    with pytest.raises(RuntimeError, match="the simulator crashed"):
        verify(mine, "replayed", honest)
    assert len(closed) == 1


def test_the_stage_that_is_trained_again_is_drawn_with_the_seed_of_the_verifier(
    mine: Path, honest: Path
) -> None:
    stages = set()
    for seed in range(3):
        checks = verify(mine, "replayed", honest, episodes=1, seed=seed)
        (check,) = (one for one in checks if one.name == "from stage to stage")
        stages.add(check.found.split()[1])
    assert stages == {"1", "2"}


# the square of 1e20 is beyond 32 bits: it must not make every distance infinite
@pytest.mark.parametrize("huge", [0.0, 1e20])
def test_a_policy_that_is_off_by_a_tenth_of_its_way_is_refused(
    huge: float, mine: Path, honest: Path, tmp_path: Path
) -> None:
    for stage in (honest / "checkpoints").rglob("stage-*"):
        inputs = json.loads((stage / MANIFEST).read_text(encoding="utf-8"))["made_from"]

        def write(folder: Path, stage: Path = stage) -> None:
            shutil.copytree(stage, folder, dirs_exist_ok=True)
            weights = load_file(stage / "policy.safetensors")
            if stage.name == "stage-2":
                before = load_file(stage.with_name("stage-1") / "policy.safetensors")
                weights = {name: value + 0.1 * (value - before[name]) for name, value in weights.items()}
            weights["backbone.words.weight"][-1] += huge * int(stage.name[-1])  # no text of the toy uses it
            save_file(weights, folder / "policy.safetensors")

        place = tmp_path / "off" / stage.relative_to(honest)
        place.parent.mkdir(parents=True, exist_ok=True)
        cached(place, inputs, write)
    checks = verify(mine, "replayed", tmp_path / "off", episodes=1, seed=0)
    assert {one.name: one.passed for one in checks}["from stage to stage"] is False


@pytest.mark.long
@pytest.mark.usefixtures("empty_caches")
def test_the_bar_of_a_replay_counts_the_pretraining_that_the_replay_needs(
    mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load_scenario(TOY)
    training = len(scenario.target) * scenario.budget.adaptation_steps

    def run(jobs: list[Job], *_: object) -> dict[Job, str]:
        done: list[float] = []
        for job in jobs:
            job.function(**job.arguments, progress=done.append)
            assert sum(done) == job.length == scenario.budget.pretraining_steps + training + 1
        return {}

    monkeypatch.setattr(verifier, "run_with_bars", run)
    request = subject.Request(tier="replayed", episodes=20, seed=0, scenario=TOY)
    (outcome,) = verifier.run_verifications([mine], mine.parents[2], request, 1, Console())
    assert [check["found"] for check in outcome.checks if check["passed"] is False] == []


def test_the_bar_of_a_verification_imports_no_policy_that_a_record_alone_names(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_policy.py").write_text("", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    edit(mine, lambda values: values["run"].update(policy="evil_policy:Policy"))
    records = mine.parents[2]
    theirs = records / record_name("clbench/Toy-v0", "sft", 0, 0, "evil_policy:Policy")
    theirs.parent.mkdir(parents=True)
    mine.rename(theirs)
    monkeypatch.setattr(verifier, "run_with_bars", lambda *_: {})
    request = subject.Request(tier="replayed", episodes=20, seed=0, scenario=TOY)
    verifier.run_verifications([theirs], records, request, 1, Console())
    assert "evil_policy" not in sys.modules
