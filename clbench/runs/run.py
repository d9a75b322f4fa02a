"""One run: scenario x method x seed, from the pretrained policy to a record."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import time
import traceback
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from clbench.base.cache import MANIFEST, cache_folder, cached, hash_of, is_cached
from clbench.base.errors import WrongTypeError
from clbench.base.lease import Lease
from clbench.base.progress import ProgressCallback, announce, no_progress
from clbench.evaluation.checks import Checker
from clbench.evaluation.examiner import Examiner
from clbench.learning.adaptation import Step
from clbench.learning.hooks import place_of
from clbench.learning.method import MethodState
from clbench.learning.optimise import deterministic
from clbench.learning.pretraining import pretrained_folder
from clbench.learning.registry import describe_method
from clbench.learning.trainer import Trainer, training_inputs
from clbench.records.paths import stage_folder
from clbench.records.reader import read_record
from clbench.records.record import Costs, Record
from clbench.records.writer import check_diagnostics, write_record, write_result
from clbench.runs.fingerprint import arithmetic, describe_policy, fingerprint
from clbench.runs.length import relearning_length, relearns, run_length, watching_length
from clbench.runs.relearning import relearn
from clbench.runs.spec import ResolvedRun, RunSpec
from clbench.runs.stages import NOT_THE_METHOD, drop_stages, keep_stage, keeps_stage, machine_needed
from clbench.runs.start import evaluate_start
from clbench.runs.step_time import step_ratio
from clbench.runs.tensorboard import Log, require_tensorboard
from clbench.spec.protocol import Point
from clbench.spec.references import BASELINE


def execute(
    run: RunSpec | ResolvedRun,
    records: Path | str,
    progress: ProgressCallback = no_progress,
    *,
    checkpoints: Path | str | None = None,
    tensorboard: Path | str | None = None,
) -> Record:
    """Do a run, or continue an interrupted one, and write its record.

    A run that fails leaves a record with the status "failed" that names the place of the failure. It does not
    replace the record of a run that succeeded. If another process does the same run with the same folders,
    this one waits for its turn.

    Args:
        run: The run, by name or resolved.
        records: Folder of the records.
        progress: Called with the length of the work done since its last call, in optimiser steps;
            `run_length` and `watching_length` of `clbench.runs.length` add up to the total.
        checkpoints: Folder below which the policies of all stages are kept; None keeps none.
        tensorboard: Folder below which the run is logged for TensorBoard; None logs nothing.

    Raises:
        CacheError: The file system refuses a checkpoint. The method has not failed, and there is no record.
        CheckpointError: A checkpoint of this run cannot be read.
        InputError: PyTorch's default dtype is not float32, or its default device is not the CPU.
        LeaseLostError: Another process took over the run.
        MachineError: The machine has no room for a file of the method, or its disk or network fails.
        MissingPackageError: TensorBoard is not installed.
        RenderingError: No picture can be drawn.
    """
    if tensorboard is not None:
        require_tensorboard()
    resolved = run.resolve() if isinstance(run, RunSpec) else run
    # a method may change the working directory
    path = resolved.path(Path(records).absolute())
    folder = _resume_folder(resolved, Path(records))
    kept, log = (None if one is None else Path(one).absolute() for one in (checkpoints, tensorboard))
    for other in (kept, log):
        if other is not None:
            resolved.path(other)  # refuses a link that leads out of the folder before the run, not at its end
    lease = Lease(folder)
    with lease.held():
        with deterministic(resolved.spec.device):
            under_way = _Run(resolved, folder, lease, progress, kept, log)
            record = under_way.go()
        lease.check()
        with machine_needed():
            write_result(record, path)
        under_way.forget()
    return record


def _resume_folder(run: ResolvedRun, records: Path) -> Path:
    """Return the folder in the cache from which an interrupted run continues."""
    # two commands may do the same run for different folders at once
    return cache_folder() / "runs" / hash_of({**_inputs(run), "records": str(records.resolve())})


def pretrained_hash(folder: Path) -> str:
    """Return the hash of the pretrained policy in `folder`, in the form of a record."""
    manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    return str(manifest["files"]["policy.safetensors"][:16])


def _new_record(run: ResolvedRun, trainer: Trainer) -> Record:
    """Return the record of a run that has not begun."""
    return Record(
        status="success",
        run=run.info,
        scenario=run.scenario_info,
        costs=Costs(optimiser_steps=0, parameters=_parameters(trainer)),
        fingerprint={
            # the first task of each world starts its rollout: the order of the targets must not change it
            **fingerprint(run.published, run.spec.device),
            "method": describe_method(run.method),
            **describe_policy(run.scenario, run.spec.seed),
            "pretrained": pretrained_hash(pretrained_folder(run.scenario, run.spec.seed)),
        },
        timing={"stages": []},
    )


def _parameters(trainer: Trainer) -> int:
    return sum(parameter.numel() for parameter in trainer.policy.parameters())


def _added_buffers(trainer: Trainer) -> list[torch.Tensor]:
    """Return the buffers that the method added to the policy: they keep data as its state does."""
    usual = dict(trainer.pretrained.named_buffers())
    return [value for name, value in trainer.policy.named_buffers() if name not in usual]


def _bytes(value: torch.Tensor | str | float | bool | None) -> int:
    """Return the size of an entry of a method's state; a Boolean or None is a mark, not data."""
    if isinstance(value, torch.Tensor):
        return value.nbytes
    if isinstance(value, str):
        return len(value.encode())
    return 0 if value is None or isinstance(value, bool) else 8


@contextlib.contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the seconds that the block takes to those under a name."""
    begin = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - begin


class _Run:
    """A run in progress: the trainer, the examiner, and the record so far.

    After each stage it writes a checkpoint of the trainer and of the record, and the next stage starts from
    this checkpoint. An interrupted run therefore continues as if nothing had happened.

    Args:
        run: The run. On first use, its policy is pretrained and its data are collected.
        resume_folder: Folder in the cache with the state after each stage, from which an interrupted run
            continues.
        lease: The right to write into this folder.
        progress: Called with the length of the work done since its last call.
        kept: Folder below which the policies of all stages are kept.
        tensorboard: Folder below which the run is logged.
    """

    def __init__(
        self,
        run: ResolvedRun,
        resume_folder: Path,
        lease: Lease,
        progress: ProgressCallback,
        kept: Path | None,
        tensorboard: Path | None,
    ) -> None:
        self.run, self.resume_folder, self.lease = run, resume_folder, lease
        self.progress, self.kept, self.tensorboard = progress, kept, tensorboard
        scenario, protocol, seed = run.scenario, run.protocol, run.spec.seed
        self.trainer = Trainer.open(scenario, run.new_method, seed, run.spec.device)
        self.record = _new_record(run, self.trainer)
        data, pretrained = self.trainer.data, self.trainer.pretrained
        self.examiner = Examiner(scenario, protocol, data, pretrained, seed, progress)
        self.checker = Checker(scenario, protocol, seed)
        self.log = Log()
        self.inputs = _inputs(run)
        """Everything that these states depend on, as of the start: later changes of the code do not count."""
        self.begin = time.perf_counter()
        self.seconds_before = 0.0
        """Seconds that the run took before it was interrupted."""

    def go(self) -> Record:
        """Go through all stages that have no checkpoint yet, and return the record."""
        self.record.timing["started"] = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            with machine_needed():
                self._go_through()
        except NOT_THE_METHOD:
            raise
        except Exception as error:
            self.record.status = "failed"
            self.record.error = {
                "where": place_of(error, self.trainer.where),
                "type": type(error).__name__,
                "message": str(error),
                "traceback": traceback.format_exc(),
            }
        finally:
            self.examiner.close()
            self.checker.close()
            self.log.close()
        self._count_seconds()
        return self.record

    def forget(self) -> None:
        """Remove the checkpoints, which are not needed once the record is written."""
        shutil.rmtree(self.resume_folder, ignore_errors=True)

    def _go_through(self) -> None:
        done = self._resume()
        scenario = self.run.scenario
        if self.tensorboard is not None:
            folder = self.run.path(self.tensorboard).with_suffix("")
            self.log = Log(folder, scenario.budget.adaptation_steps, done)
        if done is None:
            done = 0
            self.lease.check()  # else another process owns what is there
            self.forget()  # a stage found there would not be kept
            if self.kept is not None:
                drop_stages(self.run, self.kept)
            self._prepare()
            self._save(0)
        for number in range(done + 1, len(scenario.target) + 1):
            self._load(number - 1)
            self._stage(number)
            self._save(number)
        self._load(len(scenario.target))
        self.record.costs.parameters_added = _parameters(self.trainer) - (self.record.costs.parameters or 0)
        if relearns(self.run.protocol):
            self._relearn()
        if self.run.protocol.split == "test" and scenario.target and self.run.spec.method != BASELINE:
            folder = self._checkpoint(len(scenario.target))
            self.record.timing["step_ratio"] = step_ratio(self.trainer, folder)

    def _prepare(self) -> None:
        """Let the method prepare, and evaluate the policy before any target."""
        begin = time.perf_counter()
        steps = self.trainer.prepare(self.progress)
        self.record.timing["preparation"] = round(time.perf_counter() - begin, 2)
        self.record.costs.preparation_steps = steps
        self._count_steps(steps)
        evaluate_start(self.run, self.examiner, self.trainer.policy, self.record, self.progress)
        self.log.report(self.record, self.run.protocol.end(0))
        self._diagnose(0)

    def _stage(self, number: int) -> None:
        """Adapt to target `number`, and evaluate the policy at each point of the stage."""
        protocol = self.run.protocol
        *on_the_way, _ = protocol.points(number)
        points = set() if self.trainer.method.whole_stages else set(on_the_way)
        predictions = self.examiner.predictions(self.trainer.policy, number)
        begin, seconds = time.perf_counter(), {"training": 0.0, "checks": 0.0, "evaluation": 0.0}

        def evaluate(point: Point, before: torch.Tensor | None = None) -> None:
            with _timed(seconds, "evaluation"):
                self.examiner.examine(self.trainer.policy, point, self.record, before)
                self.log.report(self.record, point)

        def is_learned(point: Point) -> bool:
            with _timed(seconds, "checks"):
                row = self.checker.check(self.trainer.finished(), self.run.scenario.target[number - 1], point)
                self.record.add_check(row)
                announce(self.trainer.where, f"{row.successes}/{row.episodes} after {point.step} steps")
                return self.checker.is_learned(row)

        def after(step: Step) -> bool:
            point = Point(number, step.done)
            if step.done:
                self.progress(1)
                self.log.step(number, step)
            if point in points:
                evaluate(point)
            return self.checker.is_due(point) and is_learned(point)

        steps = self.trainer.learn(number, after)
        if protocol.criterion is not None:
            self.progress(protocol.steps[-1] - steps)
        evaluate(protocol.end(number) if protocol.criterion is None else Point(number, steps), predictions)
        self._diagnose(number)
        seconds["training"] = time.perf_counter() - begin - sum(seconds.values())
        self._count_steps(steps + self.trainer.extra_steps)
        self.record.timing["stages"].append({name: round(value, 2) for name, value in seconds.items()})

    def _relearn(self) -> None:
        """Relearn the skill that succeeds least; policy, method and costs of the run stay as they are."""
        begin = time.perf_counter()
        self.trainer.where = "relearning"
        self.record.relearning = relearn(self.trainer, self.examiner, self.checker, self.progress)
        self.record.timing["relearning"] = round(time.perf_counter() - begin, 2)

    def _diagnose(self, number: int) -> None:
        """Keep the method's report on stage `number`."""
        found = self.trainer.diagnostics(number)
        if not isinstance(found, dict):
            raise WrongTypeError(f"diagnostics() must return a dictionary, not {type(found).__name__}.")
        if found:
            check_diagnostics({**self.record.diagnostics, str(number): found})
            self.record.diagnostics[str(number)] = found
            self.log.diagnostics(found, number)

    # ---- costs -------------------------------------------------------------------------------------

    def _count_steps(self, steps: int) -> None:
        self.record.costs.optimiser_steps = (self.record.costs.optimiser_steps or 0) + steps

    def _count_seconds(self) -> None:
        seconds = self.seconds_before + time.perf_counter() - self.begin
        self.record.timing["seconds"] = round(seconds, 2)

    def _count_bytes(self, number: int, state: MethodState) -> None:
        """Count the bytes that stage `number` passes on; the record keeps the most of all stages."""
        kept = self.trainer.prior(number, ("throughout",)).bytes + sum(map(_bytes, state.values()))
        kept += sum(buffer.nbytes for buffer in _added_buffers(self.trainer))
        self.record.costs.bytes_kept = max(self.record.costs.bytes_kept or 0, kept)

    # ---- checkpoints -------------------------------------------------------------------------------

    def _save(self, number: int) -> None:
        """Write a checkpoint after stage `number`, keep its policy if asked to, and remove the one before."""
        state = self.trainer.state(number)
        self._count_bytes(number, state)
        self.lease.check()

        def write(folder: Path) -> None:
            self.trainer.save(folder, state)
            self._count_seconds()
            write_record(self.record, folder / "record.json")
            if self.kept is not None:
                keep_stage(self.run, self.kept, number, folder)

        cached(self._checkpoint(number), {**self.inputs, "stage": number}, write)
        shutil.rmtree(self._checkpoint(number - 1), ignore_errors=True)

    def _load(self, number: int) -> None:
        """Load the policy and the method from the checkpoint after stage `number`."""
        self.trainer.load(self._checkpoint(number), number)

    def _checkpoint(self, number: int) -> Path:
        return stage_folder(self.resume_folder, number)

    def _resume(self) -> int | None:
        """Load the record of the latest checkpoint and return its stage, or None if there is no checkpoint.

        If the run keeps policies, a checkpoint without the policies of all stages before it does not count.
        """
        targets = len(self.run.scenario.target)
        for number in range(targets, -1, -1):
            folder = self._checkpoint(number)
            if not is_cached(folder, {**self.inputs, "stage": number}):
                continue
            if self.kept is not None and not keeps_stage(self.run, self.kept, number, folder):
                continue
            self.record = read_record(folder / "record.json")
            self.seconds_before = self.record.timing["seconds"]
            self.record.timing["resumed_after"] = number
            length = run_length(self.run.scenario, self.run.protocol) - relearning_length(self.run.protocol)
            watched = watching_length(self.run.method, self.run.scenario)
            self.progress(watched + number * length / max(targets, 1))
            return number
        return None


def _inputs(run: ResolvedRun) -> dict[str, Any]:
    """Return everything that the state after a stage depends on, besides its number."""
    return {
        "run": dataclasses.asdict(run.info),
        "scenario": dataclasses.asdict(run.scenario_info),
        "method": describe_method(run.method),
        "hardware": arithmetic(run.spec.device),
        **training_inputs(run.scenario, run.spec.seed),
    }
