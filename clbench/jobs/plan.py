"""The jobs that a benchmark needs, in the order in which they depend on each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from clbench.jobs.job import Job
from clbench.runs.run import is_reported
from clbench.runs.spec import RunSpec, end_length, run_length
from clbench.spec.identifiers import folder_name
from clbench.spec.limits import Limits
from clbench.spec.registry import load_scenario
from clbench.spec.task import Task

# ---- the jobs of a benchmark -----------------------------------------------------------------------

REPLAY_PACE = 0.75
"""Of runs that replay demonstrations: they keep their skills, and an episode ends with success. On Fetch-v0
one takes 170 s where plain fine-tuning, which forgets, takes 232 s."""


def demonstration_jobs(scenario: str, tasks: Sequence[str]) -> list[Job]:
    """Return the jobs that collect the demonstrations of `tasks`."""
    length = load_scenario(scenario).budget.demonstrations
    return [
        Job(
            _title(scenario, f"demonstrations {task}"),
            "clbench.jobs.work:collect_job",
            {"scenario": scenario, "task": task},
            length,
        )
        for task in tasks
    ]


def benchmark_jobs(
    specs: Sequence[RunSpec],
    records: Path,
    limits: Limits | None = None,
    *,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> list[Job]:
    """Return all jobs that the runs `specs` need: demonstrations, pretraining, the runs.

    Args:
        specs: What is run.
        records: Folder of the records.
        limits: What the process of a run may take.
        checkpoints: Folder below which the policies of all stages are kept; none is if None.
        tensorboard: Folder below which the runs are logged for TensorBoard; they are not if None.
    """
    folders = {"records": records, "checkpoints": checkpoints, "tensorboard": tensorboard}
    jobs, needs = _preparing_jobs(specs)
    reports = _report_jobs(specs, needs)
    jobs += reports.values()
    for spec, needed in zip(specs, needs, strict=True):
        report = _report(spec)
        jobs.append(
            Job(
                _title(spec.scenario, _label(spec)),
                "clbench.jobs.work:run_job",
                {"spec": spec, **folders},
                run_length(spec.load(), spec.split, spec.perturb),
                (*needed, report) if report in reports else needed,
                limits,
                spec.device,
                REPLAY_PACE if spec.build().uses.demonstrations == "throughout" else 1.0,
            )
        )
    return jobs


def stages_jobs(specs: Sequence[RunSpec], checkpoints: Path | None) -> list[Job]:
    """Return all jobs that make the policies of all stages of runs, without a record.

    Args:
        specs: The runs.
        checkpoints: Folder below which the policies are kept; they stay in the cache alone if None.
    """
    jobs, needs = _preparing_jobs(specs)
    for spec, needed in zip(specs, needs, strict=True):
        scenario = spec.load()
        jobs.append(
            Job(
                _title(spec.scenario, f"stages of {_label(spec)}"),
                "clbench.jobs.work:stages_job",
                {"spec": spec, "checkpoints": checkpoints},
                len(scenario.target) * scenario.budget.adaptation_steps,
                needed,
                device=spec.device,
            )
        )
    return jobs


def _title(scenario: str, work: str) -> str:
    """Return what people see of a job."""
    return f"{folder_name(scenario.rpartition(':')[2])} {work}"


def _label(spec: RunSpec) -> str:
    return f"{spec.label} {_seed(spec)}"


def _seed(spec: RunSpec) -> str:
    return f"seed {spec.seed} order {spec.order}" if spec.order else f"seed {spec.seed}"


def _pretraining(scenario: str, seed: int) -> str:
    """Return the name of the job that makes the policy that the runs of a seed begin with."""
    return _title(scenario, f"pretraining seed {seed}")


def _report(spec: RunSpec) -> str:
    """Return the name of the job that evaluates the policy that a run begins with."""
    return _title(spec.scenario, f"evaluation of the pretrained policy {_seed(spec)}")


def _questions(scenario: str) -> str:
    """Return the name of the job that collects what questions are asked about."""
    return _title(scenario, "questions")


def _demonstrations(scenario: str, tasks: Iterable[Task]) -> tuple[str, ...]:
    """Return the names of the jobs that collect the demonstrations of tasks."""
    return tuple(_title(scenario, f"demonstrations {task.name}") for task in tasks)


def _needs(spec: RunSpec, pretrained: bool) -> tuple[str, ...]:
    """Return the names of the jobs that a run waits for."""
    scenario = spec.load()
    prior = scenario.retained if spec.build().uses.demonstrations != "never" else ()
    data = _demonstrations(spec.scenario, scenario.target + prior)
    policy = () if pretrained else (_pretraining(spec.scenario, spec.seed),)
    return *policy, _questions(spec.scenario), *data


def _preparing_jobs(specs: Sequence[RunSpec]) -> tuple[list[Job], list[tuple[str, ...]]]:
    """Return the jobs that make what runs begin with, and for each run the names of those it waits for.

    A policy that lies in the cache or ships has no job, nor has what it was pretrained on for its sake.
    """
    from clbench.learning.pretraining import is_pretrained, vision_steps

    starts = dict.fromkeys((spec.scenario, spec.seed) for spec in specs)
    missing = [start for start in starts if not is_pretrained(load_scenario(start[0]), start[1])]
    needs = [_needs(spec, (spec.scenario, spec.seed) not in missing) for spec in specs]
    needed = {name for names in needs for name in names}
    jobs: list[Job] = []
    for name in dict.fromkeys(spec.scenario for spec in specs):
        scenario = load_scenario(name)
        arguments = {"scenario": name}
        steps = scenario.budget.pretraining_steps + vision_steps(scenario)
        length = scenario.budget.question_episodes
        # what all runs wait for comes before what some do
        data = [
            *demonstration_jobs(name, [task.name for task in scenario.target]),
            Job(_questions(name), "clbench.jobs.work:scenes_job", arguments, length),
            *demonstration_jobs(name, [task.name for task in scenario.retained]),
        ]
        seen = (_questions(name), *_demonstrations(name, scenario.retained))
        for seed in (seed for owner, seed in missing if owner == name):
            needed.update(seen)
            job = "clbench.jobs.work:pretrain_job"
            data.append(Job(_pretraining(name, seed), job, {**arguments, "seed": seed}, steps, seen))
        jobs += [job for job in data if job.name in needed]
    return jobs, needs


def _report_jobs(specs: Sequence[RunSpec], needs: Sequence[tuple[str, ...]]) -> dict[str, Job]:
    """Return the jobs that evaluate what runs begin with, by name, where that is not in the cache.

    Args:
        specs: The runs.
        needs: Names of the jobs that each of them waits for.
    """
    jobs = {}
    for name, (spec, needed) in {_report(pair[0]): pair for pair in zip(specs, needs, strict=True)}.items():
        pretraining = _pretraining(spec.scenario, spec.seed)
        if pretraining not in needed and is_reported(spec):
            continue
        length = end_length(spec.load(), spec.split, spec.perturb)
        waits = tuple(other for other in needed if other in (pretraining, _questions(spec.scenario)))
        jobs[name] = Job(
            name, "clbench.jobs.work:report_job", {"spec": spec}, length, waits, device=spec.device
        )
    return jobs
