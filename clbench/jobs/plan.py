"""The plan of a benchmark: its jobs, and the jobs that each of them needs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.data.demonstrations import has_dataset
from clbench.evaluation.definition import recording_of
from clbench.jobs import work
from clbench.jobs.job import Job, Product
from clbench.jobs.recorded import has_failed, has_record
from clbench.learning.pretraining import is_pretrained
from clbench.learning.watching import watches
from clbench.policy.kinds import policy_class
from clbench.records.paths import table_name
from clbench.runs.length import (
    point_length,
    pretraining_length,
    run_length,
    training_length,
    watching_length,
)
from clbench.runs.spec import ResolvedRun
from clbench.runs.start import is_evaluated, starts_as_pretrained
from clbench.spec.budget import Budget
from clbench.spec.identifiers import folder_name, without_module
from clbench.spec.limits import Limits
from clbench.spec.policies import DEFAULT_POLICY, kind_of
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

REPLAY_PACE = 0.75
"""Pace of runs that replay demonstrations. They keep their skills, and success ends an episode: with fixed
stages such a run takes 170 s, and plain fine-tuning, which forgets, takes 232 s."""

EARLY_PACE, EARLY_REPLAY_PACE = 0.2, 0.35
"""Pace of runs whose stages end when the target is learned: their length counts the steps of whole stages.
The 44 runs of Fetch-v1 took 15 ms per unit of length, and 29 ms with replay; a step of pretraining took
90 ms."""


class Plan:
    """The jobs of a benchmark. Runs share jobs for common needs.

    A pretrained policy or an evaluation in the cache needs no job. Jobs for demonstrations and questions are
    always there, and read the cache.

    Scenarios are named by their ids, which travel to the processes of the jobs: "module:id" imports the
    module there. Folders travel as absolute paths: a method may change the working directory of its process.

    Args:
        first: A job that all others wait for.
    """

    def __init__(self, first: Job | None = None) -> None:
        self._first = () if first is None else (first,)
        self._questions: dict[str, Job] = {}
        self._data: dict[tuple[str, str], Job] = {}
        self._policies: dict[tuple[str, str, int], Job | None] = {}
        self._starts: dict[tuple[object, ...], Job | None] = {}
        self._runs: list[Job] = []

    @property
    def inputs(self) -> list[Job]:
        """The jobs that need no method: data, and pretrained policies."""
        kinds = (self._data, self._questions, self._policies)
        return [job for kind in kinds for job in kind.values() if job is not None]

    @property
    def jobs(self) -> list[Job]:
        """All jobs; those that every run waits for come first."""
        starts = [job for job in self._starts.values() if job is not None]
        return [*self._first, *self.inputs, *starts, *self._runs]

    def add_run(
        self,
        run: ResolvedRun,
        records: Path,
        limits: Limits | None = None,
        *,
        checkpoints: Path | None = None,
        tensorboard: Path | None = None,
    ) -> Job:
        """Add a run with all jobs that it needs, and return its job.

        Args:
            run: The run.
            records: Folder of the records.
            limits: Limits of the process of the run; None sets none.
            checkpoints: Folder below which the policies of all stages are kept; None keeps none.
            tensorboard: Folder below which the run is logged for TensorBoard; None logs nothing.

        Raises:
            UnknownNameError: The world or the expert of a task does not exist.
        """
        _check_entry_points(run.scenario)
        records = records.absolute()
        folders = {
            "records": records,
            "checkpoints": checkpoints and checkpoints.absolute(),
            "tensorboard": tensorboard and tensorboard.absolute(),
        }
        start = self._start(run) if starts_as_pretrained(run) else None
        return self._add(
            run,
            _label(run),
            work.do_run,
            {"spec": run.spec, **folders},
            length=run_length(run.scenario, run.protocol) + watching_length(run.method, run.scenario),
            needs=(*self._needs(run), *((start,) if start else ())),
            limits=limits,
            product=_record_of(run, records),
        )

    def add_stages(self, run: ResolvedRun, checkpoints: Path | None, limits: Limits | None = None) -> Job:
        """Add a job that makes the policies of all stages of a run, without a record, and return it.

        Args:
            run: The run.
            checkpoints: Folder below which the policies are kept; None leaves them only in the cache.
            limits: Limits of the process of the job; None sets none.
        """
        return self._add(
            run,
            f"stages of {_label(run)}",
            work.make_policies,
            {"spec": run.spec, "checkpoints": checkpoints and checkpoints.absolute()},
            length=training_length(run.scenario) + watching_length(run.method, run.scenario),
            needs=self._needs(run),
            limits=limits,
            product=None if checkpoints is None else _policies_of(run, checkpoints.absolute()),
        )

    def add_demonstrations(self, name: str, scenario: Scenario, tasks: Iterable[Task]) -> tuple[Job, ...]:
        """Add jobs that collect the demonstrations of tasks, and return them.

        Args:
            name: Id of the scenario, as the user typed it.
            scenario: The scenario.
            tasks: Tasks of the scenario.
        """
        return tuple(self._demonstrations(name, scenario, task) for task in tasks)

    def add_pretraining_data(self, name: str, scenario: Scenario) -> tuple[Job, ...]:
        """Add jobs that collect everything that a policy is pretrained on, and return them.

        A policy class with weights of its own is not pretrained, so it needs no demonstrations.

        Args:
            name: Id of the scenario, as the user typed it.
            scenario: The scenario, with its policy.
        """
        tasks = () if policy_class(kind_of(scenario.policy)).pretrained else scenario.pretrained
        return self._question_job(name, scenario), *self.add_demonstrations(name, scenario, tasks)

    def add_pretraining(self, name: str, scenario: Scenario, seed: int) -> Job | None:
        """Add the job that pretrains the policy of a seed, with all jobs that it needs, and return it.

        Args:
            name: Id of the scenario, as the user typed it.
            scenario: The scenario, with its policy.
            seed: Seed of the policy.

        Returns:
            The job; None if the policy ships or is in the cache.
        """
        key = name, scenario.policy, seed
        if key not in self._policies:
            self._policies[key] = (
                None if is_pretrained(scenario, seed) else self._pretraining(name, scenario, seed)
            )
        return self._policies[key]

    def _add(
        self,
        run: ResolvedRun,
        title: str,
        function: Callable[..., str],
        arguments: dict[str, Any],
        *,
        length: float,
        needs: tuple[Job, ...],
        limits: Limits | None,
        product: Product | None,
    ) -> Job:
        title = _title(run.spec.scenario, title, run.spec.policy)
        device, pace = run.spec.device, _pace(run)
        job = Job(title, function, arguments, length, needs, limits, device, pace, product)
        self._runs.append(job)
        return job

    # ---- needs of runs -----------------------------------------------------------------------------

    def _needs(self, run: ResolvedRun) -> tuple[Job, ...]:
        """Return the jobs that a run waits for, except the evaluation of its start."""
        name, scenario = run.spec.scenario, run.scenario
        policy = self.add_pretraining(name, scenario, run.spec.seed)
        targets = self.add_demonstrations(name, scenario, scenario.target)
        prior = scenario.retained if run.method.uses.demonstrations != "never" else ()
        retained = self.add_demonstrations(name, scenario, prior)
        # it pretrains once more, even if the policy is there
        watched = self.add_pretraining_data(name, scenario) if watches(run.method) else ()
        data = (self._question_job(name, scenario), *targets, *retained, *watched)
        return (*((policy,) if policy else ()), *dict.fromkeys(data))

    def _pretraining(self, name: str, scenario: Scenario, seed: int) -> Job:
        needs = self.add_pretraining_data(name, scenario)
        title = _title(name, f"pretraining seed {seed}", scenario.policy)
        arguments = {"scenario": name, "policy": scenario.policy, "seed": seed}
        return Job(title, work.pretrain, arguments, pretraining_length(scenario), needs)

    def _start(self, run: ResolvedRun) -> Job | None:
        """Return the job that evaluates the start of a run, None if the cache has the evaluation."""
        spec = run.spec
        key = (
            spec.scenario,
            spec.policy,
            spec.seed,
            spec.order,
            spec.targets,
            spec.split,
            spec.perturb,
            spec.device,
        )
        if key not in self._starts:
            policy = self.add_pretraining(spec.scenario, run.scenario, spec.seed)
            if policy is None and is_evaluated(run):
                self._starts[key] = None
            else:
                needs = (*((policy,) if policy else ()), self._question_job(spec.scenario, run.scenario))
                text = f"evaluation of the pretrained policy {_seed(run)}"
                title = _title(spec.scenario, text, spec.policy)
                length = point_length(run.protocol, run.protocol.end(0))
                self._starts[key] = Job(
                    title, work.evaluate_policy, {"spec": spec}, length, needs, device=spec.device
                )
        return self._starts[key]

    def _question_job(self, name: str, scenario: Scenario) -> Job:
        """Return the job that collects the scenes of the questions."""
        if name not in self._questions:
            title, length = _title(name, "questions"), scenario.budget.question_episodes
            self._questions[name] = Job(title, work.collect_scenes, {"scenario": name}, length, self._first)
        return self._questions[name]

    def _demonstrations(self, name: str, scenario: Scenario, task: Task) -> Job:
        """Return the job that collects the demonstrations of a task."""
        key = name, task.name
        if key not in self._data:
            _check_recording(task, scenario.budget)
            title = _title(name, f"demonstrations {task.name}")
            arguments = {"scenario": name, "task": task.name}
            length = scenario.budget.demonstrations
            self._data[key] = Job(title, work.collect_demonstrations, arguments, length, self._first)
        return self._data[key]


def _check_entry_points(scenario: Scenario) -> None:
    """Import the worlds and experts of all tasks, so that a wrong name ends the command before the first job.

    Raises:
        UnknownNameError: One of them does not exist.
    """
    for task in scenario.tasks + scenario.background + scenario.scenes:
        resolve(task.world)
        resolve(task.expert)


def _check_recording(task: Task, budget: Budget) -> None:
    """Refuse a task whose recorded demonstrations are not on this machine, before a policy is pretrained.

    Raises:
        InputError: They are missing, and only their file can provide them.
    """
    recording = recording_of(task)
    if recording is None or has_dataset(task, budget):
        return
    raise InputError(
        f"The task {task.name} learns from the recording {recording}, and this machine has no such dataset "
        "of this version of the task and of clbench: import it with `clbench demonstrations import`."
    )


def _record_of(run: ResolvedRun, records: Path) -> Product:
    """Return the record that a run makes."""
    path = run.path(records)
    before = _version(path)
    return Product(
        path,
        exists=lambda: has_record(run, records),
        has_failed=lambda: _version(path) != before and has_failed(run, records),
    )


def _policies_of(run: ResolvedRun, checkpoints: Path) -> Product:
    """Return the folder with the policies of all stages of a run."""
    from clbench.runs.stages import has_stages  # imports PyTorch

    return Product(run.path(checkpoints).with_suffix(""), exists=lambda: has_stages(run, checkpoints))


def _version(path: Path) -> tuple[int, int] | None:
    """Return what changes when a file is written again, None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def _pace(run: ResolvedRun) -> float:
    """Return the expected time of a unit of length of a run."""
    replays = run.method.uses.demonstrations == "throughout"
    if run.scenario.budget.criterion is not None:
        return EARLY_REPLAY_PACE if replays else EARLY_PACE
    return REPLAY_PACE if replays else 1.0


def _title(scenario: str, text: str, policy: str = DEFAULT_POLICY) -> str:
    """Return the title of a job for a scenario and a policy, which is unique within a plan."""
    return f"{folder_name(table_name(without_module(scenario), policy))} {text}"


def _label(run: ResolvedRun) -> str:
    return f"{run.label} {_seed(run)}"


def _seed(run: ResolvedRun) -> str:
    spec = run.spec
    return f"seed {spec.seed} order {spec.order}" if spec.order else f"seed {spec.seed}"
