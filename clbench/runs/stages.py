"""The policies of all stages of a run: kept by the run, or made again without evaluation.

Stage 0 is the policy that the method's `prepare` left, stage k the policy after target k. A run repeats
itself bit for bit, so policies that are made again equal the original ones.
"""

from __future__ import annotations

import dataclasses
import filecmp
import functools
import logging
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from clbench.base.cache import NO_ROOM, CacheError, cache_folder, cached, hash_of, is_cached, is_the_machines
from clbench.base.errors import ClbenchError
from clbench.base.lease import LeaseLostError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.evaluation.checks import Checker
from clbench.learning.adaptation import Step
from clbench.learning.hooks import comes_from_method, place_of
from clbench.learning.optimise import MethodError, deterministic
from clbench.learning.registry import describe_method
from clbench.learning.trainer import STAGE_FILES, Trainer, load_stage, training_inputs
from clbench.policy.checkpoint import CheckpointError
from clbench.policy.policy import Policy
from clbench.records.paths import stage_folder
from clbench.runs.fingerprint import arithmetic
from clbench.runs.length import watching_length
from clbench.spec.protocol import Point
from clbench.worlds.gl_backend import RenderingError

if TYPE_CHECKING:
    from clbench.runs.spec import ResolvedRun

LOG = logging.getLogger("clbench")


LENGTH = "steps.txt"
"""File of a stage that was made again: the optimiser steps of its training loop."""


class MachineError(ClbenchError, OSError):
    """While a method ran, the machine had no room for a file, or its disk, network or GPU failed."""


NOT_THE_METHOD = (CacheError, CheckpointError, LeaseLostError, MachineError, RenderingError)
"""Failures of the machine: the run can be repeated, and leaves no record that blames its method."""


_ASSERTION = 710
"""CUDA's number for an assertion on the GPU, such as an index out of range: the code that ran is wrong."""


@contextmanager
def machine_needed() -> Iterator[None]:
    """Tell a failure of the machine apart from an error of the method that runs inside.

    Raises:
        MachineError: The machine has no room; its disk, network or GPU fails; or the file system refuses
            an operation of clbench itself, not one of a method.
    """
    try:
        yield
    except ClbenchError:  # it says what is to blame
        raise
    except OSError as error:
        if comes_from_method(error) and not is_the_machines(error):
            raise
        raise _machine_error(error, error.errno in NO_ROOM) from error
    except torch.AcceleratorError as error:
        if getattr(error, "error_code", None) == _ASSERTION:
            raise
        raise _machine_error(error) from error


def _machine_error(error: Exception, is_full: bool = False) -> MachineError:
    fault, mend = ("has no room", "make room") if is_full else ("failed", "fix the problem")
    reason = str(error).partition("\n")[0]
    return MachineError(
        f"The machine {fault}: {reason}. The method is not to blame, and the run leaves no record: "
        f"{mend}, then repeat the command."
    )


@contextmanager
def method_needed(run: ResolvedRun, trainer: Trainer) -> Iterator[None]:
    """Turn any error of the method that runs inside into a `MethodError` that names the place.

    Raises:
        CacheError, CheckpointError, LeaseLostError, MachineError, RenderingError: The machine is to blame.
        MethodError: The method fails.
    """
    try:
        with machine_needed():
            yield
    except NOT_THE_METHOD:
        raise
    except Exception as error:
        place = place_of(error, trainer.where)
        message = f"{run.label} failed in {place}: {type(error).__name__}: {error}"
        raise MethodError(message) from error


def find_stages(run: ResolvedRun, checkpoints: Path | None = None) -> Path | None:
    """Return the folder with the policies of all stages of a run, "stage-0" and so on, or None.

    Args:
        run: The run.
        checkpoints: Folder below which policies were kept. If they are missing there, the log says so, and
            the cache is searched.
    """
    kept = kept_stages(run, checkpoints)
    if kept is not None:
        return kept
    made = _made(run)
    return made if _are_whole(run, made) else None


def kept_stages(run: ResolvedRun, checkpoints: Path | None) -> Path | None:
    """Return the folder below `checkpoints` in which a run kept the policies of all stages, or None.

    If the policies are missing below `checkpoints`, the log says so.
    """
    if checkpoints is None:
        return None
    if has_stages(run, checkpoints):
        return _kept(run, checkpoints)
    missing = "%s does not hold the policies of all stages of %s, seed %d."
    LOG.warning(missing, checkpoints, run.label, run.spec.seed)
    return None


def make_stages(run: ResolvedRun, progress: ProgressCallback = no_progress) -> Path:
    """Make the policies of all stages without evaluation, and return their folder in the cache.

    Args:
        run: The run. Its evaluation episodes make no difference.
        progress: Called with the number of optimiser steps done since its last call; a stage in the cache
            counts in full.

    Raises:
        MethodError: The method fails; the message names the place.
    """
    scenario = run.scenario
    root = _made(run)
    new_trainer = functools.cache(
        lambda: Trainer.open(scenario, run.new_method, run.spec.seed, run.spec.device)
    )

    def make(number: int, folder: Path) -> None:
        trainer = new_trainer()

        def after(step: Step) -> bool:
            progress(min(step.done, 1))
            point, task = Point(number, step.done), scenario.target[number - 1]
            return checker.is_due(point) and checker.is_learned(
                checker.check(trainer.finished(), task, point)
            )

        with method_needed(run, trainer):
            steps = 0
            if number:
                trainer.load(stage_folder(root, number - 1), number - 1)
                steps = trainer.learn(number, after)
                progress(0 if scenario.budget.criterion is None else scenario.budget.adaptation_steps - steps)
            else:
                trainer.prepare(progress)
            trainer.save(folder, trainer.state(number))
            (folder / LENGTH).write_text(f"{steps}\n", encoding="utf-8")

    checker = Checker(scenario, run.protocol, run.spec.seed)
    with closing(checker), deterministic(run.spec.device):
        for number in range(len(scenario.target) + 1):
            folder, identity = stage_folder(root, number), _identity(run, number)
            if is_cached(folder, identity):
                progress(
                    scenario.budget.adaptation_steps if number else watching_length(run.method, scenario)
                )
            else:
                cached(folder, identity, functools.partial(make, number))
    return root


def lengths_of_stages(run: ResolvedRun, made: Path) -> list[int]:
    """Return the steps of the training loop in each stage, from the folder that `make_stages` filled."""
    numbers = range(1, len(run.scenario.target) + 1)
    return [int((stage_folder(made, number) / LENGTH).read_text(encoding="utf-8")) for number in numbers]


def load_stages(run: ResolvedRun, folder: Path) -> list[Policy]:
    """Return the policies of all stages of a run from a folder with "stage-0" and so on."""
    numbers = range(len(run.scenario.target) + 1)
    return [
        load_stage(stage_folder(folder, number), run.new_method(), run.spec.device, run.spec.policy)
        for number in numbers
    ]


def keep_stages(run: ResolvedRun, checkpoints: Path, progress: ProgressCallback = no_progress) -> None:
    """Keep the policies of all stages of a run that has finished without keeping them.

    Args:
        run: The run.
        checkpoints: Folder below which the policies are kept.
        progress: As for `make_stages`.
    """
    folder = make_stages(run, progress)
    drop_stages(run, checkpoints)
    for number in range(len(run.scenario.target) + 1):
        keep_stage(run, checkpoints, number, stage_folder(folder, number))


def has_stages(run: ResolvedRun, checkpoints: Path, last: int | None = None) -> bool:
    """Return whether the policies of this very run, up to stage `last`, are kept and whole; all if None."""
    return _are_whole(run, _kept(run, checkpoints), last)


def keeps_stage(run: ResolvedRun, checkpoints: Path, number: int, source: Path) -> bool:
    """Return whether all policies up to stage `number` are kept, the last one as it is in `source`."""
    name = STAGE_FILES[0]
    kept = stage_folder(_kept(run, checkpoints), number) / name
    return has_stages(run, checkpoints, number) and filecmp.cmp(kept, source / name, shallow=False)


def _are_whole(run: ResolvedRun, folder: Path, last: int | None = None) -> bool:
    last = len(run.scenario.target) if last is None else last
    return all(is_cached(stage_folder(folder, n), _identity(run, n)) for n in range(last + 1))


def _kept(run: ResolvedRun, checkpoints: Path) -> Path:
    """Return the folder in which a run keeps its policies."""
    return run.path(checkpoints).with_suffix("")


def _made(run: ResolvedRun) -> Path:
    """Return the cache folder of policies that this version of the code made again on hardware like this."""
    made_by = {"method": describe_method(run.method), "hardware": arithmetic(run.spec.device)}
    inputs = {**_identity(run, 0), **made_by, "file": LENGTH, **training_inputs(run.scenario, run.spec.seed)}
    return cache_folder() / "stages" / hash_of(inputs)


def keep_stage(run: ResolvedRun, checkpoints: Path, number: int, source: Path) -> None:
    """Keep the files that stage `number` of a run left in the folder `source`."""

    def write(folder: Path) -> None:
        for name in STAGE_FILES:
            shutil.copyfile(source / name, folder / name)

    folder = stage_folder(_kept(run, checkpoints), number)
    shutil.rmtree(folder, ignore_errors=True)  # stages of another version of the code have the same identity
    cached(folder, _identity(run, number), write)


def drop_stages(run: ResolvedRun, checkpoints: Path) -> None:
    """Remove the kept policies of a run, which another version of the code computed."""
    for folder in _kept(run, checkpoints).glob("stage-*"):
        shutil.rmtree(folder)


def _identity(run: ResolvedRun, number: int) -> dict[str, Any]:
    """Return what identifies the policy of a stage among all runs, regardless of the source code."""
    info = dataclasses.asdict(run.info)
    for name in ("split", "perturb"):  # evaluation episodes make no difference
        del info[name]
    return {"run": info, "scenario": dataclasses.asdict(run.scenario_info), "stage": number}
