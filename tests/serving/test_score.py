"""Scores of policies that were fine-tuned elsewhere: the same as in this process, and nothing is lost."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents import ID, LEARNED, TOY, Knowing, stage_env
from served import serving, write_policy

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.pretraining import policy_config
from clbench.policy.transformer import TransformerPolicy
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.runs.agents import evaluate_agent
from clbench.scoring.scores import Scores
from clbench.serving.client import ServedPolicy
from clbench.serving.score import is_scored, score
from clbench.spec.language import encode

STAGES = range(3)


@pytest.fixture
def run(tmp_path: Path, empty_caches: Path) -> Callable[..., Record]:
    """Return `score` for the method me/elsewhere on the toy, with records and caches for one test."""

    def run(policy: Any, stage: int, **options: Any) -> Record:
        return score(
            ID,
            policy,
            stage=stage,
            **{"method": "me/elsewhere", "records": tmp_path / "records", **options},
        )

    return run


def knowing(stage: int, length: int = 1) -> Callable[[dict[str, Any]], Any]:
    """Return the policy that acts like `Knowing` after a stage, in chunks of `length` actions."""
    agent = Knowing(*LEARNED[stage])

    def act(observations: dict[str, Any]) -> Any:
        state, words = observations["state"], observations["instruction"]
        rows = [{"state": one, "instruction": text} for one, text in zip(state, words, strict=True)]
        actions = [agent.predict(row, deterministic=True)[0] for row in rows]
        return np.repeat(np.array(actions)[:, None], length, axis=1)

    return act


def outcomes(record: Record) -> dict[str, list[Any]]:
    return dict(record.episodes)


def test_a_served_policy_has_exactly_the_outcomes_of_the_same_policy_in_this_process(
    run: Callable[..., Record], tmp_path: Path
) -> None:
    policy_of = write_policy(tmp_path)
    for stage in STAGES:
        here = run(policy_of(stage), stage, records=tmp_path / "here")
        with serving(tmp_path, stage) as (address, _):
            served = ServedPolicy(address)
            there = run(served, stage)
            served.close()
        assert outcomes(there) == outcomes(here)
    assert 0 < np.mean(there.episodes["success"]) < 1


def test_a_server_that_is_killed_during_a_stage_changes_no_outcome(
    run: Callable[..., Record], tmp_path: Path
) -> None:
    expected = run(write_policy(tmp_path)(0), 0, records=tmp_path / "here")
    with serving(tmp_path, 0) as (address, first):
        served, port = ServedPolicy(address), int(address.rpartition(":")[2])
        requests = 0

        def act(observations: dict[str, Any]) -> Any:
            nonlocal requests
            requests += 1
            if requests == 2:
                first.kill()
                first.wait()
                second.__enter__()
            return served(observations)

        second = serving(tmp_path, 0, port)
        try:
            found = run(act, 0)
        finally:
            served.close()
            second.__exit__(None, None, None)
    assert requests > 2
    assert outcomes(found) == outcomes(expected)


KILLED = """
import os, sys
from clbench.serving.client import ServedPolicy
from clbench.serving.score import is_scored, score

options = {"stage": int(sys.argv[2]), "method": "me/elsewhere", "records": "records"}
left = int(sys.argv[3])

def act(observations):
    global left
    left -= 1
    if left < 0:
        os._exit(9)
    return served(observations)

if not is_scored(ID, **options):
    served = ServedPolicy(sys.argv[1])
    score(ID, act, **options)
    served.close()
"""


KILLS = [[0, 1, 2], [3, 0, 1, 2], [3, 1, 0]]
"""Numbers of requests after which the program is killed, by stage."""


@pytest.mark.slow
def test_a_killed_program_loses_only_the_stage_that_was_running(
    run: Callable[..., Record], tmp_path: Path, empty_caches: Path
) -> None:
    policy_of = write_policy(tmp_path)
    program = KILLED.replace("ID", repr(ID))
    environment = {**os.environ, "CLBENCH_CACHE": str(empty_caches / "cache")}
    for stage in STAGES:
        expected = run(policy_of(stage), stage, records=tmp_path / "here")
        with serving(tmp_path, stage) as (address, _):
            codes = []
            for allowed in [*KILLS[stage], 100, 0]:  # the last one finds nothing to do
                command = [sys.executable, "-c", program, address, str(stage), str(allowed)]
                done = subprocess.run(command, cwd=tmp_path, env=environment, check=False)
                codes.append(done.returncode)
            assert codes == [*[9 for _ in KILLS[stage]], 0, 0]
    found = read_record(tmp_path / "records/Toy-v0/me--elsewhere/seed-0.json")
    assert outcomes(found) == outcomes(expected)
    assert not list((empty_caches / "cache" / "online").iterdir())


def test_chunks_are_executed_to_their_end_or_to_the_number_asked_for(
    run: Callable[..., Record], tmp_path: Path
) -> None:
    agent = evaluate_agent(Knowing(*LEARNED[0]), stage_env(0), method="me/agent", records=tmp_path)
    counts = {}
    for length, executed in ((1, None), (4, None), (4, 1), (5, 3), (50, None)):
        steps: list[int] = []

        def act(observations: dict[str, Any], length: int = length, steps: list[int] = steps) -> Any:
            steps.append(int(observations["step"].max()))
            return knowing(0, length)(observations)

        folder = tmp_path / f"{length}-{executed}"
        record = run(act, 0, executed=executed, records=folder)
        assert outcomes(record) == outcomes(agent)
        assert record.run.settings == ({} if executed is None else {"executed": executed})
        counts[length, executed] = steps
    assert counts[1, None] == counts[4, 1] == list(range(12))
    assert counts[4, None] == [0, 4, 8]
    assert counts[5, 3] == [0, 3, 6, 9]
    assert counts[50, None] == [0]


def test_each_episode_observes_a_seed_of_its_own(run: Callable[..., Record]) -> None:
    seen: list[dict[str, Any]] = []

    def act(observations: dict[str, Any]) -> Any:
        seen.append(observations)
        return np.zeros((40, 12, 2))

    run(act, 0)
    (shown,) = seen
    assert (shown["state"].shape, shown["state"].dtype) == ((40, 4), np.float32)
    assert (shown["seed"].dtype, shown["step"].dtype) == (np.int64, np.int64)
    assert len(set(shown["seed"][:30])) == 30
    assert set(shown["seed"][30:]) == {shown["seed"][0]}
    assert set(shown["instruction"]) == {words for task in TOY.tasks for words in task.instructions}


def test_a_policy_with_a_camera_observes_pictures(run: Callable[..., Record], tmp_path: Path) -> None:
    shapes: set[Any] = set()

    def act(observations: dict[str, Any]) -> Any:
        image = observations["image"]
        shapes.add((image.shape[0], image.shape[3], str(image.dtype)))
        assert image.any()
        return np.zeros((40, 100, 2))

    score("clbench.testing.seen_toy:clbench/SeenToy-v0", act, stage=0, method="me/sees", records=tmp_path)
    assert shapes == {(40, 3, "uint8")}


def test_the_record_keeps_what_its_authors_declare(run: Callable[..., Record], tmp_path: Path) -> None:
    run(knowing(0), 0)
    run(knowing(1), 1, data="100 demonstrations of right, by hand", steps=2_000)
    record = run(knowing(2), 2, steps=500)
    assert record.run.uses == {"external": True}
    assert record.run.trained_elsewhere
    assert record.diagnostics == {
        "0": {},
        "1": {"data": "100 demonstrations of right, by hand", "steps": 2000},
        "2": {"steps": 500},
    }
    assert (record.costs.optimiser_steps, record.timing["seconds"]) == (None, None)
    assert read_record(tmp_path / "records/Toy-v0/me--elsewhere/seed-0.json") == record
    scores = Scores.from_record(record)
    expected = [[name in known for name in scores.layout.tasks] for known in LEARNED]
    assert np.array_equal(scores.success.mean(axis=-1), np.array(expected, float))


def test_stages_come_in_order_and_each_is_scored_once(run: Callable[..., Record], tmp_path: Path) -> None:
    def done(stage: int, **options: Any) -> bool:
        return is_scored(
            ID, stage=stage, **{"method": "me/elsewhere", "records": tmp_path / "records", **options}
        )

    with pytest.raises(
        InputError, match="Stage 0 of me/elsewhere, seed 0, on clbench/Toy-v0 comes next, not 1"
    ):
        done(1)
    with pytest.raises(InputError, match="clbench/Toy-v0 has stages 0 to 2, not 3"):
        done(3)
    assert not done(0)
    run(knowing(0), 0)
    assert (done(0), done(1)) == (True, False)
    assert not done(0, seed=1)
    with pytest.raises(InputError, match=r"settings of .* were"):
        run(knowing(1, 4), 1, executed=2)
    with pytest.raises(InputError, match="begun as another kind of run"):
        evaluate_agent(Knowing(), stage_env(1), method="me/elsewhere", records=tmp_path / "records")
    for stage in (1, 2):
        run(knowing(stage), stage)
    assert all(map(done, STAGES))


@pytest.mark.parametrize(
    ("chunks", "executed", "message"),
    [
        (
            np.zeros((40, 2)),
            None,
            r"shape \(40, 2\), not \(40, H, A\): for each episode any number of actions",
        ),
        (np.zeros((40, 0, 2)), None, r"shape \(40, 0, 2\), not"),
        (
            np.zeros((40, 3, 2)),
            4,
            r"shape \(40, 3, 2\), not \(40, H, A\): for each episode at least 4 actions",
        ),
        (np.zeros((40, 3, 7)), None, r"shape \(40, 3, 7\), not \(40, 3, 2\)"),
        (np.zeros((1, 3, 2)), None, r"shape \(1, 3, 2\), not \(40, 3, 2\)"),
    ],
)
def test_actions_of_another_shape_are_refused(
    chunks: Any, executed: int | None, message: str, run: Callable[..., Record]
) -> None:
    with pytest.raises(InputError, match=message):
        run(lambda _: chunks, 0, executed=executed)


def test_a_policy_of_clbench_has_the_outcomes_that_a_run_gives_it(run: Callable[..., Record]) -> None:
    policy = TransformerPolicy(policy_config(TOY), seed=0).eval()
    config = policy.config

    def act(observations: dict[str, Any]) -> Any:
        words = encode(observations["instruction"], config.text_length)
        noise = []
        for seed, step in zip(observations["seed"], observations["step"], strict=True):
            shape = (-(-12 // config.executed), config.chunk, config.action_size)
            drawn = torch.randn(shape, generator=torch.Generator().manual_seed(int(seed)))
            noise.append(drawn[step // config.executed])
        image = torch.zeros(40, config.image_size, config.image_size, 3, dtype=torch.uint8)
        return policy.act(torch.from_numpy(observations["state"]), words, torch.stack(noise), image)

    rows = run(act, 0, executed=config.executed).episode_rows()
    expected = Evaluator(TOY, 0).evaluate(policy, TOY.tasks, "test")
    found = [row for row in rows if row.split == "test"]
    assert [(row.task, row.episode, row.success, row.length) for row in found] == [
        (one.task, one.number, one.success, one.length) for one in expected
    ]
    assert [row.total_reward for row in found] == [round(one.total_reward, 4) for one in expected]


# ---- the command -------------------------------------------------------------------------------------------


def test_the_command_scores_stage_after_stage_and_skips_what_is_done(
    tmp_path: Path, empty_caches: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_policy(tmp_path)
    command, records = resolve("clbench.cli.runs:score"), tmp_path / "records"
    for stage in STAGES:
        with serving(tmp_path, stage) as (address, _):
            options = {"policy": address, "stage": stage, "method": "me/elsewhere", "records": records}
            command(ID, **options, data="by hand")
    shown = capsys.readouterr().err
    assert "stage 0: left 1.00, up " in shown
    assert "Next: fine-tune on right, serve the policy, and score it with --stage 1." in shown
    assert f"Record: {records / 'Toy-v0/me--elsewhere/seed-0.json'}" in shown
    assert f"Next: clbench leaderboard --records {records}" in shown
    command(ID, **options)  # nobody serves the policy any more
    assert capsys.readouterr().err == "Stage 2 of me/elsewhere, seed 0, is done.\n"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "localhost:8000"}, "error: The address of a policy is ws://host:port, not"),
        ({"stage": 1}, "error: Stage 0 of me/elsewhere, seed 0, on clbench/Toy-v0 comes next, not 1."),
        ({"method": "sft"}, "error: 'sft' is a method of clbench"),
    ],
)
def test_the_command_explains_a_wrong_value_in_one_line(
    options: dict[str, Any],
    message: str,
    tmp_path: Path,
    empty_caches: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = {
        "policy": "ws://localhost:1",
        "stage": 0,
        "method": "me/elsewhere",
        "records": tmp_path,
        **options,
    }
    with pytest.raises(SystemExit, match="2"):
        resolve("clbench.cli.runs:score")(ID, **given)
    assert message in capsys.readouterr().err
