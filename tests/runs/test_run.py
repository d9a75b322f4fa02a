"""Runs of the toy: they repeat themselves, resume, and fail with a record that names the place."""

import dataclasses
import json
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from tiny import TINY
from torch import Tensor

from clbench.base.cache import cache_folder
from clbench.jobs.recorded import has_record
from clbench.learning.method import Method, MethodState, Stage
from clbench.learning.prior import Uses
from clbench.policy.policy import Policy
from clbench.records.reader import read_record
from clbench.records.writer import write_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.scores import Scores
from clbench.spec.registry import load_scenario
from clbench.testing import ToyWorld

pytestmark = pytest.mark.long

TOY = "clbench.testing:clbench/Toy-v0"
STEPS = TINY.budget.adaptation_steps


def _lasting(path: Path) -> dict[str, Any]:
    """Return a record without what may differ between equal runs."""
    record = json.loads(path.read_text())
    del record["timing"], record["content"]
    return dict(record)


@dataclasses.dataclass
class Counting(Method):
    """A method with a state: it counts its steps and keeps the mean of its data."""

    uses = Uses(demonstrations="prepare")

    def prepare(self, policy: Policy, prior: Any) -> None:
        self.anchor = prior.demonstrations.sample(32).state.mean(dim=0)
        self.steps = 0

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        (loss * (1 + self.anchor.abs().sum() + self.steps)).backward()
        self.steps += 1

    def state(self) -> MethodState:
        return {"anchor": self.anchor, "steps": self.steps}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        assert isinstance(state["anchor"], Tensor)
        assert isinstance(state["steps"], int)
        self.anchor, self.steps = state["anchor"], state["steps"]

    def diagnostics(self) -> dict[str, Any]:
        return {"steps": self.steps}


@dataclasses.dataclass
class Adapting(Method):
    """A method that adds a parameter to the policy, freezes another, and draws from the global generators."""

    def prepare(self, policy: Policy, prior: Any) -> None:
        policy.register_parameter("scale", torch.nn.Parameter(torch.rand(3)))

    def load_state(self, policy: Policy, state: MethodState) -> None:
        policy.register_parameter("scale", torch.nn.Parameter(torch.zeros(3)))

    def start_task(self, policy: Policy, stage: Stage) -> Any:
        policy.get_parameter("backbone.words.weight").requires_grad_(False)
        return [parameter for parameter in policy.parameters() if parameter.requires_grad]

    def loss(self, policy: Policy, batch: Any, progress: Any) -> Tensor:
        scale = policy.get_parameter("scale")
        noise = torch.rand(()) + random.random() + float(np.random.rand())  # noqa: NPY002
        return policy.action_loss(batch).mean() * (1 + noise) + (scale * torch.rand(3)).sum()


@pytest.mark.parametrize(
    "method",
    [
        "buffered_replay",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("aegis", "fast_dvla", "lora")),
    ],
)
def test_the_same_run_twice_gives_equal_records(tmp_path: Path, method: str) -> None:
    paths = []
    for name in ("first", "second"):
        spec = RunSpec(TOY, method, seed=0)
        assert execute(spec, tmp_path / name).status == "success"
        paths.append(spec.path(tmp_path / name))
    assert _lasting(paths[0]) == _lasting(paths[1])


def test_a_record_holds_every_episode_and_answer_once(tmp_path: Path) -> None:
    record = execute(RunSpec(TOY, "sft", seed=0), tmp_path)
    budget = record.scenario.budget
    points = budget["evaluation_points"]
    at_the_ends = 3 * 5 * budget["test_episodes"]
    on_the_way = 2 * (points - 1) * 3 * budget["curve_episodes"]  # two skills and the target
    rows = list(zip(*record.episodes.values(), strict=True))
    splits = record.episodes["split"]
    assert len({row[:5] for row in rows}) == len(rows)
    assert splits.count("test") == at_the_ends + on_the_way
    assert splits.count("validation") == 2 * points * budget["validation_episodes"]
    assert sum(record.answers["asked"]) == (1 + 2 * points) * budget["test_questions"]
    assert list(zip(record.policy["stage"], record.policy["step"], strict=True)) == [
        (0, 0),
        *((stage, step) for stage in (1, 2) for step in (15, 30, 60)),
    ]
    assert record.costs.optimiser_steps == 2 * budget["adaptation_steps"]
    assert read_record(tmp_path / "Toy-v0" / "sft" / "seed-0.json") == record


def test_all_methods_have_the_same_initial_states_and_the_same_pretrained_policy(tmp_path: Path) -> None:
    records = [
        execute(RunSpec(TINY.id, method, seed=0, targets=1), tmp_path)
        for method in ("sft", "experience_replay")
    ]
    first, second = (
        [row for row in zip(*record.episodes.values(), strict=True) if row[0] == 0] for record in records
    )
    assert first == second
    ours, theirs = (record.fingerprint.pop("method") for record in records)
    assert (ours["link"], theirs["link"]) == (None, "https://arxiv.org/abs/1811.11682")
    assert records[0].fingerprint == records[1].fingerprint


def test_a_run_in_another_order_begins_with_the_same_policy_states_and_simulator(tmp_path: Path) -> None:
    specs = [RunSpec(TINY.id, "frozen", seed=0, order=order) for order in range(2)]
    published, other = (execute(spec, tmp_path) for spec in specs)
    assert (published.scenario.target, other.scenario.target) == (["right", "down"], ["down", "right"])
    assert (published.run.order, other.run.order) == (0, 1)
    assert specs[1].path(tmp_path) == tmp_path / "me--Tiny-v0" / "frozen" / "seed-0-order-1.json"
    assert all(has_record(spec.resolve(), tmp_path) for spec in specs)
    assert published.fingerprint == other.fingerprint  # the hash of the pretrained policy is in it
    starts, others = (
        {row[2:] for row in zip(*record.episodes.values(), strict=True) if row[0] == 0}
        for record in (published, other)
    )
    assert starts == others


def test_a_run_with_perturbed_episodes_has_everything_that_a_plain_run_has(tmp_path: Path) -> None:
    plain, perturbed = (
        execute(RunSpec(TOY, "sft", 0, perturb=perturb), tmp_path) for perturb in (False, True)
    )
    assert (plain.run.perturb, perturbed.run.perturb) == (False, True)
    rows = list(zip(*perturbed.episodes.values(), strict=True))
    assert [row for row in rows if row[3] != "perturbed"] == list(zip(*plain.episodes.values(), strict=True))
    assert [row[:5] for row in rows if row[3] == "perturbed"] == [
        (stage, 60 * bool(stage), task, "perturbed", number)
        for stage, learned in enumerate(((), ("right",), ("down",)))
        for task in ("left", "up", *learned)
        for number in range(perturbed.scenario.budget["test_episodes"])
    ]
    assert (perturbed.answers, perturbed.policy) == (plain.answers, plain.policy)
    rates = Scores.from_record(perturbed).rates().perturbed
    assert rates[0, :2].mean() > 0.5
    played = np.isfinite(rates)
    assert played.tolist() == [
        [True, True, stage == 1, stage == 2, *[False] * (rates.shape[1] - 4)] for stage in range(3)
    ]


def test_a_record_with_perturbed_episodes_counts_as_a_plain_one_but_not_vice_versa(
    tmp_path: Path,
) -> None:
    plain, perturbed = (RunSpec(TINY.id, "frozen", 0, perturb=perturb) for perturb in (False, True))
    assert plain.path(tmp_path) == perturbed.path(tmp_path)
    execute(plain, tmp_path)
    assert (has_record(plain.resolve(), tmp_path), has_record(perturbed.resolve(), tmp_path)) == (True, False)
    execute(perturbed, tmp_path)
    assert (has_record(plain.resolve(), tmp_path), has_record(perturbed.resolve(), tmp_path)) == (True, True)
    assert not has_record(RunSpec(TINY.id, "frozen", 0, perturb=True, order=1).resolve(), tmp_path)


def test_a_scenario_that_cannot_be_perturbed_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from clbench.cli.runs import run

    monkeypatch.setattr(sys, "path", sys.path.copy())  # the command adds to it
    world, toy = "clbench.testing:Steady", load_scenario(TOY)
    monkeypatch.setattr(
        "clbench.testing.Steady", lambda render_mode=None: ToyWorld(render_mode), raising=False
    )
    steady = dataclasses.replace(toy, retained=(dataclasses.replace(toy.retained[1], world=world),))
    steady_target = dataclasses.replace(toy, target=(dataclasses.replace(toy.target[0], world=world),))
    for scenario, message in (
        (steady, f"The task 'up' cannot be perturbed: {world} does not declare `perturbable = True`."),
        (steady_target, f"The task 'right' cannot be perturbed: {world} does not declare"),
    ):
        monkeypatch.setattr("clbench.testing.TOY", scenario)
        with pytest.raises(SystemExit) as left:
            run(TOY, "sft", perturb=True, records=tmp_path)
        assert left.value.code == 2
        assert message in " ".join(capsys.readouterr().err.split())
        assert list(tmp_path.iterdir()) == []
        assert RunSpec(TOY, "sft", 0).resolve().scenario.retained == scenario.retained


def test_frozen_forgets_nothing_and_costs_nothing(tmp_path: Path) -> None:
    record = execute(RunSpec(TINY.id, "frozen", seed=0), tmp_path)
    rows = list(zip(*record.episodes.values(), strict=True))
    tested = [row for row in rows if row[3] == "test"]
    ends = [{row[2:]: row for row in tested if row[:2] == (stage, STEPS * bool(stage))} for stage in range(3)]
    assert set(record.policy["update_sparsity"]) == {1.0}
    assert set(record.policy["activation_drift"]) == {0.0}
    assert [set(end) for end in ends] == [set(ends[0])] * 3
    assert (record.costs.optimiser_steps, record.costs.bytes_kept) == (0, 0)


@pytest.mark.parametrize(
    ("cls", "perturb", "shares"),
    [
        (Adapting, True, [0.45]),
        pytest.param(Adapting, True, [0.05, 0.95], marks=pytest.mark.slow),
        pytest.param(Counting, False, [0.05, 0.45, 0.95], marks=pytest.mark.slow),
    ],
)
def test_a_run_killed_at_any_point_resumes_to_the_same_record(
    tmp_path: Path,
    stranger: Callable[[type[Method]], str],
    execute_and_kill: Callable[..., None],
    cls: type[Method],
    perturb: bool,
    shares: list[float],
) -> None:
    spec = RunSpec(TOY, stranger(cls), seed=0, perturb=perturb)
    execute(spec, tmp_path / "whole")
    others = _unfinished()
    for share in shares:
        records = tmp_path / str(share)
        execute_and_kill(spec, records, share)
        assert not spec.path(records).exists()
        record = execute(spec, records)
        assert ("resumed_after" in record.timing) == (share > 0.2)
        assert _lasting(spec.path(tmp_path / "whole")) == _lasting(spec.path(records))
        assert _unfinished() == others


def _unfinished() -> set[str]:
    """Return the folders with checkpoints of unfinished runs."""
    folder = cache_folder() / "runs"
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def test_the_state_of_a_method_is_counted_in_bytes(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(TOY, stranger(Counting), seed=0), tmp_path)
    assert record.costs.bytes_kept == 4 * 4 + 8  # the anchor, four float32, and the number of steps
    assert record.diagnostics == {"0": {"steps": 0}, "1": {"steps": 60}, "2": {"steps": 120}}
    replay = execute(RunSpec(TOY, "experience_replay", seed=0, targets=1), tmp_path)
    assert (replay.costs.bytes_kept or 0) > 10_000


@dataclasses.dataclass
class Merging(Method):
    """A method whose policy is ready only at the end of a stage."""

    whole_stages = True

    def prepare(self, policy: Policy, prior: Any) -> int:
        return 7

    def learning_rate(self, scheduled: float, progress: Any) -> float:
        return 0.0


def test_a_method_of_whole_stages_is_evaluated_only_at_their_ends(
    tmp_path: Path, stranger: Callable[[type[Method]], str]
) -> None:
    record = execute(RunSpec(TINY.id, stranger(Merging), seed=0), tmp_path)
    assert set(record.episodes["step"]) == {0, STEPS}
    other = execute(RunSpec(TINY.id, "sft", seed=0), tmp_path)
    assert Scores.from_record(record).layout == Scores.from_record(other).layout
    assert set(record.policy["update_sparsity"]) == {1.0}  # with a learning rate of 0 nothing moves


def test_the_steps_of_the_preparation_count(tmp_path: Path, stranger: Callable[[type[Method]], str]) -> None:
    record = execute(RunSpec(TINY.id, stranger(Merging), seed=0, targets=1), tmp_path)
    assert (record.costs.preparation_steps, record.costs.optimiser_steps) == (7, 7 + STEPS)


def test_a_tuning_run_never_plays_a_test_episode(tmp_path: Path) -> None:
    record = execute(RunSpec(TINY.id, "sft", seed=0, split="validation", targets=1), tmp_path)
    assert set(record.episodes["split"]) == {"validation"}
    assert record.run.split == "validation"
    assert not has_record(RunSpec(TINY.id, "sft", seed=0, targets=1).resolve(), tmp_path)
    tested = execute(RunSpec(TINY.id, "sft", seed=0, targets=1), tmp_path / "test")
    assert record.fingerprint["pretrained"] == tested.fingerprint["pretrained"]
    # the training is the same: both runs end with the same policy
    assert record.policy["update_sparsity"] == tested.policy["update_sparsity"]


def test_a_run_with_changes_records_them_and_has_its_own_file(tmp_path: Path) -> None:
    record = execute(RunSpec(TINY.id, "experience_replay", 0, {"replay": "0.25"}, targets=1), tmp_path)
    assert record.run.changes == {"replay": 0.25}
    assert record.run.settings == {"replay": 0.25, "step_factor": 1.0}
    assert [path.name for path in (tmp_path / "me--Tiny-v0").iterdir()] == ["experience_replay+replay=0.25"]


@dataclasses.dataclass
class _Prepares(Method):
    def prepare(self, policy: Policy, prior: Any) -> None:
        raise ValueError("no anchor")


@dataclasses.dataclass
class _Diverges(Method):
    def loss(self, policy: Policy, batch: Any, progress: Any) -> Tensor:
        loss = policy.action_loss(batch).mean()
        return loss * float("nan") if progress.step == 7 else loss


@dataclasses.dataclass
class _Shapeless(Method):
    def loss(self, policy: Policy, batch: Any, progress: Any) -> Tensor:
        return policy.action_loss(batch)


@dataclasses.dataclass
class _Sneaks(Method):
    def batch(self, target: Any, prior: Any) -> Any:
        return prior.demonstrations.sample(4)


@dataclasses.dataclass
class _Peeks(Method):
    uses = Uses(questions="prepare")

    def batch(self, target: Any, prior: Any) -> Any:
        return prior.questions.sample(4)


@dataclasses.dataclass
class _Hoards(Method):
    kept: ClassVar[list[Any]] = []

    def batch(self, target: Any, prior: Any) -> Any:
        self.kept.append(target)
        return self.kept[0].sample(4)


@dataclasses.dataclass
class _Explodes(Method):
    def gradients(self, policy: Policy, loss: Tensor) -> None:
        loss.backward()  # type: ignore[no-untyped-call]
        for parameter in policy.parameters():
            if parameter.grad is not None:
                parameter.grad.mul_(float("nan"))


@dataclasses.dataclass
class _Poisons(Method):
    def end_task(self, policy: Policy, stage: Stage) -> None:
        policy.state_dict()["head.position"].fill_(float("nan"))


@dataclasses.dataclass
class _Chooses(Method):
    def start_task(self, policy: Policy, stage: Stage) -> Any:
        self.chosen = policy.parameters()  # and nothing is returned


@dataclasses.dataclass
class _Forgetful(Method):
    def end_task(self, policy: Policy, stage: Stage) -> None:
        raise RuntimeError(f"cannot merge {stage.task.name}")


@dataclasses.dataclass
class _Boasts(Method):
    def diagnostics(self) -> dict[str, Any]:
        return {"gain": float("inf")}


@pytest.mark.parametrize(
    ("cls", "where", "message"),
    [
        (_Prepares, "prepare", "no anchor"),
        (_Diverges, "stage 1 (right)", "step 7: loss is nan, not finite."),
        (_Shapeless, "stage 1 (right)", "loss must be a scalar, shape (), not (16,)"),
        (_Sneaks, "batch() of stage 1 (right)", "uses prior demonstrations that it does not declare"),
        (_Peeks, "batch() of stage 1 (right)", "uses prior questions that it does not declare"),
        (_Boasts, "diagnostics() after stage 0", "not JSON compliant"),
        (_Hoards, "batch() of stage 2 (down)", "draws from data after the hooks that received it"),
        (_Explodes, "stage 1 (right)", "step 0: a gradient is not finite: that of "),
        (_Poisons, "stage 1 (right)", "The parameter head.position is not finite after 'right'"),
        (_Forgetful, "end_task() of stage 1 (right)", "cannot merge right"),
        (_Chooses, "stage 1 (right)", "start_task() must return the parameters to train, not None"),
    ],
)
def test_a_method_that_fails_leaves_a_record_that_names_the_place(
    tmp_path: Path, stranger: Callable[[type[Method]], str], cls: type[Method], where: str, message: str
) -> None:
    spec = RunSpec(TINY.id, stranger(cls), seed=0)
    execute(spec, tmp_path)
    record = read_record(spec.path(tmp_path))
    assert record.status == "failed"
    assert record.error is not None
    assert record.error["where"] == where
    assert message in record.error["message"]
    assert "Traceback" in record.error["traceback"]


def test_a_record_of_another_budget_device_or_setting_or_a_failed_or_torn_one_does_not_count(
    tmp_path: Path,
) -> None:
    spec = RunSpec(TINY.id, "experience_replay", 0, targets=1)
    assert not has_record(spec.resolve(), tmp_path)
    record = execute(spec, tmp_path)
    assert has_record(spec.resolve(), tmp_path)
    for part, change in (
        ("scenario", {"budget": {**record.scenario.budget, "learning_rate": 0.5}}),
        ("run", {"device": "cuda"}),
        ("run", {"settings": {"replay": 0.1}}),
    ):
        changed = dataclasses.replace(getattr(record, part), **change)
        other = dataclasses.replace(record, **{part: changed})
        write_record(other, spec.path(tmp_path))
        assert not has_record(spec.resolve(), tmp_path)
    error = dict.fromkeys(("where", "type", "message", "traceback"), "")
    write_record(dataclasses.replace(record, status="failed", error=error), spec.path(tmp_path))
    assert not has_record(spec.resolve(), tmp_path)
    spec.path(tmp_path).write_text("{")
    assert not has_record(spec.resolve(), tmp_path)


def test_a_run_leaves_no_global_state_behind(tmp_path: Path) -> None:
    before = torch.get_rng_state(), torch.get_num_threads(), torch.get_default_dtype()
    with torch.no_grad():  # as a notebook may set it for all of its cells
        assert execute(RunSpec(TINY.id, "sft", seed=0, targets=1), tmp_path).status == "success"
        assert not torch.is_grad_enabled()
    after = torch.get_rng_state(), torch.get_num_threads(), torch.get_default_dtype()
    assert before[0].equal(after[0])
    assert before[1:] == after[1:]
