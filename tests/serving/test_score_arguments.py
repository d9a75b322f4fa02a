"""`score` in Python: what it refuses before an episode is played, and what a policy may rely on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents import ID

from clbench.serving.score import score


def _still(observations: dict[str, Any]) -> Any:
    return np.zeros((40, 2, 2))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"executed": 0}, ValueError, "executed must be a whole number from 1, not 0"),
        ({"executed": -1}, ValueError, "executed must be a whole number from 1, not -1"),
        ({"steps": -5.5}, ValueError, "steps must be a whole number from 0, not -5.5"),
        ({"steps": True}, ValueError, "steps must be a whole number from 0, not True"),
        ({"data": ["a", 1]}, TypeError, r"data must be a string, not \['a', 1\]"),
    ],
)
def test_what_a_record_cannot_mean_is_refused(
    options: dict[str, Any], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        score(ID, _still, stage=0, method="me/still", records=tmp_path, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 2**64}, "steps: a whole number of 65 bits"),
        ({"data": "x" * 100_001}, "data: a string of 100,001 characters"),
    ],
    ids=["steps", "data"],
)
def test_what_a_record_cannot_hold_is_refused_before_an_episode_is_played(
    options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    asked: list[Any] = []
    with pytest.raises(ValueError, match=message):
        score(ID, asked.append, stage=0, method="me/still", records=tmp_path, **options)
    assert not asked


@pytest.mark.parametrize(
    ("chunks", "message"),
    [
        (np.zeros((40, 2, 3)), r"policy's action has the shape \(40, 2, 3\), not \(40, 2, 2\)"),
        (np.full((40, 2, 2), "0"), r"policy's action must be 2 numbers, not a ndarray \(of type <U1\)"),
    ],
)
def test_a_fault_of_the_actions_is_the_policys(chunks: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        score(ID, lambda _: chunks, stage=0, method="me/still", records=tmp_path)


@pytest.mark.parametrize(("seed", "split"), [(99, "test"), (100, "validation")])
def test_settings_are_chosen_on_validation_episodes_with_a_tuning_seed(
    seed: int, split: str, tmp_path: Path
) -> None:
    record = score(ID, _still, stage=0, method="me/still", seed=seed, records=tmp_path)
    assert record.run.split == split
    assert set(record.episodes["split"]) == {split}
    assert record.matrix().notna().all(axis=None)


def test_a_policy_with_a_memory_sees_every_step_of_an_episode_under_its_seed(tmp_path: Path) -> None:
    seen: dict[int, list[int]] = {}

    def act(observations: dict[str, Any]) -> Any:
        for seed, step in {*zip(observations["seed"].tolist(), observations["step"].tolist(), strict=True)}:
            seen.setdefault(seed, []).append(step)
        return np.zeros((40, 1, 2))

    record = score(ID, act, stage=0, method="me/still", records=tmp_path)
    assert sorted(map(len, seen.values())) == sorted(record.episodes["length"])
    assert all(steps == list(range(len(steps))) for steps in seen.values())


def test_what_a_policy_draws_at_random_repeats_itself_and_is_new_in_each_stage(tmp_path: Path) -> None:
    drawn: list[float] = []

    def act(observations: dict[str, Any]) -> Any:
        drawn.append(float(torch.rand(1)))
        return np.zeros((40, 12, 2))  # a whole episode

    for method in ("me/still", "me/again"):
        for stage in (0, 1):
            score(ID, act, stage=stage, method=method, records=tmp_path)
    first, second, *again = drawn
    assert again == [first, second]
    assert first != second


def test_numbers_of_numpy_are_recorded_as_numbers(tmp_path: Path) -> None:
    numbers: Any = {"stage": np.int64(0), "executed": np.int64(2), "steps": np.int64(5)}
    record = score(ID, _still, method="me/still", records=tmp_path, **numbers)
    assert (record.run.settings, record.diagnostics["0"]["steps"]) == ({"executed": 2}, 5)
