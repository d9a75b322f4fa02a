"""The evaluation before the first target, kept in the cache: most methods start from the same policy."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import torch

from clbench.base.cache import cache_folder, cached, hash_of, hash_of_tensors, is_cached
from clbench.base.progress import ProgressCallback, no_progress
from clbench.data.training_data import TrainingData
from clbench.evaluation.examiner import Examiner
from clbench.learning.method import Method
from clbench.learning.optimise import deterministic
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import describe_method
from clbench.learning.trainer import training_inputs
from clbench.policy.policy import Policy
from clbench.records.record import Record
from clbench.runs.fingerprint import arithmetic
from clbench.runs.length import point_length
from clbench.runs.spec import ResolvedRun
from clbench.spec.identifiers import built_in_methods
from clbench.spec.references import BASELINE

TABLES = ("episodes", "answers", "policy")
"""Tables of a record that an evaluation fills."""


def evaluate_start(
    run: ResolvedRun, examiner: Examiner, policy: Policy, record: Record, progress: ProgressCallback
) -> None:
    """Fill `record` with the evaluation of a policy before the first target, from the cache if it is there.

    Args:
        run: The run.
        examiner: Examiner of the run, which reports its own progress.
        policy: The policy that the method's `prepare` left.
        record: Record of the run, whose tables are still empty.
        progress: Called with the length of the evaluation if the cache has it.
    """
    evaluated = False

    def write(folder: Path) -> None:
        nonlocal evaluated
        examiner.examine(policy, run.protocol.end(0), record)
        evaluated = True
        values = {name: getattr(record, name) for name in TABLES}
        (folder / "report.json").write_text(json.dumps(values), encoding="utf-8")

    folder, inputs = _kept(run, policy)
    cached(folder, inputs, write)
    if not evaluated:
        for name, value in json.loads((folder / "report.json").read_text(encoding="utf-8")).items():
            setattr(record, name, value)
        progress(point_length(run.protocol, run.protocol.end(0)))


def evaluate_pretrained(run: ResolvedRun, progress: ProgressCallback = no_progress) -> float | None:
    """Evaluate the pretrained policy from which runs like `run` start, unless the cache has the evaluation.

    Args:
        run: One of the runs; its method makes no difference.
        progress: Called with the length of the work done since its last call, in optimiser steps.

    Returns:
        Success of this policy on the retained skills; None if there are none.
    """
    run = _of_baseline(run)
    with deterministic(run.spec.device):
        policy, _ = pretrained_policy(run.scenario, run.spec.seed)
        policy = policy.to(run.spec.device)
        data = TrainingData.open(run.scenario, policy.config)
        examiner = Examiner(run.scenario, run.protocol, data, policy, run.spec.seed, progress)
        record = Record("success", run.info, run.scenario_info)
        try:
            evaluate_start(run, examiner, policy, record, progress)
        finally:
            examiner.close()
    return record.retained_at_start()


def is_evaluated(run: ResolvedRun) -> bool:
    """Return whether the cache has the evaluation of the pretrained policy; the policy must exist.

    On a machine without the GPU of the run, the answer is not known, and False: a worker may have one.
    """
    if torch.device(run.spec.device).type == "cuda" and not torch.cuda.is_available():
        return False
    policy, _ = pretrained_policy(run.scenario, run.spec.seed)
    return is_cached(*_kept(_of_baseline(run), policy))


def starts_as_pretrained(run: ResolvedRun) -> bool:
    """Return whether `evaluate_start` may take the evaluation that `evaluate_pretrained` leaves.

    Built-in methods change what a policy computes through its weights alone. `prepare` of another method may
    add a hook or replace `act`, which no weight shows.
    """
    return run.method.prepare is Method.prepare or run.spec.method in built_in_methods()


def _of_baseline(run: ResolvedRun) -> ResolvedRun:
    """Return the run of plain fine-tuning, which prepares nothing."""
    return dataclasses.replace(run.spec, method=BASELINE, changes={}).resolve()


def _kept(run: ResolvedRun, policy: Policy) -> tuple[Path, dict[str, Any]]:
    """Return the folder of an evaluation in the cache, and everything that it depends on."""
    spec = run.spec
    own = {}
    if not starts_as_pretrained(run):
        own = {"method": describe_method(run.method), "settings": run.info.settings}
    inputs = {
        **own,
        "policy": hash_of_tensors(policy.state_dict()),
        "scenario": dataclasses.asdict(run.scenario_info),
        "spec": [spec.seed, spec.device, spec.split, spec.perturb],
        "hardware": arithmetic(spec.device),
        **training_inputs(run.scenario, spec.seed),
    }
    return cache_folder() / "reports" / hash_of(inputs), inputs
