"""The evaluation before the first target: done once, and shared by runs."""

import dataclasses
import shutil
import threading
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import TINY
from torch import Tensor

from clbench.base.cache import cache_folder, cached
from clbench.base.errors import InputError
from clbench.base.lease import Lease
from clbench.base.progress import no_progress
from clbench.learning.method import Method
from clbench.learning.pretraining import policy_config
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.transformer import TransformerPolicy
from clbench.records.record import Record
from clbench.runs.length import run_length
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.runs.start import evaluate_start
from clbench.spec.protocol import ScoredSplit


@pytest.fixture
def reports() -> Path:
    """Return the folder for the evaluations of pretrained policies, which does not exist yet."""
    kept = cache_folder() / "reports"
    shutil.rmtree(kept, ignore_errors=True)
    return kept


@pytest.mark.long
@pytest.mark.parametrize("perturb", [False, True])
def test_progress_adds_up_to_the_length_of_the_run(perturb: bool, tmp_path: Path, reports: Path) -> None:
    for _ in range(2):  # the second time the cache has the evaluation of the pretrained policy
        amounts: list[float] = []
        run = RunSpec(TINY.id, "sft", seed=0, perturb=perturb, targets=1).resolve()
        execute(run, tmp_path, amounts.append)
        assert sum(amounts) == pytest.approx(run_length(run.scenario, run.protocol))


@pytest.mark.long
@pytest.mark.parametrize("splits", [("test", "validation"), ("validation", "test")])
def test_a_tuning_run_and_a_test_run_share_no_evaluation(
    splits: tuple[ScoredSplit, ScoredSplit], tmp_path: Path, reports: Path
) -> None:
    for split in splits:
        record = execute(RunSpec(TINY.id, "frozen", seed=0, split=split), tmp_path / split)
        rows = zip(record.episodes["stage"], record.episodes["split"], strict=True)
        assert record.status == "success"
        assert split in {kind for stage, kind in rows if stage == 0}
        assert ("test" in record.episodes["split"]) == (split == "test")
    assert len(list(reports.iterdir())) == 2


@pytest.mark.long
def test_a_processor_that_computes_otherwise_evaluates_for_itself(
    tmp_path: Path, reports: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for instructions in ("AVX2", "AVX512"):
        monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda name=instructions: name)
        execute(RunSpec(TINY.id, "frozen", seed=0), tmp_path / instructions)
    assert len(list(reports.iterdir())) == 2


@pytest.mark.long
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


class Fixed(TransformerPolicy):
    """A policy that brings the same weights for every seed."""

    pretrained = True

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed=0)


@pytest.mark.long
def test_seeds_that_start_from_the_same_weights_play_episodes_of_their_own(
    tmp_path: Path, reports: Path
) -> None:
    for seed in range(2):
        execute(RunSpec(TINY.id, "frozen", seed, policy=f"{__name__}:Fixed"), tmp_path)
    assert len(list(reports.iterdir())) == 2


@dataclasses.dataclass
class Still(Method):
    """A method whose policy does nothing, though its weights are those of the pretrained one."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        def stay(state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
            return torch.zeros_like(noise)

        policy.act = stay  # type: ignore[method-assign]


@pytest.mark.long
def test_a_method_that_changes_how_the_policy_computes_evaluates_for_itself(
    tmp_path: Path, reports: Path, stranger: Callable[[type[Method]], str]
) -> None:
    execute(RunSpec(TINY.id, "sft", seed=0), tmp_path)
    still = execute(RunSpec(TINY.id, stranger(Still), seed=0), tmp_path)
    assert still.retained_at_start() == 0.0
    assert len(list(reports.iterdir())) == 2


def test_every_policy_and_every_setting_of_a_method_that_prepares_is_evaluated_for_itself(
    reports: Path, stranger: Callable[[type[Method]], str]
) -> None:
    examined: list[Policy] = []
    examiner: Any = types.SimpleNamespace(examine=lambda policy, point, record: examined.append(policy))
    plain = RunSpec(TINY.id, "from_scratch", seed=0)
    still = RunSpec(TINY.id, stranger(Still), seed=0)
    config = policy_config(plain.resolve().scenario)
    one, other = (TransformerPolicy(config, seed=seed) for seed in range(2))
    asked = [(plain, one), (plain, one), (plain, other)]
    asked += [(still, one), (dataclasses.replace(still, changes={"step_factor": 0.3}), one), (still, one)]
    for spec, policy in asked:
        run = spec.resolve()
        record = Record("success", run.info, run.scenario_info)
        evaluate_start(run, examiner, policy, record, no_progress)
    assert examined == [one, other, one, one]


@pytest.mark.long
def test_an_evaluation_that_another_run_makes_at_the_same_time_is_used(
    tmp_path: Path, reports: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = execute(RunSpec(TINY.id, "frozen", seed=0), tmp_path)
    (folder,) = reports.iterdir()
    made = folder.rename(tmp_path / "made")
    before = (made / "report.json").stat().st_mtime_ns
    held, asked = threading.Event(), threading.Event()

    def make() -> None:
        """Hold the lease, and finish once this run has found nothing and waits."""
        with Lease(folder).held():
            held.set()
            asked.wait(60)
            time.sleep(0.3)
            made.rename(folder)

    def cached_late(*arguments: Any) -> Path:
        asked.set()
        return cached(*arguments)

    monkeypatch.setattr("clbench.runs.start.cached", cached_late)
    other = threading.Thread(target=make)
    other.start()
    held.wait(60)
    second = execute(RunSpec(TINY.id, "sft", seed=0), tmp_path)
    other.join()
    assert (folder / "report.json").stat().st_mtime_ns == before
    starts = [
        [row for row in zip(*one.episodes.values(), strict=True) if row[0] == 0] for one in (first, second)
    ]
    assert starts[0] == starts[1] != []


def test_no_run_begins_while_another_default_dtype_would_change_what_later_runs_share(tmp_path: Path) -> None:
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(InputError, match=r"torch\.float64.*set_default_dtype\(torch\.float32\)"):
            execute(RunSpec(TINY.id, "sft", seed=0, targets=1), tmp_path)
    finally:
        torch.set_default_dtype(torch.float32)
