"""The work of each kind of job: functions that a worker calls in its own process."""

from __future__ import annotations

from pathlib import Path

from clbench.base.progress import ProgressCallback
from clbench.base.text import counted, shortened
from clbench.jobs.job import JobError
from clbench.runs.spec import RunSpec
from clbench.spec.registry import load_scenario

# PyTorch and modules that need it are imported inside: a plan names these functions without waiting for it.


class _Noticed:
    """A callback that passes progress on, and knows whether there was any: cached results make none."""

    def __init__(self, progress: ProgressCallback) -> None:
        self._progress, self._made = progress, False

    def __call__(self, amount: float) -> None:
        self._made = True
        self._progress(amount)

    @property
    def source(self) -> str:
        """The end of a sentence about the result."""
        return "" if self._made else ", from the cache"


def collect_demonstrations(scenario: str, task: str, progress: ProgressCallback) -> str:
    """Collect the demonstrations of a task, unless they are in the cache."""
    from clbench.data.demonstrations import dataset_folder, read_dataset

    loaded = load_scenario(scenario)
    noticed = _Noticed(progress)
    episodes = read_dataset(dataset_folder(loaded.task(task), loaded.budget, noticed))
    steps = sum(len(episode.executed) for episode in episodes)
    return f"{len(episodes)} episodes, {steps} steps{noticed.source}"


def collect_scenes(scenario: str, progress: ProgressCallback) -> str:
    """Collect the states that questions are asked about, unless they are in the cache."""
    from clbench.data.questions import load_questions, scenes_folder

    loaded = load_scenario(scenario)
    noticed = _Noticed(progress)
    scenes_folder(loaded, noticed)
    train, test = load_questions(loaded)
    states = f"{len(train.scenes)} states, and {len(test.scenes)} for the test"
    return f"{counted(len(train.kinds), 'kind')} about {states}{noticed.source}"


def pretrain(scenario: str, policy: str, seed: int, progress: ProgressCallback) -> str:
    """Pretrain the policy of a kind and a seed, unless it is in the cache."""
    from clbench.learning.pretraining import pretrained_policy

    noticed = _Noticed(progress)
    pretrained, _ = pretrained_policy(load_scenario(scenario).with_policy(policy), seed, noticed)
    return f"{sum(parameter.numel() for parameter in pretrained.parameters()):,} parameters{noticed.source}"


def evaluate_policy(spec: RunSpec, progress: ProgressCallback) -> str:
    """Evaluate the pretrained policy that a run starts with, unless the cache has the evaluation."""
    from clbench.runs.start import evaluate_pretrained
    from clbench.scoring.scores import WEAK, WEAK_WARNING

    rate = evaluate_pretrained(spec.resolve(), progress)
    if rate is None:
        return "no skills are retained"
    warning = f". {WEAK_WARNING}" if rate < WEAK else ""
    return f"success {rate:.2f} on the retained skills{warning}"


def do_run(
    spec: RunSpec,
    records: Path,
    progress: ProgressCallback,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> str:
    """Do one run, write its record, and return its main scores.

    Raises:
        JobError: The run failed; its record names the place.
    """
    from clbench.jobs.recorded import has_failed
    from clbench.records.paths import failed_name
    from clbench.runs.run import execute
    from clbench.scoring.metrics import measure
    from clbench.scoring.scores import WEAK, Scores

    run = spec.resolve()
    record = execute(run, records, progress, checkpoints=checkpoints, tensorboard=tensorboard)
    if record.error is not None:
        path = run.path(records)
        if not has_failed(run, records):  # a record that stays is there, see `write_result`
            path = failed_name(path)
        raise JobError(shortened(f"failed in {record.failure}", path.relative_to(records).as_posix()))
    scores = Scores.from_record(record)
    perturbed = ["perturbed_retention"] if spec.perturb else []
    names = ["adaptation", "retention", *perturbed, "question_retention"]
    values = {name: measure(name, scores) for name in names}
    text = ", ".join(f"{name} {'-' if value is None else f'{value:.2f}'}" for name, value in values.items())
    start = record.retained_at_start()
    weak = start is not None and start < WEAK
    return f"{text}. The pretrained policy had a success of only {start:.2f} on the skills" if weak else text


def make_policies(spec: RunSpec, checkpoints: Path | None, progress: ProgressCallback) -> str:
    """Make the policies of all stages of a run again, and keep them below `checkpoints`, if given.

    Raises:
        MethodError: The method fails.
    """
    from clbench.runs.stages import keep_stages, make_stages

    run = spec.resolve()
    if checkpoints is None:
        make_stages(run, progress)
    else:
        keep_stages(run, checkpoints, progress)
    return "policies of all stages"
