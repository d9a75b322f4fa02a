"""One run: scenario x method x seed, from the pretrained policy to a record."""

from __future__ import annotations

import json
import shutil
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from clbench.base.cache import cache_folder, cached, hash_of, hash_of_tensors, is_cached
from clbench.base.errors import WrongTypeError
from clbench.base.source import package_of
from clbench.base.strict_json import check_json
from clbench.data.questions import scored_questions
from clbench.evaluation.rollouts import Episode, Evaluator, Trial, answer
from clbench.learning.adaptation import Step
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import describe_method
from clbench.learning.trainer import Trainer, repeatable, sources
from clbench.policy.activations import Gaussian
from clbench.policy.policy import Policy
from clbench.records.reader import read_record
from clbench.records.record import Record, append_row
from clbench.records.writer import write_record
from clbench.runs.checkpoints import drop_stages, has_stages, keep_stage
from clbench.runs.fingerprint import fingerprint
from clbench.runs.spec import EPISODE_WEIGHT, RunSpec, describe_scenario, run_length
from clbench.runs.tensorboard import Log, require_tensorboard

SPARSITY_THRESHOLD = 1e-3
"""Relative change below which a weight counts as unchanged: ConSFT (arXiv 2605.08879), Eq. 8."""


def execute(
    spec: RunSpec,
    records: Path,
    progress: Callable[[float], None] = lambda _: None,
    *,
    checkpoints: Path | None = None,
    tensorboard: Path | None = None,
) -> Record:
    """Run `spec`, or go on where an interrupted run of it stopped, and write its record.

    A run that fails leaves a record of status "failed" that says where.

    Args:
        spec: What to run.
        records: Folder of the records.
        progress: Called with the optimiser steps, or what took as long, that were done since its last call;
            `run_length` says how many there are.
        checkpoints: Folder below which the policies of all stages are kept; none is if None.
        tensorboard: Folder below which the run is logged for TensorBoard; it is not if None.
    """
    if tensorboard is not None:
        require_tensorboard()
    with repeatable(spec.device):
        run = _Run(spec, records, progress, checkpoints, tensorboard)
        record = run.go()
    write_record(record, spec.path(records))
    run.forget()
    return record


def evaluate_pretrained(spec: RunSpec, progress: Callable[[float], None] = lambda _: None) -> None:
    """Evaluate the pretrained policy, with which runs like `spec` of most methods begin, for all of them.

    Args:
        spec: One of the runs.
        progress: As `execute` calls it.
    """
    with repeatable(spec.device):
        run = _Run(replace(spec, method="frozen", changes={}), Path(), progress, None, None)
        try:
            run.report_start()
        finally:
            run.evaluator.close()


def is_reported(spec: RunSpec) -> bool:
    """Return whether the evaluation of the policy that `spec` begins with is in the cache; the policy is."""
    policy, _ = pretrained_policy(spec.load(), spec.seed)
    return is_cached(*_kept_report(spec, policy))


def _kept_report(spec: RunSpec, policy: Policy) -> tuple[Path, dict[str, Any]]:
    """Return where the report of what a run begins with lies in the cache, and all that it depends on.

    Args:
        spec: The run.
        policy: With what it begins.
    """
    scenario = spec.load()
    inputs = {
        "policy": hash_of_tensors(policy.state_dict()),
        "scenario": describe_scenario(scenario),
        "spec": [spec.seed, spec.device, spec.split, spec.perturb],
        **sources(scenario, spec.seed),
    }
    return cache_folder() / "reports" / hash_of(inputs), inputs


def pretrained_hash(folder: Path) -> str:
    """Return the hash of the pretrained policy that lies in `folder`, as a record names it."""
    manifest = json.loads((folder / "clbench.json").read_text(encoding="utf-8"))
    return str(manifest["files"]["policy.safetensors"][:16])


def episode_row(number: int, step: int, episode: Episode) -> tuple[Any, ...]:
    """Return a row of `Record.episodes`: the outcome with a policy after `step` steps of stage `number`."""
    total_reward = round(episode.total_reward, 4) if abs(episode.total_reward) < float("inf") else None
    return (
        number,
        step,
        episode.task,
        episode.split,
        episode.number,
        int(episode.success),
        total_reward,
        episode.length,
    )


class _Run:
    """A run on its way: what learns, what evaluates it, and the record so far.

    A checkpoint of the trainer and of the record is written after each stage, and the next stage begins with
    it: an interrupted run goes on as one that was not.
    """

    def __init__(
        self,
        spec: RunSpec,
        records: Path,
        progress: Callable[[float], None],
        kept: Path | None,
        tensorboard: Path | None,
    ) -> None:
        self.spec, self.progress, self.kept = spec, progress, kept
        self.trainer = Trainer(spec.load(), spec.build, spec.seed, spec.device)
        self.scenario = scenario = self.trainer.scenario
        self.evaluator = Evaluator(scenario, spec.seed)
        self.tensorboard = tensorboard
        self.log = Log()
        training, report = self.trainer.questions, self.trainer.report_questions
        scored = report if spec.split == "test" else training
        self.asked = scored_questions(scored, scenario.budget.test_questions)
        self.anchor = self._activations()
        self.begin, self.seconds_before = time.perf_counter(), 0.0
        self.record = self._new_record()
        # two commands may do the same run for different folders at once
        key = {**self._inputs(0), "records": str(records.resolve())}
        self.checkpoints = cache_folder() / "runs" / hash_of(key)

    def go(self) -> Record:
        """Go through all stages that no checkpoint holds, and return the record."""
        self.record.timing["started"] = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            self._go_through()
        except Exception as error:
            self.record.status = "failed"
            self.record.error = {
                "where": self.trainer.where,
                "type": type(error).__name__,
                "message": str(error),
                "traceback": traceback.format_exc(),
            }
        finally:
            self.evaluator.close()
            self.log.close()
        self._count_seconds()
        return self.record

    def forget(self) -> None:
        """Remove the checkpoints, once the record is written."""
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def _go_through(self) -> None:
        done = self._resume()
        if self.tensorboard is not None:
            folder = self.spec.path(self.tensorboard).with_suffix("")
            self.log = Log(folder, self.scenario.budget.adaptation_steps, done)
        if done is None:
            done = 0
            if self.kept is not None:
                drop_stages(self.spec, self.kept)
            self._prepare()
            self._save(0)
        for number in range(done + 1, len(self.scenario.target) + 1):
            self._load(number - 1)
            self._stage(number)
            self._save(number)
        self._load(len(self.scenario.target))
        self._count_costs()

    def _prepare(self) -> None:
        """Let the method prepare, and evaluate what there is before any target."""
        begin = time.perf_counter()
        steps = self.trainer.prepare()
        self.record.timing["preparation"] = round(time.perf_counter() - begin, 2)
        self.record.costs["preparation_steps"] = steps
        self.record.costs["optimiser_steps"] += steps
        self.report_start()
        self._diagnose(0)

    def report_start(self) -> None:
        """Evaluate the policy before any target; the report is kept, as most methods start with the same."""
        tables = ("episodes", "answers", "policy")
        evaluated = False

        def write(folder: Path) -> None:
            nonlocal evaluated
            self._report(0, 0)
            evaluated = True
            values = {name: getattr(self.record, name) for name in tables}
            (folder / "report.json").write_text(json.dumps(values), encoding="utf-8")

        folder, inputs = _kept_report(self.spec, self.trainer.policy)
        cached(folder, inputs, write)
        if evaluated:
            return
        for name, value in json.loads((folder / "report.json").read_text(encoding="utf-8")).items():
            setattr(self.record, name, value)
        self.log.report(self.record, 0, 0)
        self.progress(EPISODE_WEIGHT * len(self.record.episodes["task"]))

    def _stage(self, number: int) -> None:
        """Adapt to target `number`, evaluating on the way and at the end."""
        budget = self.scenario.budget
        points = () if self.trainer.method.whole_stages else budget.evaluation_steps[:-1]
        begin, evaluating = time.perf_counter(), 0.0

        def evaluate(step: int) -> None:
            nonlocal evaluating
            paused = time.perf_counter()
            self._report(number, step)
            evaluating += time.perf_counter() - paused

        def after(step: Step) -> None:
            self.progress(1)
            self.log.step(number, step)
            if step.done in points:
                evaluate(step.done)

        steps = self.trainer.learn(number, after)
        evaluate(budget.adaptation_steps)
        self._diagnose(number)
        training = time.perf_counter() - begin - evaluating
        self.record.costs["optimiser_steps"] += steps
        self.record.timing["stages"].append(
            {"training": round(training, 2), "evaluation": round(evaluating, 2)}
        )

    def _diagnose(self, number: int) -> None:
        """Keep what the method tells about stage `number`."""
        self.trainer.where = f"diagnostics() after stage {number}"
        found = _checked(self.trainer.method.diagnostics())
        if found:
            self.record.diagnostics[str(number)] = found
            self.log.diagnostics(found, number)

    def _report(self, number: int, step: int) -> None:
        """Evaluate the policy after `step` steps of stage `number` into the record.

        At the end of a stage that is everything; on the way only what the stage can show: the skills that it
        may forget and the target that it learns.
        """
        split, budget = self.spec.split, self.scenario.budget
        at_the_end = step in (0, budget.adaptation_steps)
        target = self.scenario.target[number - 1 : number] if number else ()
        tasks = self.scenario.tasks if at_the_end else self.scenario.retained + target
        count = budget.curve_episodes if split == "test" and not at_the_end else budget.episodes(split)
        trials: list[Trial] = [(task, split, episode) for task in tasks for episode in range(count)]
        if split == "test":
            trials += [(task, "validation", n) for task in target for n in range(budget.validation_episodes)]
        if self.spec.perturb and at_the_end:
            numbers = range(budget.episodes("perturbed"))
            trials += [(task, "perturbed", n) for task in self.scenario.retained for n in numbers]
        self._play(number, step, trials)
        kind, questions = self.asked
        for name, asked, correct in answer(
            self.trainer.policy, self.trainer.questions.kinds, kind, questions
        ):
            append_row(self.record.answers, (number, step, name, asked, correct))
        drift = float(self._activations().distance(self.anchor).mean())
        append_row(self.record.policy, (number, step, self._update_sparsity(), drift))
        self.log.report(self.record, number, step)

    def _play(self, number: int, step: int, trials: list[Trial]) -> None:
        self.trainer.policy.eval()
        outcomes = self.evaluator.play(
            self.trainer.policy, trials, lambda count: self.progress(EPISODE_WEIGHT * count)
        )
        self.trainer.policy.train()
        for episode in outcomes:
            append_row(self.record.episodes, episode_row(number, step, episode))

    @torch.no_grad()
    def _activations(self) -> Gaussian:
        """Return where the hidden states of the scored questions lie."""
        questions = self.asked[1].to(self.spec.device)
        hidden = self.trainer.policy.hidden_states(questions.state, questions.words, questions.image)
        return Gaussian.of(hidden, self.trainer.policy.backbone.mask(questions.words))

    @torch.no_grad()
    def _update_sparsity(self) -> float | None:
        """Return the share of the pretrained weights that hardly changed, None if there are others now.

        ConSFT (arXiv 2605.08879), Eq. 8: relative change below 1e-3.
        """
        before = dict(self.trainer.pretrained.named_parameters())
        now = dict(self.trainer.policy.named_parameters())
        if now.keys() != before.keys():
            return None
        unchanged = [
            (now[name] - value).abs() / (value.abs() + 1e-8) < SPARSITY_THRESHOLD
            for name, value in before.items()
        ]
        return sum(int(part.sum()) for part in unchanged) / sum(part.numel() for part in unchanged)

    def _new_record(self) -> Record:
        parameters = sum(parameter.numel() for parameter in self.trainer.policy.parameters())
        run, scenario = self.spec.describe()
        return Record(
            status="success",
            run=run,
            scenario=scenario,
            costs={"optimiser_steps": 0, "parameters": parameters},
            fingerprint={
                # of each world the first task's rollout is taken: it must not depend on the order
                **fingerprint(replace(self.spec, order=0).load()),
                "method": describe_method(type(self.trainer.method)),
                "pretrained": pretrained_hash(self.trainer.pretrained_folder),
            },
            timing={"stages": []},
        )

    def _count_seconds(self) -> None:
        seconds = self.seconds_before + time.perf_counter() - self.begin
        self.record.timing["seconds"] = round(seconds, 2)

    def _count_costs(self) -> None:
        state = self.trainer.method.state()
        tensors = [value for value in state.values() if isinstance(value, torch.Tensor)]
        parameters = sum(parameter.numel() for parameter in self.trainer.policy.parameters())
        self.record.costs["parameters_added"] = parameters - self.record.costs["parameters"]
        kept = self.trainer.prior(len(self.scenario.target), ("throughout",)).bytes
        self.record.costs["bytes_kept"] = kept + sum(tensor.nbytes for tensor in tensors)

    # ---- checkpoints -------------------------------------------------------------------------------

    def _inputs(self, number: int) -> dict[str, Any]:
        """Return all that the state after stage `number` depends on."""
        method = package_of(type(self.trainer.method).__module__)
        return {
            "run": self.record.run,
            "scenario": self.record.scenario,
            "stage": number,
            **sources(self.scenario, self.spec.seed, method),
        }

    def _save(self, number: int) -> None:
        """Write a checkpoint after stage `number`, and keep its policy if that is wished; earlier ones go."""

        def write(folder: Path) -> None:
            self.trainer.save(folder, number)
            self._count_seconds()
            write_record(self.record, folder / "record.json")
            if self.kept is not None:
                keep_stage(self.spec, self.kept, number, folder)

        cached(self._checkpoint(number), self._inputs(number), write)
        shutil.rmtree(self._checkpoint(number - 1), ignore_errors=True)

    def _load(self, number: int) -> None:
        """Take the policy and the method as they were after stage `number`."""
        self.trainer.load(self._checkpoint(number), number)

    def _checkpoint(self, number: int) -> Path:
        return self.checkpoints / f"stage-{number}"

    def _resume(self) -> int | None:
        """Take the record of the latest checkpoint and return its stage, or None if there is none.

        Where policies are to be kept, one without those of all stages before it does not count.
        """
        for number in range(len(self.scenario.target), -1, -1):
            folder = self._checkpoint(number)
            if not is_cached(folder, self._inputs(number)):
                continue
            if self.kept is not None and not has_stages(self.spec, self.kept, number):
                continue
            started = self.record.timing["started"]
            self.record = read_record(folder / "record.json")
            self.seconds_before = self.record.timing["seconds"]
            self.record.timing.update({"started": started, "resumed_after": number})
            length = run_length(self.scenario, self.spec.split, self.spec.perturb)
            self.progress(number * length / len(self.scenario.target))
            return number
        return None


def _checked(diagnostics: Any) -> dict[str, Any]:
    """Return a method's diagnostics, if a record can hold them."""
    if not isinstance(diagnostics, dict):
        raise WrongTypeError(f"diagnostics() must return a dictionary, not {type(diagnostics).__name__}.")
    check_json(json.loads(json.dumps(diagnostics, allow_nan=False)))
    return diagnostics
