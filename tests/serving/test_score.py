"""Scores of policies that were fine-tuned elsewhere: the same as in this process, and nothing is lost."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents import ID, LEARNED, TOY, Knowing, stage_env
from served import serving, write_policy

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


@pytest.mark.long
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


@pytest.mark.long
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
    assert [path.name for path in (tmp_path / "records").rglob("*") if path.is_file()] == ["seed-0.json"]


@pytest.mark.long
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
        assert record.run.settings == {"executed": executed or length}
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

    progress: list[float] = []
    run(act, 0, progress=progress.append)
    assert sum(progress) == pytest.approx(1.0)  # the share of the stage
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
    shares = {"not_finite_actions": 0.0, "clipped_actions": 0.0}
    assert record.diagnostics == {
        "0": shares,
        "1": {"data": "100 demonstrations of right, by hand", "steps": 2000, **shares},
        "2": {"steps": 500, **shares},
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
    wrong: list[Any] = [3, -1, "1", 1.0, True]
    for missing in wrong:
        with pytest.raises(InputError, match=f"clbench/Toy-v0 has stages 0 to 2, not {missing!r}"):
            done(missing)
        with pytest.raises(InputError, match=f"clbench/Toy-v0 has stages 0 to 2, not {missing!r}"):
            run(knowing(0), missing)
    assert not done(0)
    run(knowing(0), 0)
    assert (done(0), done(1)) == (True, False)
    assert not done(0, seed=1)
    with pytest.raises(InputError, match=r"settings of .* were"):
        run(knowing(1, 4), 1, executed=2)
    with pytest.raises(InputError, match="begun as another kind of run"):
        evaluate_agent(Knowing(), stage_env(1), method="me/elsewhere", records=tmp_path / "records")
    with pytest.raises(InputError, match=r"Stage 1 of .* comes next, not 0"):
        run(knowing(0), 0)
    for stage in (1, 2):
        run(knowing(stage), stage)
    assert all(map(done, STAGES))


def test_a_run_of_another_kind_with_the_same_name_does_not_count(
    run: Callable[..., Record], tmp_path: Path
) -> None:
    records = tmp_path / "records"
    for stage in STAGES:
        with pytest.raises(InputError, match="begun as another kind of run") if stage else nullcontext():
            is_scored(ID, stage=0, method="me/agent", records=records)
        evaluate_agent(Knowing(), stage_env(stage), method="me/agent", records=records)
    with pytest.raises(InputError, match="begun as another kind of run"):
        is_scored(ID, stage=2, method="me/agent", records=records)


def test_a_scenario_that_retains_nothing_is_refused_with_the_reason(tmp_path: Path) -> None:
    message = r"clbench/MetaWorldCW-v0 has no retained skills\. .* served policies begins with stage 0"
    with pytest.raises(InputError, match=message):
        is_scored("clbench/MetaWorldCW-v0", stage=0, method="me/elsewhere", records=tmp_path)


@pytest.mark.long
def test_a_stage_that_was_scored_wrongly_is_scored_again(run: Callable[..., Record], tmp_path: Path) -> None:
    expected = [run(knowing(stage), stage, records=tmp_path / "other") for stage in STAGES][-1]
    for stage, policy in ((0, knowing(0)), (1, knowing(0)), (1, knowing(1)), (2, knowing(2))):
        record = run(policy, stage, restart=stage == 1, steps=stage)
    assert outcomes(record) == outcomes(expected)
    assert record.answers == expected.answers
    assert [found["steps"] for found in record.diagnostics.values()] == [0, 1, 2]
    assert len(record.timing["stages"]) == 3
    with pytest.raises(InputError, match=r"already has a record, .*, which is never edited"):
        run(knowing(2), 2, restart=True)


@pytest.mark.long
def test_a_restart_at_stage_0_drops_all_stages(run: Callable[..., Record], tmp_path: Path) -> None:
    for stage in (0, 1):
        run(knowing(stage, 4), stage)
    record = run(knowing(0, 2), 0, restart=True)
    assert set(record.episodes["stage"]) == {0}
    assert record.run.settings == {"executed": 2}
    assert not is_scored(ID, stage=1, method="me/elsewhere", records=tmp_path / "records")


def test_actions_that_are_not_finite_or_out_of_range_are_counted_and_named_once(
    run: Callable[..., Record], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    chunk = np.zeros((40, 12, 2))
    chunk[:, :3, 1] = np.nan
    chunk[:, 3, 0] = np.inf
    chunk[:, 4:9, 0] = 5.0
    record = run(lambda _: chunk, 0)
    lengths = np.array(record.episodes["length"])
    assert len(set(lengths)) > 1  # the rest of a chunk does not count
    bad, steps = np.minimum(lengths, 4).sum(), lengths.sum()
    assert record.diagnostics["0"] == {
        "not_finite_actions": pytest.approx(bad / steps, abs=1e-6),
        "clipped_actions": pytest.approx((np.minimum(lengths, 9).sum() - bad) / steps, abs=1e-6),
    }
    (message,) = (text for text in caplog.messages if "of the steps had an action" in text)
    assert "NaN" in message
    assert "outside of the action space" in message
    caplog.clear()
    replaced = run(lambda _: np.nan_to_num(chunk).clip(-1, 1), 0, records=tmp_path / "replaced")
    assert outcomes(replaced) == outcomes(record)
    assert not caplog.messages


def test_chunks_of_another_length_are_refused_unless_the_number_executed_is_given(
    run: Callable[..., Record], tmp_path: Path
) -> None:
    lengths = iter([4, 6])
    with pytest.raises(
        InputError, match=r"\(40, 6, 2\), not \(40, H, A\): .* 4 actions as before; executed=4 "
    ):
        run(lambda shown: knowing(0, next(lengths))(shown), 0)
    run(knowing(0, 4), 0)
    with pytest.raises(
        InputError, match=r"\(40, 6, 2\), not \(40, H, A\): .* 4 actions as before; executed=4 "
    ):
        run(knowing(1, 6), 1)
    with pytest.raises(InputError, match=r"settings of .* are \{'executed': 6\}, but were \{'executed': 4\}"):
        run(knowing(1, 6), 1, executed=6)
    assert run(knowing(1, 6), 1, executed=4).run.settings == {"executed": 4}


class Describing:
    """A policy with the metadata of a server."""

    def __init__(self, stage: int, metadata: dict[str, Any]) -> None:
        self.act, self.metadata = knowing(stage), metadata

    def __call__(self, observations: dict[str, Any]) -> Any:
        return self.act(observations)


def test_metadata_of_the_server_are_kept_if_they_are_texts_and_numbers(run: Callable[..., Record]) -> None:
    metadata = {
        "checkpoint": "step\x1b[31m 100",
        "steps": np.int64(100),
        "rate": 1e-4,
        "nan": float("nan"),
        "too large": 10**400,
        "a little too large": 2**63,
        "weights": np.zeros(1000),
        "nested": {"a": 1},
        "long": "x" * 1000,
        **{f"more {number}": number for number in range(100)},
    }
    server = run(Describing(0, metadata), 0).diagnostics["0"]["server"]
    assert dict(list(server.items())[:4]) == {
        "checkpoint": "step\\x1b[31m 100",
        "steps": 100,
        "rate": 1e-4,
        "long": "x" * 200,
    }
    assert len(server) == 20


def test_a_server_that_says_the_same_as_in_the_stage_before_is_suspected(
    run: Callable[..., Record], caplog: pytest.LogCaptureFixture
) -> None:
    for stage, checkpoint, again in ((0, "a", False), (1, "b", False), (1, "b", True), (2, "b", False)):
        run(Describing(stage, {"checkpoint": checkpoint}), stage, restart=again)
    dropped, message = caplog.messages
    assert dropped.endswith("its stages 1 to 1 are dropped.")
    assert message == (
        "The server sends the same metadata as in stage 1 (checkpoint b): does it serve the new checkpoint?"
    )


def test_a_policy_that_repeats_all_episodes_of_the_stage_before_is_suspected(
    run: Callable[..., Record], caplog: pytest.LogCaptureFixture
) -> None:
    for stage, policy in ((0, Describing(0, {})), (1, Describing(0, {})), (2, Describing(2, {}))):
        run(policy, stage)
    (message,) = caplog.messages
    assert message.endswith(
        "ended as in stage 0, after as many steps: does the policy have the new checkpoint?"
    )


@pytest.mark.long
def test_a_checkpoint_that_was_scored_with_another_seed_is_no_second_training(
    run: Callable[..., Record], caplog: pytest.LogCaptureFixture
) -> None:
    for seed, checkpoints in ((0, "abc"), (1, "ad"), (2, "adc")):  # all begin with one pretrained policy
        for stage, checkpoint in enumerate(checkpoints):
            run(Describing(stage, {"checkpoint": checkpoint}), stage, seed=seed)
    same = "The server sends the same metadata as with seed"
    assert [message.partition(":")[0] for message in caplog.messages] == [
        f"{same} 1 in this stage (checkpoint d)",  # its last stage is still to be scored
        f"{same} 0 in this stage (checkpoint c)",
    ]


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
        ([[[0.0, 0.0]]] * 39 + [[[0.0]]], None, r"one shape \(40, H, A\), but its lists differ in length"),
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
