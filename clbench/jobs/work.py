"""The work of each kind of job."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from clbench.jobs.job import JobError
from clbench.learning.optimise import MethodError
from clbench.runs.run import evaluate_pretrained, execute
from clbench.runs.spec import RunSpec
from clbench.spec.registry import load_scenario


def collect_job(scenario: str, task: str, progress: Callable[[float], None]) -> str:
    """Collect the demonstrations of a task, unless they are in the cache."""
    from clbench.data.demonstrations import dataset_folder, read_dataset

    loaded = load_scenario(scenario)
    episodes = read_dataset(dataset_folder(loaded.task(task), loaded.budget, progress))
    return f"{len(episodes)} episodes, {sum(len(episode.executed) for episode in episodes)} steps"


def scenes_job(scenario: str, progress: Callable[[float], None]) -> str:
    """Collect the states that questions are asked about, unless they are in the cache."""
    from clbench.data.questions import load_questions, scenes_folder

    loaded = load_scenario(scenario)
    scenes_folder(loaded, progress)
    train, report = load_questions(loaded)
    return (
        f"{len(train.kinds)} kinds about {len(train.scenes)} states, and {len(report.scenes)} for the report"
    )


def pretrain_job(scenario: str, seed: int, progress: Callable[[float], None]) -> str:
    """Pretrain the policy of a seed, unless it is in the cache."""
    from clbench.learning.pretraining import pretrained_policy

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
    from clbench.scoring.metrics import measure
    from clbench.scoring.scores import Scores

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
    from clbench.runs.checkpoints import keep_stages, make_stages

    try:
        if checkpoints is None:
            make_stages(spec, progress)
        else:
            keep_stages(spec, checkpoints, progress)
    except MethodError as error:
        raise JobError(str(error)) from error
    return "policies of all stages"
