"""The plan of runs: the lengths and paces of their jobs, and what runs share."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from eager import EAGER
from tiny import TINY

from clbench.base.errors import InputError, UnknownNameError
from clbench.exchange.recorded import expert_of
from clbench.jobs.job import Job
from clbench.jobs.plan import Plan
from clbench.learning.method import Method
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.prior import Prior
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.records.reader import read_record
from clbench.records.writer import write_record
from clbench.runs.length import run_length
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.runs.start import evaluate_pretrained
from clbench.spec.registry import load_scenario

TOY = "clbench.testing:clbench/Toy-v0"

WATCHING = """
import clbench
from dataclasses import dataclass

@dataclass
class Watching(clbench.Method):
    uses = clbench.Uses(demonstrations="prepare")

    def watch_pretraining(self, policy, progress):
        pass
"""


def _job(folder: Path, scenario: str, method: str) -> Job:
    return Plan().add_run(RunSpec(scenario, method, 0).resolve(), folder)


def _plan(records: Path, *specs: RunSpec) -> list[Job]:
    plan = Plan()
    for spec in specs:
        plan.add_run(spec.resolve(), records)
    return plan.jobs


def test_a_job_takes_no_function_of_its_command_to_another_machine(tmp_path: Path) -> None:
    plan = Plan()
    plan.add_run(RunSpec(TINY.id, "sft", 0).resolve(), tmp_path)
    for job in plan.jobs:
        bare = job.bare()
        assert (bare.title, bare.function, bare.arguments) == (job.title, job.function, job.arguments)
        assert [name for name, value in vars(bare).items() if callable(value)] == ["function"]
        assert (bare.needs, bare.product) == ((), None)


def test_a_plan_begins_with_the_job_that_all_others_wait_for(tmp_path: Path, empty_caches: Path) -> None:
    check = Job("check", str, {}, 1.0)
    plan = Plan(check)
    plan.add_run(RunSpec(TINY.id, "joint", 0).resolve(), tmp_path)
    first, *others = plan.jobs
    assert first is check
    assert all(job.needs for job in others)  # so that each waits for it, perhaps through others


def test_folders_travel_to_other_processes_as_absolute_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run, plan = RunSpec(TINY.id, "sft", 0).resolve(), Plan()
    job = plan.add_run(run, Path("records"), checkpoints=Path("kept"), tensorboard=Path("logs"))
    stages = plan.add_stages(run, Path("kept"))
    names = {"records": "records", "checkpoints": "kept", "tensorboard": "logs"}
    assert job.arguments == {"spec": run.spec, **{name: tmp_path / place for name, place in names.items()}}
    assert stages.arguments == {"spec": run.spec, "checkpoints": tmp_path / "kept"}
    assert stages.product is not None
    assert stages.product.path.is_relative_to(tmp_path / "kept")


@pytest.mark.parametrize("part", ["world", "expert"])
@pytest.mark.parametrize("group", ["target", "held_out"])
def test_a_missing_entry_point_of_any_task_is_refused_before_the_first_job(
    group: str, part: str, tmp_path: Path
) -> None:
    run = RunSpec(TINY.id, "sft", 0).resolve()
    *first, last = getattr(run.scenario, group)
    changes: dict[str, Any] = {group: (*first, dataclasses.replace(last, **{part: "tiny:Missing"}))}
    scenario = dataclasses.replace(run.scenario, **changes)
    plan = Plan()
    with pytest.raises(
        UnknownNameError, match="No entry point 'tiny:Missing': module 'tiny' has no 'Missing'"
    ):
        plan.add_run(dataclasses.replace(run, scenario=scenario), tmp_path)
    assert plan.jobs == []


def test_a_missing_recording_is_refused_before_the_first_job(tmp_path: Path, empty_caches: Path) -> None:
    run = RunSpec(TINY.id, "sft", 0).resolve()
    recorded = dataclasses.replace(run.scenario.target[-1], expert=expert_of("0123456789abcdef"))
    scenario = dataclasses.replace(run.scenario, target=(*run.scenario.target[:-1], recorded))
    with pytest.raises(
        InputError, match=f"{recorded.name} learns from the recording 0123456789abcdef, and this"
    ):
        Plan().add_run(dataclasses.replace(run, scenario=scenario), tmp_path)


@pytest.mark.parametrize(
    ("scenario", "method", "pace"),
    [
        # 170 s with replay and 232 s without, on equal stages; 29 and 15 ms of 90 ms where stages end early
        (TINY.id, "sft", 1.0),
        (TINY.id, "buffered_replay", 1.0),
        (TINY.id, "experience_replay", 0.75),
        (EAGER.id, "sft", 0.2),
        (EAGER.id, "experience_replay", 0.35),
    ],
)
def test_runs_that_replay_or_end_early_are_expected_to_take_less(
    scenario: str, method: str, pace: float, tmp_path: Path
) -> None:
    assert _job(tmp_path, scenario, method).pace == pace


def test_a_method_that_watches_the_pretraining_takes_as_many_steps_more(
    tmp_path: Path, write_module: Callable[[str, str], None]
) -> None:
    write_module("watching_method", WATCHING)
    run = RunSpec(TINY.id, "sft", 0).resolve()
    length = run_length(run.scenario, run.protocol)
    assert _job(tmp_path, TINY.id, "sft").length == length
    assert _job(tmp_path, TINY.id, "watching_method:Watching").length == length + 10


@pytest.mark.parametrize(("method", "reads"), [("sft", False), ("buffered_replay", True), ("joint", True)])
def test_a_run_waits_for_the_demonstrations_of_skills_if_its_method_reads_them_at_any_time(
    method: str, reads: bool, tmp_path: Path
) -> None:
    titles = {job.title for job in _job(tmp_path, TINY.id, method).needs}
    assert all((f"me--Tiny-v0 demonstrations {task.name}" in titles) == reads for task in TINY.retained)


def test_a_pretraining_is_as_long_as_its_steps(tmp_path: Path, empty_caches: Path) -> None:
    plan = Plan()
    plan.add_run(RunSpec(TINY.id, "sft", 0).resolve(), tmp_path)
    (job,) = (job for job in plan.jobs if "pretraining" in job.title)
    assert job.length == TINY.budget.pretraining_steps == 10


class Downloaded(TransformerPolicy):
    """Has pretrained weights of its own."""

    pretrained = True


@pytest.mark.parametrize("policy", ["flow", f"{__name__}:Downloaded"])
def test_only_a_policy_that_is_pretrained_here_needs_the_demonstrations_of_skills_and_background(
    policy: str,
) -> None:
    toy = load_scenario(TOY).with_policy(policy)
    more = dataclasses.replace(toy.retained[0], name="more")
    scenario = dataclasses.replace(toy, background=(more,))
    titles = [job.title for job in Plan().add_pretraining_data(TOY, scenario)]
    tasks = (*toy.retained, more) if policy == "flow" else ()
    assert titles == ["Toy-v0 questions", *(f"Toy-v0 demonstrations {task.name}" for task in tasks)]


def test_a_method_that_watches_the_pretraining_waits_for_the_background_even_if_the_policy_is_there(
    write_module: Callable[[str, str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_module("watching_the_background", WATCHING)
    monkeypatch.setattr("clbench.jobs.plan.is_pretrained", lambda *_: True)
    for method, waits in (("watching_the_background:Watching", True), ("experience_replay", False)):
        run = RunSpec(TOY, method, 0).resolve()
        more = dataclasses.replace(run.scenario.retained[0], name="more")
        run = dataclasses.replace(run, scenario=dataclasses.replace(run.scenario, background=(more,)))
        titles = [job.title for job in Plan().add_stages(run, None).needs]
        assert ("Toy-v0 demonstrations more" in titles) == waits
        assert len(titles) == len(set(titles))


def test_no_two_jobs_of_a_plan_have_one_title_with_a_policy_of_a_class(
    tmp_path: Path, empty_caches: Path
) -> None:
    plan = Plan()
    for policy in ("flow", "clbench.policy.transformer:TransformerPolicy"):
        for scenario in (TINY.id, EAGER.id):
            plan.add_run(RunSpec(scenario, "sft", 0, policy=policy).resolve(), tmp_path)
    titles = [job.title for job in plan.jobs]
    assert len(titles) == len(set(titles))
    assert "me--Tiny-v0+clbench.policy.transformer.TransformerPolicy pretraining seed 0" in titles


FAILING = """
import clbench
from dataclasses import dataclass

@dataclass
class Failing(clbench.Method):
    def prepare(self, policy, prior):
        raise RuntimeError("no anchor")
"""


def test_a_run_that_failed_counts_as_failed_only_if_another_command_did_it_since(
    tmp_path: Path, write_module: Callable[[str, str], None]
) -> None:
    write_module("failing_method", FAILING)
    spec = RunSpec(TINY.id, "failing_method:Failing", 0)
    assert execute(spec, tmp_path).status == "failed"
    job = Plan().add_run(spec.resolve(), tmp_path)
    assert job.product is not None
    assert not job.product.has_failed()
    record = read_record(spec.path(tmp_path))
    write_record(record, spec.path(tmp_path))
    assert job.product.has_failed()
    write_record(
        dataclasses.replace(record, run=dataclasses.replace(record.run, device="cuda")), spec.path(tmp_path)
    )
    assert not job.product.has_failed()


def test_runs_share_the_evaluation_of_a_start_only_if_it_is_the_same(
    tmp_path: Path, empty_caches: Path
) -> None:
    def starts(*changes: dict[str, Any]) -> int:
        plan = Plan()
        for number, change in enumerate(changes):
            plan.add_run(RunSpec(TINY.id, ("sft", "frozen")[number], 0, **change).resolve(), tmp_path)
        return sum("evaluation" in job.title for job in plan.jobs)

    assert starts({}, {}) == 1
    assert starts({"perturb": True}, {"perturb": True}) == 1
    others = ({"perturb": True}, {"split": "validation"}, {"order": 1}, {"targets": 1}, {"device": "cuda"})
    for other in others:
        assert starts({}, other) == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_run_for_a_gpu_of_a_cluster_is_planned_on_a_machine_without_one(tmp_path: Path) -> None:
    (start, run) = _plan(tmp_path, RunSpec("clbench/Fetch-v1", "sft", 0, device="cuda"))[-2:]
    assert (start.title, start.device) == ("Fetch-v1 evaluation of the pretrained policy seed 0", "cuda")
    assert (run.title, run.device) == ("Fetch-v1 sft seed 0", "cuda")


@dataclasses.dataclass
class Prepared(Method):
    """A method that prepares, perhaps with a hook that no weight shows."""

    def prepare(self, policy: Policy, prior: Prior) -> None:
        pass


def test_a_method_of_a_stranger_that_prepares_waits_for_no_evaluation_that_it_does_not_use(
    tmp_path: Path, empty_caches: Path, stranger: Callable[[type[Method]], str]
) -> None:
    for method, evaluations in (("lora", 1), ("sft", 1), (stranger(Prepared), 0)):
        jobs = _plan(tmp_path, RunSpec(TINY.id, method, 0))
        assert sum("evaluation" in job.title for job in jobs) == evaluations


def test_runs_of_two_scenarios_have_separate_jobs_and_one_pretraining_for_each_seed(
    tmp_path: Path, empty_caches: Path
) -> None:
    scenarios = ("clbench/Fetch-v1", TOY)
    specs = [RunSpec(name, method, 1) for name in scenarios for method in ("sft", "frozen")]
    names = [job.title for job in _plan(tmp_path, *specs)]
    assert len(set(names)) == len(names)
    assert [name for name in names if "pretraining" in name] == [
        "Fetch-v1 pretraining seed 1",
        "Toy-v0 pretraining seed 1",
    ]


@pytest.mark.long
def test_a_run_waits_for_the_data_that_it_needs_and_no_other_data_is_made(
    tmp_path: Path, empty_caches: Path
) -> None:
    def needs(*methods: str) -> dict[str, set[str]]:
        jobs = _plan(tmp_path, *(RunSpec(TINY.id, method, 0) for method in methods))
        return {job.title: {needed.title for needed in job.needs} for job in jobs}

    skills = {f"me--Tiny-v0 demonstrations {task.name}" for task in TINY.retained}
    targets = {f"me--Tiny-v0 demonstrations {task.name}" for task in TINY.target}
    policy, questions, start, sft, joint = (
        f"me--Tiny-v0 {name}"
        for name in (
            "pretraining seed 0",
            "questions",
            "evaluation of the pretrained policy seed 0",
            "sft seed 0",
            "joint seed 0",
        )
    )
    found = needs("sft", "joint")
    assert found[policy] == {questions} | skills
    assert found[start] == {policy, questions}
    assert found[sft] == {policy, questions, start} | targets
    assert found[joint] == {policy, questions, start} | targets | skills
    assert set(found) == {sft, joint} | found[joint]
    pretrained_policy(TINY, 0)
    assert needs("sft")[start] == {questions}
    evaluate_pretrained(RunSpec(TINY.id, "joint", 0).resolve())
    assert needs("sft") == {sft: {questions} | targets, questions: set(), **{name: set() for name in targets}}
    demonstrated = {path.parent.name for path in (empty_caches / "minari").rglob("data")}
    execute(RunSpec(TINY.id, "sft", 0), tmp_path)  # it never reads demonstrations of the skills: makes none
    after = {path.parent.name for path in (empty_caches / "minari").rglob("data")}
    assert after - demonstrated == {f"{task.name}-v0" for task in TINY.target}
