"""What the jobs of a run say when they are done."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from eager import EAGER
from tiny import TINY

from clbench.cli.status import found_runs
from clbench.jobs.job import JobError
from clbench.jobs.work import (
    collect_demonstrations,
    collect_scenes,
    do_run,
    evaluate_policy,
    pretrain,
)
from clbench.learning.pretraining import is_pretrained
from clbench.records.paths import failed_name
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record, write_result
from clbench.runs.spec import RunSpec
from clbench.runs.stages import has_stages

WORDY = """
from dataclasses import dataclass
import clbench

@dataclass
class Wordy(clbench.Method):
    def start_task(self, policy, stage):
        raise ValueError("x" * 3000)
"""

SPEC = RunSpec("clbench.testing:clbench/Toy-v0", "frozen", 0)


@pytest.mark.long
def test_a_policy_that_can_do_little_is_called_weak_before_and_after_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing: Any = lambda _: None  # noqa: E731
    assert evaluate_policy(SPEC, nothing) == "success 1.00 on the retained skills"
    folders = {"checkpoints": tmp_path / "kept", "tensorboard": tmp_path / "logs"}
    assert "pretrained" not in do_run(SPEC, tmp_path / "strong", nothing, **folders)
    assert has_stages(SPEC.resolve(), folders["checkpoints"])
    assert [*folders["tensorboard"].rglob("events.*")]
    monkeypatch.setattr(Record, "retained_at_start", lambda _: 0.33)
    said = evaluate_policy(SPEC, nothing)
    assert said.startswith("success 0.33 on the retained skills. That is low: ")
    said = do_run(SPEC, tmp_path / "weak", nothing)
    assert said.endswith(". The pretrained policy had a success of only 0.33 on the skills")
    for rate, weak in ((0.79, True), (0.8, False)):
        monkeypatch.setattr(Record, "retained_at_start", lambda _, rate=rate: rate)
        assert ("That is low" in evaluate_policy(SPEC, nothing)) == weak
        assert ("of only" in do_run(SPEC, tmp_path / str(rate), nothing)) == weak


@pytest.mark.long
def test_a_policy_is_evaluated_where_stages_end_when_the_target_is_learned() -> None:
    nothing: Any = lambda _: None  # noqa: E731
    assert evaluate_policy(RunSpec(EAGER.id, "sft", 0), nothing) == "success 1.00 on the retained skills"


def test_what_is_in_the_cache_is_not_said_to_be_made(empty_caches: Path) -> None:
    nothing: Any = lambda _: None  # noqa: E731
    for end in ("steps", "steps, from the cache"):
        assert collect_demonstrations(TINY.id, "left", nothing).endswith(end)
    for end in ("for the test", "for the test, from the cache"):
        assert collect_scenes(TINY.id, nothing).endswith(end)
    for end in ("parameters", "parameters, from the cache"):
        assert pretrain(TINY.id, "discrete_diffusion", 0, nothing).endswith(end)
    assert is_pretrained(TINY.with_policy("discrete_diffusion"), 0)


def test_a_long_message_is_cut_where_it_is_said_and_whole_in_the_record(
    tmp_path: Path, write_module: Callable[[str, str], None]
) -> None:
    write_module("wordy", WORDY)
    spec = RunSpec(SPEC.scenario, "wordy:Wordy", 0)
    with pytest.raises(JobError) as failed:
        do_run(spec, tmp_path, lambda _: None)
    said = str(failed.value)
    assert len(said) < 600
    assert said.endswith("xxx [... Toy-v0/wordy.Wordy/seed-0.json has the rest]")
    error = read_record(spec.path(tmp_path)).error
    assert error is not None
    assert error["message"] == "x" * 3000


def test_a_failure_beside_a_success_is_kept_whole_and_named_and_is_no_run_of_its_own(
    tmp_path: Path, write_module: Callable[[str, str], None], make_record: Callable[..., Record]
) -> None:
    write_module("wordy_too", WORDY)
    spec = RunSpec(SPEC.scenario, "wordy_too:Wordy", 0)
    path = spec.path(tmp_path)
    success = make_record([[1.0, 0.0], [1.0, 1.0]])
    write_record(success, path)
    for _ in range(2):
        with pytest.raises(JobError) as failed:
            do_run(spec, tmp_path, lambda _: None)
        assert str(failed.value).endswith("x [... Toy-v0/wordy_too.Wordy/seed-0.json.failed has the rest]")
    assert read_record(path) == success
    aside = failed_name(path)
    error = read_record(aside).error
    assert error is not None
    assert 'raise ValueError("x" * 3000)' in error["traceback"]
    assert found_runs(tmp_path) == [path]
    assert sorted(path.parent.iterdir()) == [path, aside]
    write_result(success, path)
    assert sorted(path.parent.iterdir()) == [path]
