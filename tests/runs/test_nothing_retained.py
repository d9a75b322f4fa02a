"""A scenario that retains no tasks, such as Continual World: its schedule, its runs and its page."""

import dataclasses
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec

from clbench.data.questions import load_questions
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import load_method
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.agents import evaluate_agent, next_stage
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.spec.registry import load_scenario
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
SCENARIO = dataclasses.replace(
    TOY,
    id="clbench/ToyUnretained-v0",
    retained=(),
    scenes=TOY.retained,
    held_out=(),
    budget=dataclasses.replace(
        TOY.budget,
        pretraining_steps=60,
        adaptation_steps=10,
        evaluation_points=1,
        validation_episodes=1,
        test_episodes=2,
        curve_episodes=1,
    ),
)


@pytest.fixture(scope="module", autouse=True)
def _registered() -> Iterator[None]:
    spec = EnvSpec(
        SCENARIO.id,
        "clbench.worlds.scenario_env:ScenarioEnv",
        kwargs={"scenario": "clbench.testing:UNRETAINED"},
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("clbench.testing.UNRETAINED", SCENARIO, raising=False)
        patch.setitem(gymnasium.registry, SCENARIO.id, spec)
        yield


def run(method: str, folder: Path, **changes: int) -> Record:
    return execute(RunSpec(SCENARIO.id, method, 0, changes), folder)


def test_the_schedule_of_many_environments_begins_with_the_first_target() -> None:
    many = ScenarioVectorEnv(SCENARIO, num_envs=2, episodes_per_stage=2)
    assert many.reset(seed=0)[1]["task"].tolist() == ["right", "right"]
    many.close()


def test_online_agents_are_refused_because_there_is_no_stage_0(tmp_path: Path) -> None:
    env = gymnasium.make(SCENARIO.id, stage=1)
    with pytest.raises(ValueError, match="clbench/ToyUnretained-v0 has no retained skills"):
        evaluate_agent(lambda _: np.zeros(2), env, method="me/still", records=tmp_path)
    with pytest.raises(ValueError, match="has no retained skills"):
        next_stage(SCENARIO.id, method="me/still", records=tmp_path)


def test_the_policy_learns_only_answers_and_its_actions_are_not_normalised() -> None:
    policy, _ = pretrained_policy(SCENARIO, 0)
    train, _ = load_questions(SCENARIO)
    torch.testing.assert_close(policy.state_mean, train.scenes.mean(dim=0))
    assert policy.action_mean.tolist() == [0.0, 0.0]
    assert policy.action_std.tolist() == [1.0, 1.0]


def test_questions_ask_about_the_scenes_of_other_tasks() -> None:
    assert SCENARIO.scene_tasks == TOY.retained == TOY.scene_tasks
    train, _ = load_questions(SCENARIO)
    assert len(train) > SCENARIO.budget.question_episodes


# one method for each use of prior demonstrations; without demonstrations each is plain fine-tuning
@pytest.mark.long
@pytest.mark.parametrize("method", ["experience_replay", "joint", "a_gem", "buffered_replay", "ewc"])
def test_a_method_that_replays_begins_with_the_first_target(method: str, tmp_path: Path) -> None:
    record = run(method, tmp_path, **({"samples": 4} if method == "ewc" else {}))
    assert record.error is None
    assert record.costs.optimiser_steps == 20


def test_a_method_that_needs_prior_demonstrations_fails_with_the_reason(tmp_path: Path) -> None:
    record = run("fast_dvla", tmp_path)
    assert record.status == "failed"
    assert record.error is not None
    assert record.error["where"] == "prepare"
    assert "the scenario retains no tasks" in record.error["message"]


@pytest.fixture
def record(make_record: Callable[..., Record]) -> Record:
    """Return a record of three targets; the first one is half forgotten."""
    success = [[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.6, 0.8, 0.0], [0.4, 0.8, 0.7]]
    curves = [[0.2, 0.5, 0.7], [0.1, 0.4, 0.8], [0.3, 0.5, 0.6]]
    answers = {(stage, "side"): (100, 90) for stage in range(4)}
    return make_record(
        success, curves=curves, validation=np.full((3, 4), 0.8), groups=(0, 3, 0), answers=answers
    )


def test_retention_is_missing_and_forgetting_covers_earlier_targets(record: Record) -> None:
    scores = Scores.from_record(record)
    assert measure("retention", scores) is None
    assert measure("minimum_retention", scores) is None
    assert measure("forgetting", scores) == pytest.approx((0.9 - 0.4 + 0.8 - 0.8) / 2)
    assert measure("adaptation", scores) == pytest.approx(0.8)


@pytest.mark.long
def test_table_and_page_are_drawn_without_retention(record: Record, tmp_path: Path) -> None:
    for method in ("sft", "joint"):
        uses = dataclasses.asdict(load_method(method).uses)
        other = dataclasses.replace(record, run=dataclasses.replace(record.run, method=method, uses=uses))
        write_record(other, record_path(tmp_path / "records", "clbench/Toy-v0", method, 0))
    importlib.import_module("clbench.leaderboard.cli").show(records=tmp_path / "records")
    assert "| sft |" in (tmp_path / "site" / "LEADERBOARD.md").read_text()
    assert "clbench/Toy-v0" in (tmp_path / "site" / "index.html").read_text()
