"""The evaluation before the first target: done once, and shared by runs."""

import shutil
from pathlib import Path

import pytest
from tiny import TINY

from clbench.base.cache import cache_folder
from clbench.runs.length import run_length
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec


@pytest.fixture
def reports() -> Path:
    """Return the folder for the evaluations of pretrained policies, which does not exist yet."""
    kept = cache_folder() / "reports"
    shutil.rmtree(kept, ignore_errors=True)
    return kept


@pytest.mark.parametrize("perturb", [False, True])
def test_progress_adds_up_to_the_length_of_the_run(perturb: bool, tmp_path: Path, reports: Path) -> None:
    for _ in range(2):  # the second time the cache has the evaluation of the pretrained policy
        amounts: list[float] = []
        run = RunSpec(TINY.id, "sft", seed=0, perturb=perturb, targets=1).resolve()
        execute(run, tmp_path, amounts.append)
        assert sum(amounts) == pytest.approx(run_length(run.scenario, run.protocol))


def test_the_pretrained_policy_is_evaluated_once(tmp_path: Path, reports: Path) -> None:
    first = execute(RunSpec(TINY.id, "sft", seed=0), tmp_path)
    (folder,) = reports.iterdir()
    before = (folder / "report.json").stat().st_mtime_ns
    second = execute(RunSpec(TINY.id, "frozen", seed=0), tmp_path)
    assert [path.name for path in reports.iterdir()] == [folder.name]
    assert (folder / "report.json").stat().st_mtime_ns == before
    starts = [
        [row for row in zip(*one.episodes.values(), strict=True) if row[0] == 0] for one in (first, second)
    ]
    assert starts[0] == starts[1]
    execute(RunSpec(TINY.id, "frozen", seed=0, perturb=True), tmp_path)
    assert len(list(reports.iterdir())) == 2  # a perturbed evaluation has more episodes


def test_an_evaluation_that_another_run_makes_at_the_same_time_is_used(
    tmp_path: Path, reports: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = execute(RunSpec(TINY.id, "frozen", seed=0), tmp_path)
    # it is missing at the first look, but exists when this run would make it
    monkeypatch.setattr("clbench.runs.run.is_cached", lambda *_: False)
    second = execute(RunSpec(TINY.id, "sft", seed=0), tmp_path)
    starts = [[stage for stage in one.episodes["stage"] if stage == 0] for one in (first, second)]
    assert starts[0] == starts[1] != []
