"""Logs for TensorBoard: they show the contents of the record, and change nothing."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.scores import Scores

TOY = "clbench.testing:clbench/Toy-v0"
SPEC = RunSpec(TOY, "aegis", seed=0)

pytest.importorskip("tensorboard", reason="the extra tensorboard is not installed")


def _points(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return step and value of every point in TensorBoard, by tag."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events: Any = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """A logged run: its record, and the folder of its log."""
    folder = tmp_path_factory.mktemp("logged")
    record = execute(SPEC, folder / "records", tensorboard=folder / "logs")
    return record, folder / "logs" / "Toy-v0" / "aegis" / "seed-0"


@pytest.mark.long
def test_a_log_changes_no_bit_of_the_record(logged: tuple[Any, Path], tmp_path: Path) -> None:
    record, _ = logged
    assert record.status == "success"
    plain = execute(SPEC, tmp_path)
    assert dataclasses.replace(plain, timing={}) == dataclasses.replace(record, timing={})


def test_a_log_shows_the_contents_of_the_record(logged: tuple[Any, Path]) -> None:
    record, folder = logged
    points = _points(folder)
    loss, rate = points["training/loss"], points["training/learning_rate"]
    assert [step for step, _ in loss] == [step for step, _ in rate] == list(range(10, 121, 10))
    assert 0 < rate[-1][1] < max(value for _, value in rate) <= 1e-3 * 1.0001
    successes: dict[int, list[int]] = {}
    for stage, step, task, split, success in zip(
        *(record.episodes[name] for name in ("stage", "step", "task", "split", "success")), strict=True
    ):
        if (task, split) == ("right", "test"):
            successes.setdefault(max(0, stage - 1) * 60 + step, []).append(success)
    expected = {step: sum(values) / len(values) for step, values in successes.items()}
    assert dict(points["success_test/right"]) == pytest.approx(expected)
    assert set(expected) == {0, 15, 30, 60, 120}
    correct, asked = (
        sum(
            value
            for value, stage in zip(record.answers[name], record.answers["stage"], strict=True)
            if not stage
        )
        for name in ("correct", "asked")
    )
    assert dict(points["question_accuracy/all"])[0] == pytest.approx(correct / asked)
    assert [value for _, value in points["policy/activation_drift"]] == pytest.approx(
        record.policy["activation_drift"]
    )
    shifts = [value for value in record.policy["shift"] if value is not None]
    assert [value for _, value in points["policy/shift"]] == pytest.approx(shifts)
    assert len(shifts) == 2
    shed = {
        60 * int(stage): found["energy_shed_mean"] for stage, found in record.diagnostics.items() if found
    }
    assert dict(points["diagnostics/energy_shed_mean"]) == pytest.approx(shed)
    assert set(shed) == {60, 120}
    assert "diagnostics/anchor_distance" not in points  # a list, no number


@pytest.mark.long
def test_a_log_shows_the_success_in_perturbed_episodes(tmp_path: Path) -> None:
    spec = dataclasses.replace(SPEC, method="frozen", perturb=True)
    rates = Scores.from_record(execute(spec, tmp_path, tensorboard=tmp_path / "logs")).rates()
    points = _points(tmp_path / "logs" / "Toy-v0" / "frozen" / "seed-0")
    for number, task in enumerate(("left", "up")):
        expected = dict(zip((0, 60, 120), rates.perturbed[:, number], strict=True))
        assert dict(points[f"success_perturbed/{task}"]) == pytest.approx(expected)
    assert [step for step, _ in points["success_perturbed/right"]] == [60]


@pytest.mark.long
def test_a_resumed_run_logs_no_point_twice(
    logged: tuple[Any, Path], tmp_path: Path, execute_and_kill: Callable[..., None]
) -> None:
    execute_and_kill(SPEC, tmp_path, 0.75, tensorboard=tmp_path)
    folder = tmp_path / "Toy-v0" / "aegis" / "seed-0"
    last = _points(folder)["training/loss"][-1][0]
    assert last > 60
    assert execute(SPEC, tmp_path, tensorboard=tmp_path).timing["resumed_after"] == 1
    assert _points(folder) == _points(logged[1])


def test_a_missing_package_is_named_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clbench.cli.runs import run

    monkeypatch.setattr("clbench.base.dependencies.find_spec", lambda name: None)
    monkeypatch.setattr(sys, "path", sys.path.copy())  # the command adds to it
    message = "needs the package tensorboard: pip install 'clbench[tensorboard]'"
    with pytest.raises(LookupError) as raised:
        execute(SPEC, tmp_path, tensorboard=tmp_path)
    assert message in str(raised.value)
    with pytest.raises(SystemExit) as left:
        run(TOY, "sft", records=tmp_path, tensorboard=tmp_path)
    assert left.value.code == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
