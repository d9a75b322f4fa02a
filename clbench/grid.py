"""The grid: many runs, and what they need, on all cores or on a cluster."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path

from rich.console import Console

from clbench.limits import Limits
from clbench.names import folder_name
from clbench.progress import Bars
from clbench.run import evaluate_pretrained, execute, is_reported
from clbench.run_spec import RunSpec, end_length, run_length
from clbench.task import Task, load_scenario
from clbench.training import MethodError
from clbench.workers import Job, JobError, Workers


def run_jobs(jobs: Sequence[Job], workers: Workers, bars: Bars) -> dict[str, str]:
    """Do all jobs, and return what went wrong, by the name of the job.

    A job that fails, or whose process dies, does not stop the others; what needs it is left out. However this
    function is left, by Ctrl-C too, nothing stays behind.

    Args:
        jobs: In any order: those that the longest work waits for begin first.
        workers: Who does them; closed in the end.
        bars: Where it is shown.
    """
    waiting, started = _by_urgency(jobs), dict[str, float]()
    ended: set[str] = set()
    failed: dict[str, str] = {}
    try:
        while waiting or started:
            waiting = _drop_hopeless(waiting, failed)
            for job in _ready(waiting, ended, workers.free()):
                waiting.remove(job)
                workers.start(job)
                started[job.name] = time.monotonic()
                bars.start(job.name, job.length)
            for job, kind, value in workers.events():
                if kind == "progress":
                    bars.advance(job.name, value)
                    continue
                if kind == "done":
                    ended.add(job.name)
                else:
                    failed[job.name] = value
                bars.finish(job.name, f"{value} ({time.monotonic() - started.pop(job.name):.0f} s)")
    finally:
        workers.close()
    return failed


def run_with_bars(jobs: Sequence[Job], workers: Workers, console: Console | None = None) -> dict[str, str]:
    """Do all jobs as `run_jobs` does, with a bar for each."""
    with Bars(sum(job.length for job in jobs), console) as bars:
        return run_jobs(jobs, workers, bars)


def _by_urgency(jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs by falling time of the work that waits for them, their own included.

    The longest run begins first, so that no worker ends with it alone.
    """

    @cache
    def work(name: str) -> float:
        return max((work(job.name) for job in jobs if name in job.needs), default=0.0) + times[name]

    times = {job.name: job.length * job.pace for job in jobs}
    return sorted(jobs, key=lambda job: -work(job.name))


def _drop_hopeless(waiting: list[Job], failed: dict[str, str]) -> list[Job]:
    """Return the jobs that can still be done; the others fail with what they needed."""
    kept = []
    for job in waiting:
        missing = [name for name in job.needs if name in failed]
        if missing:
            failed[job.name] = f"left out, because {missing[0]} failed"
        else:
            kept.append(job)
    return kept


def _ready(waiting: Sequence[Job], ended: set[str], free: int) -> list[Job]:
    """Return the jobs to start: those whose needs have ended, in their order."""
    return [job for job in waiting if ended.issuperset(job.needs)][:free]


# ---- the jobs of a benchmark -----------------------------------------------------------------------

REPLAY_PACE = 0.75
"""Of runs that replay demonstrations: they keep their skills, and an episode ends with success. On Fetch-v0
one takes 170 s where plain fine-tuning, which forgets, takes 232 s."""


def collect_job(scenario: str, task: str, progress: Callable[[float], None]) -> str:
    """Collect the demonstrations of a task, unless they are in the cache."""
    from clbench.demonstrations import dataset_folder, read_dataset

    loaded = load_scenario(scenario)
    episodes = read_dataset(dataset_folder(loaded.task(task), loaded.budget, progress))
    return f"{len(episodes)} episodes, {sum(len(episode.executed) for episode in episodes)} steps"


def scenes_job(scenario: str, progress: Callable[[float], None]) -> str:
    """Collect the states that questions are asked about, unless they are in the cache."""
    from clbench.questions import load_questions, scenes_folder

    loaded = load_scenario(scenario)
    scenes_folder(loaded, progress)
    train, report = load_questions(loaded)
    return (
        f"{len(train.kinds)} kinds about {len(train.scenes)} states, and {len(report.scenes)} for the report"
    )


def pretrain_job(scenario: str, seed: int, progress: Callable[[float], None]) -> str:
    """Pretrain the policy of a seed, unless it is in the cache."""
    from clbench.pretraining import pretrained_policy

    policy, _ = pretrained_policy(load_scenario(scenario), seed, progress)
    return f"{sum(parameter.numel() for parameter in policy.parameters()):,} parameters"


def report_job(spec: RunSpec, progress: Callable[[float], None]) -> str:
    """Evaluate the pretrained policy that a run begins with, unless that is in the cache."""
    evaluate_pretrained(spec, progress)
    return "what runs of most methods begin with"


def run_job(
    spec: RunSpec,
    records: Path,
    progress: Callable[[float], None],
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> str:
    """Do one run, write its record, and return its main scores."""
    from clbench.metrics import measure
    from clbench.scores import Scores

    record = execute(spec, records, progress, checkpoints=checkpoints, tensorboard=tensorboard)
    if record.error is not None:
        raise JobError(
            f"failed in {record.error['where']}: {record.error['type']}: {record.error['message']}"
        )
    scores = Scores.from_record(record)
    names = ["adaptation", "retention", "question_retention"]
    names[2:2] = ["perturbed_retention"] if spec.perturb else []
    values = {name: measure(name, scores) for name in names}
    return ", ".join(f"{name} {'-' if value is None else f'{value:.2f}'}" for name, value in values.items())


def stages_job(spec: RunSpec, checkpoints: Path | None, progress: Callable[[float], None]) -> str:
    """Make the policies of all stages of a run again, and keep them below `checkpoints`, if any."""
    from clbench.stages import keep_stages, make_stages

    try:
        if checkpoints is None:
            make_stages(spec, progress)
        else:
            keep_stages(spec, checkpoints, progress)
    except MethodError as error:
        raise JobError(str(error)) from error
    return "policies of all stages"


def demonstration_jobs(scenario: str, tasks: Sequence[str]) -> list[Job]:
    """Return the jobs that collect the demonstrations of `tasks`."""
    length = load_scenario(scenario).budget.demonstrations
    return [
        Job(
            _title(scenario, f"demonstrations {task}"),
            "clbench.grid:collect_job",
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
                "clbench.grid:run_job",
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
                "clbench.grid:stages_job",
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
    from clbench.pretraining import is_pretrained, vision_steps

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
            Job(_questions(name), "clbench.grid:scenes_job", arguments, length),
            *demonstration_jobs(name, [task.name for task in scenario.retained]),
        ]
        seen = (_questions(name), *_demonstrations(name, scenario.retained))
        for seed in (seed for owner, seed in missing if owner == name):
            needed.update(seen)
            job = "clbench.grid:pretrain_job"
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
        jobs[name] = Job(name, "clbench.grid:report_job", {"spec": spec}, length, waits, device=spec.device)
    return jobs
