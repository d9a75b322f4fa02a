"""The policies of all stages of a run: kept by the run, or made again without evaluation.

Stage 0 is the policy as the method's `prepare` left it, stage k the policy after target k. As a run repeats
itself bit for bit, policies that are made again are those that it had.
"""

from __future__ import annotations

import functools
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clbench.base.cache import cache_folder, cached, hash_of, is_cached
from clbench.base.source import package_of
from clbench.learning.optimise import MethodError
from clbench.learning.trainer import STAGE_FILES, Trainer, load_stage, repeatable, sources
from clbench.policy.policy import Policy

if TYPE_CHECKING:
    from clbench.runs.spec import RunSpec

LOG = logging.getLogger("clbench")


def stage_policies(
    spec: RunSpec, checkpoints: Path | None = None, progress: Callable[[float], None] = lambda _: None
) -> list[Policy]:
    """Return the policy after every stage of a run, from stage 0.

    Where the run kept them, these are read; else they are made again, and stay in the cache.

    Args:
        spec: The run. On which episodes it is evaluated makes no difference.
        checkpoints: Folder below which policies were kept, as for `execute`.
        progress: Called with the number of optimiser steps done since its last call; a stage that need not
            be made counts in full.

    Raises:
        MethodError: The method fails; the message says where.
    """
    folder = find_stages(spec, checkpoints)
    if folder is None:
        return load_stages(spec, make_stages(spec, progress))
    scenario = spec.load()
    progress(len(scenario.target) * scenario.budget.adaptation_steps)
    return load_stages(spec, folder)


def find_stages(spec: RunSpec, checkpoints: Path | None = None) -> Path | None:
    """Return the folder that holds the policies of all stages of a run, "stage-0" and so on, or None.

    Args:
        spec: The run.
        checkpoints: Folder below which policies were kept. If these are not there, which is said in the log,
            those in the cache are looked for.
    """
    kept = kept_stages(spec, checkpoints)
    if kept is not None:
        return kept
    made = _made(spec)
    return made if _are_whole(spec, made) else None


def kept_stages(spec: RunSpec, checkpoints: Path | None) -> Path | None:
    """Return the folder below `checkpoints` in which a run kept the policies of all stages, or None.

    Where there are checkpoints without them, the log says so.
    """
    if checkpoints is None:
        return None
    if has_stages(spec, checkpoints):
        return _kept(spec, checkpoints)
    missing = "%s does not hold the policies of all stages of %s, seed %d."
    LOG.warning(missing, checkpoints, spec.label, spec.seed)
    return None


def make_stages(spec: RunSpec, progress: Callable[[float], None] = lambda _: None) -> Path:
    """Make the policies of all stages by adapting alone, and return the folder of the cache that holds them.

    Args:
        spec: The run.
        progress: As for `stage_policies`.

    Raises:
        MethodError: The method fails; the message says where.
    """
    scenario = spec.load()
    root = _made(spec)
    new_trainer = functools.cache(lambda: Trainer(scenario, spec.build, spec.seed, spec.device))

    def make(number: int, folder: Path) -> None:
        trainer = new_trainer()
        try:
            if number:
                trainer.load(root / f"stage-{number - 1}", number - 1)
                trainer.learn(number, lambda _: progress(1))
            else:
                trainer.prepare()
            trainer.save(folder, number)
        except Exception as error:
            message = f"{spec.label} failed in {trainer.where}: {type(error).__name__}: {error}"
            raise MethodError(message) from error

    with repeatable(spec.device):
        for number in range(len(scenario.target) + 1):
            folder, identity = root / f"stage-{number}", _identity(spec, number)
            if is_cached(folder, identity):
                progress(scenario.budget.adaptation_steps if number else 0)
            else:
                cached(folder, identity, functools.partial(make, number))
    return root


def load_stages(spec: RunSpec, folder: Path) -> list[Policy]:
    """Return the policies of all stages of a run that lie in a folder, as "stage-0" and so on."""
    numbers = range(len(spec.load().target) + 1)
    return [load_stage(folder / f"stage-{number}", spec.build(), spec.device) for number in numbers]


def keep_stages(spec: RunSpec, checkpoints: Path, progress: Callable[[float], None] = lambda _: None) -> None:
    """Keep the policies of all stages of a run that went through without keeping them.

    Args:
        spec: The run.
        checkpoints: Folder below which they are kept.
        progress: As for `stage_policies`.
    """
    folder = make_stages(spec, progress)
    drop_stages(spec, checkpoints)
    for number in range(len(spec.load().target) + 1):
        keep_stage(spec, checkpoints, number, folder / f"stage-{number}")


def has_stages(spec: RunSpec, checkpoints: Path, last: int | None = None) -> bool:
    """Return whether the policies of this very run, up to stage `last`, are kept and whole; all if None."""
    return _are_whole(spec, _kept(spec, checkpoints), last)


def _are_whole(spec: RunSpec, folder: Path, last: int | None = None) -> bool:
    last = len(spec.load().target) if last is None else last
    return all(is_cached(folder / f"stage-{n}", _identity(spec, n)) for n in range(last + 1))


def _kept(spec: RunSpec, checkpoints: Path) -> Path:
    """Return where a run keeps its policies."""
    return spec.path(checkpoints).with_suffix("")


def _made(spec: RunSpec) -> Path:
    """Return where the cache has policies that were made again, by this version of the code."""
    code = sources(spec.load(), spec.seed, package_of(type(spec.build()).__module__))
    return cache_folder() / "stages" / hash_of({**_identity(spec, 0), **code})


def keep_stage(spec: RunSpec, checkpoints: Path, number: int, source: Path) -> None:
    """Keep what stage `number` of a run left in the folder `source`."""

    def write(folder: Path) -> None:
        for name in STAGE_FILES:
            shutil.copyfile(source / name, folder / name)

    cached(_kept(spec, checkpoints) / f"stage-{number}", _identity(spec, number), write)


def drop_stages(spec: RunSpec, checkpoints: Path) -> None:
    """Remove what is kept of a run: its policies belong to what another version of the code computed."""
    for folder in _kept(spec, checkpoints).glob("stage-*"):
        shutil.rmtree(folder)


def _identity(spec: RunSpec, number: int) -> dict[str, Any]:
    """Return what tells the policy of a stage from those of other runs, in every version of the code."""
    run, scenario = spec.describe()
    for name in ("split", "perturb"):  # on what it is evaluated makes no difference
        run.pop(name, None)
    return {"run": run, "scenario": scenario, "stage": number}
