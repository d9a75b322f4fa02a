"""Runs whose stages end when the target is learned."""

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from eager import EAGER
from helpers import stage_policies
from torch import nn

from clbench.base.cache import cache_folder
from clbench.evaluation.checks import Checker
from clbench.evaluation.examiner import Examiner
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.adaptation import Step
from clbench.learning.method import Method, Stage
from clbench.learning.trainer import Trainer
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.length import run_length
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.runs.stages import keep_stage
from clbench.runs.start import evaluate_pretrained
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.spec.protocol import Point, check_steps
from clbench.spec.registry import load_scenario
from clbench.testing import ContractError, check_method

verification = importlib.import_module("clbench.leaderboard.submission.verify")
subject = importlib.import_module("clbench.leaderboard.submission.subject")
tiers = importlib.import_module("clbench.leaderboard.board.tiers")


def test_a_stage_ends_at_the_first_check_that_meets_the_criterion(record: Record) -> None:
    assert record.status == "success", record.error
    planned = check_steps(200)
    for stage in (1, 2):
        rows = [row for row in record.check_rows() if row.stage == stage]
        assert tuple(row.step for row in rows) == planned[: len(rows)]
        assert [row.successes >= 3 for row in rows] == [False] * (len(rows) - 1) + [True]
        assert 0 < rows[-1].step < 200
    steps = [row.step for row in record.check_rows() if row.successes >= 3]
    assert record.costs.optimiser_steps == sum(steps)


def test_every_task_is_evaluated_at_the_end_of_each_stage_and_nowhere_else(record: Record) -> None:
    ends = {row.stage: row.step for row in record.check_rows()}
    episodes = dict.fromkeys(("left", "up", "right", "down", "up_left"), EAGER.budget.test_episodes)
    for stage, step in {0: 0, **ends}.items():
        played = [row.task for row in record.episode_rows() if row.point == Point(stage, step)]
        assert {task: played.count(task) for task in played} == episodes
    assert len(record.episode_rows()) == 3 * sum(episodes.values())
    assert {row.split for row in record.episode_rows()} == {"test"}


@pytest.mark.long
def test_checks_play_validation_episodes_until_their_outcome_is_certain(
    record: Record, tmp_path: Path
) -> None:
    run = RunSpec(EAGER.id, "sft", seed=0).resolve()
    policies = stage_policies(run)  # made again, with checks of their own
    evaluator = Evaluator(run.scenario, seed=0)
    for stage in (1, 2):
        last = [row for row in record.check_rows() if row.stage == stage][-1]
        outcomes = evaluator.evaluate(policies[stage], [run.scenario.target[stage - 1]])
        assert 3 <= last.successes <= last.episodes <= len(outcomes)
        assert sum(one.success for one in outcomes) >= 3
    evaluator.close()


@pytest.mark.long
def test_a_check_plays_the_policy_that_a_method_of_whole_stages_would_leave(tmp_path: Path) -> None:
    run = RunSpec(EAGER.id, "weight_interpolation", 0, {"coefficient": 0.7}, targets=1).resolve()
    record = execute(run.spec, tmp_path / "records", checkpoints=tmp_path / "kept")
    assert record.status == "success", record.error
    last = record.check_rows()[-1]
    assert last.successes >= 3
    evaluator = Evaluator(run.scenario, seed=0)
    merged = stage_policies(run, tmp_path / "kept")[1]
    assert sum(one.success for one in evaluator.evaluate(merged, [run.scenario.target[0]])) >= 3
    evaluator.close()


@pytest.mark.long
def test_asking_for_the_policy_that_a_stage_would_leave_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = RunSpec(EAGER.id, "buffered_replay", seed=0).resolve()
    monkeypatch.setattr(run.method, "whole_stages", True)  # its `end_task` draws from the target
    left = []
    for asks in (False, True):
        trainer = Trainer.open(run.scenario, run.new_method, 0, "cpu")
        trainer.prepare()

        def after(step: Step, trainer: Trainer = trainer, asks: bool = asks) -> bool:
            if asks:
                trainer.finished()
            return step.done == 20

        trainer.learn(1, after)
        left.append((trainer.policy.state_dict(), trainer.state(1)))
    for one, other in zip(*left, strict=True):
        assert one.keys() == other.keys()
        assert all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.long
@pytest.mark.parametrize(("share", "stage"), [(0.6, 1), (0.8, 2)])
def test_an_interrupted_run_continues_to_the_same_record(
    share: float, stage: int, record: Record, execute_and_kill: Callable[..., None], tmp_path: Path
) -> None:
    spec = RunSpec(EAGER.id, "sft", seed=0)
    execute_and_kill(spec, tmp_path, share)
    kept = (cache_folder() / "runs").glob(f"*/stage-{stage}/record.json")
    before = read_record(max(kept, key=lambda path: path.stat().st_mtime)).timing
    amounts: list[float] = []
    again = execute(spec, tmp_path, amounts.append)
    assert again.timing["resumed_after"] == stage  # the second time it was relearning
    assert again.timing["started"] == before["started"]  # whatever happened since
    assert again.timing["seconds"] >= before["seconds"] + again.timing["relearning"]
    run = spec.resolve()
    assert sum(amounts) == pytest.approx(run_length(run.scenario, run.protocol), rel=0.05)
    for part in verification.PARTS:
        assert getattr(again, part) == getattr(record, part)


@pytest.mark.long
def test_the_time_of_a_stage_is_that_of_its_training_its_checks_and_its_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1e9]  # later than any clock of this machine

    def taking(seconds: float, function: Callable[..., Any]) -> Callable[..., Any]:
        def slow(*arguments: Any, **named: Any) -> Any:
            now[0] += seconds
            return function(*arguments, **named)

        return slow

    monkeypatch.setattr("clbench.runs.run.time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr("clbench.runs.run.relearns", lambda _: False)
    for cls, name, seconds in (
        (Checker, "check", 100),
        (Examiner, "examine", 10_000),
        (TransformerPolicy, "action_loss", 1),
    ):
        monkeypatch.setattr(cls, name, taking(seconds, getattr(cls, name)))
    record = execute(RunSpec(EAGER.id, "sft", seed=0, targets=1), tmp_path)
    checks = record.check_rows()
    steps = {"training": checks[-1].step, "checks": 100 * len(checks), "evaluation": 10_000}
    assert record.timing["stages"] == [steps]


@pytest.mark.long
def test_a_method_that_trains_nothing_is_checked_once(tmp_path: Path) -> None:
    record = execute(RunSpec(EAGER.id, "frozen", seed=0), tmp_path)
    assert [(row.stage, row.step) for row in record.check_rows()] == [(1, 0), (2, 0)]
    scores = Scores.from_record(record)
    assert measure("steps_to_criterion", scores) == 200  # never learned: all steps of the budget
    assert measure("criterion_met", scores) == 0


@pytest.mark.long
def test_a_stage_that_never_meets_the_criterion_takes_all_its_steps(tmp_path: Path) -> None:
    spec = RunSpec(EAGER.id, "sft", seed=0, changes={"step_factor": 1e-6}, targets=1)
    record = execute(spec, tmp_path)
    assert [row.step for row in record.check_rows()] == list(check_steps(200))
    scores = Scores.from_record(record)
    assert measure("steps_to_criterion", scores) == 200
    assert scores.met.tolist() == [0]


@dataclass
class Hasty(Method):
    """Learns the target before the first step that counts."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        optimiser = torch.optim.SGD(policy.parameters(), 1e-3)
        for _ in range(3):
            optimiser.zero_grad()
            policy.action_loss(stage.target.sample(8)).mean().backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        return policy.parameters()


@dataclass
class Lazily(Hasty):
    """Does the same while its parameters are listed."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        yield from super().start_task(policy, stage)


@pytest.mark.parametrize("method", [Hasty, Lazily])
def test_a_target_is_not_learned_before_the_steps_that_count(
    method: type[Method], tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(EAGER.id, stranger(method), seed=0), tmp_path)
    assert record.error is not None
    assert (
        "start_task() took 3 optimiser steps. With a criterion it must take none" in record.error["message"]
    )
    with pytest.raises(ContractError, match=r"no optimiser steps: a target is learned in the steps that"):
        check_method(method)


def test_each_seed_learns_the_targets_in_its_own_order(tmp_path: Path) -> None:
    orders = [RunSpec(EAGER.id, "sft", seed=seed).resolve().scenario.target for seed in range(4)]
    names = [[task.name for task in order] for order in orders]
    assert names[:2] == [["right", "down"], ["down", "right"]]
    assert sorted(names[2:]) == sorted(names[:2])
    with pytest.raises(ValueError, match="each seed learns the targets in its own order"):
        RunSpec(EAGER.id, "sft", seed=0, order=1).resolve()


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda checks: checks["step"].__setitem__(1, 3), "are not at the steps"),
        (lambda checks: [column.pop() for column in checks.values()], "end before the criterion was met"),
        (
            lambda checks: [checks[name].__setitem__(0, 4) for name in ("episodes", "successes")],
            "go on after",
        ),
        (lambda checks: checks["successes"].__setitem__(0, 5), "impossible counts"),
        (lambda checks: checks["episodes"].__setitem__(0, 5), "impossible counts"),  # a task has four
        (lambda checks: checks["stage"].__setitem__(0, 3), "a stage of the run"),
        (lambda checks: [column.clear() for column in checks.values()], "are not at the steps"),
    ],
)
def test_checks_that_contradict_the_protocol_are_refused(
    edit: Callable[[dict[str, list[Any]]], Any], words: str, record: Record
) -> None:
    checks = {name: list(column) for name, column in record.checks.items()}
    edit(checks)
    with pytest.raises(ValueError, match=words):
        Scores.from_record(replace(record, checks=checks))


def test_the_scenario_says_which_order_a_seed_has(record: Record) -> None:
    assert record.scenario.balanced
    assert record.scenario.target == ["right", "down"]
    assert load_scenario(EAGER.id).for_seed(1).target[0].name == "down"


@pytest.mark.long
def test_a_record_with_a_criterion_reaches_every_tier(record: Record, tmp_path: Path) -> None:
    records = tmp_path / "records"
    spec = RunSpec(EAGER.id, "sft", seed=0)
    write_record(record, spec.path(records))
    for tier in ("replayed", "retrained"):
        request = subject.Request(tier=tier, episodes=20, seed=7)
        checks = verification.verify(spec.path(records), records, request)
        assert all(check.passed for check in checks), checks
    assert "ends of stages" in [check.name for check in checks]
    assert tiers.tier_of(spec.path(records)) == "retrained"


@pytest.mark.long
@pytest.mark.usefixtures("empty_caches")
def test_all_episodes_around_a_run_have_its_seed_and_its_kept_policies_are_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds, play = set[int](), Evaluator.play

    def noted(self: Evaluator, *arguments: Any, **options: Any) -> Any:
        seeds.add(self.seed)
        return play(self, *arguments, **options)

    monkeypatch.setattr(Evaluator, "play", noted)
    spec, records = RunSpec(EAGER.id, "sft", seed=1), tmp_path / "records"
    evaluate_pretrained(spec.resolve())
    execute(spec, records, checkpoints=tmp_path / "kept")
    for kept in (tmp_path / "kept", None):  # the second time they are trained again
        request = subject.Request(tier="replayed", episodes=5, seed=7, checkpoints=kept)
        found = verification.verify(spec.path(records), records, request)
        assert all(check.passed for check in found), found
    assert seeds == {1}


@pytest.mark.long
def test_a_record_whose_last_check_does_not_repeat_itself_stays_recomputed(
    record: Record, tmp_path: Path
) -> None:
    spec = RunSpec(EAGER.id, "sft", seed=0)
    checks = {name: list(column) for name, column in record.checks.items()}
    checks["episodes"][-1] = 7 - checks["episodes"][-1]  # 3 episodes instead of 4, or the reverse
    write_record(replace(record, checks=checks), spec.path(tmp_path))
    request = subject.Request(tier="replayed", episodes=20, seed=7)
    found = verification.verify(spec.path(tmp_path), tmp_path, request)
    assert [check.name for check in found if not check.passed] == ["ends of stages"]


@pytest.mark.long
def test_a_made_up_check_on_the_way_and_made_up_relearning_are_found_by_the_whole_run(
    record: Record, tmp_path: Path
) -> None:
    spec = RunSpec(EAGER.id, "sft", seed=0)
    checks = {name: list(column) for name, column in record.checks.items()}
    checks["successes"][0] = 1 - checks["successes"][0]  # too few to end the stage, as before
    assert record.relearning is not None
    relearning = replace(record.relearning, successes=record.relearning.successes + 1)
    write_record(replace(record, checks=checks, relearning=relearning), spec.path(tmp_path))
    request = subject.Request(tier="retrained", episodes=20, seed=7)
    found = verification.verify(spec.path(tmp_path), tmp_path, request)
    assert [check.found for check in found if not check.passed] == [
        "repeated, checks (successes), relearning (successes) differ"
    ]


@pytest.mark.slow
def test_kept_policies_of_other_settings_under_this_name_are_found_by_going_on_from_them(
    tmp_path: Path,
) -> None:
    spec, other = RunSpec(EAGER.id, "sft", seed=0), RunSpec(EAGER.id, "sft", 0, {"step_factor": 0.2})
    honest = execute(spec, tmp_path / "records", checkpoints=tmp_path / "kept")
    request = subject.Request(tier="replayed", episodes=20, seed=7, checkpoints=tmp_path / "kept")
    found = verification.verify(spec.path(tmp_path / "records"), tmp_path / "records", request)
    assert all(check.passed for check in found), found
    assert "from stage to stage" in [check.name for check in found]

    made = execute(other, tmp_path / "others", checkpoints=tmp_path / "others_kept")
    forged = replace(made, run=honest.run)
    write_record(forged, spec.path(tmp_path / "forged"))
    for number in range(3):
        stage = other.path(tmp_path / "others_kept").with_suffix("") / f"stage-{number}"
        keep_stage(spec.resolve(), tmp_path / "forged_kept", number, stage)
    request = subject.Request(tier="replayed", episodes=20, seed=7, checkpoints=tmp_path / "forged_kept")
    found = verification.verify(spec.path(tmp_path / "forged"), tmp_path / "forged", request)
    assert [check.name for check in found if not check.passed] == ["from stage to stage"]
