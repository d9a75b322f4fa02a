"""The tier "replayed": episodes, questions and checks are repeated with the policies of the stages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from scipy.stats import hypergeom

from clbench.base.errors import InputError
from clbench.base.progress import ProgressCallback, announce
from clbench.data.training_data import TrainingData
from clbench.evaluation.answers import answer
from clbench.evaluation.checks import Checker
from clbench.evaluation.episodes import Trial
from clbench.evaluation.examiner import episode_row
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.optimise import deterministic
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.trainer import Trainer
from clbench.policy.policy import Policy
from clbench.records.paths import stage_folder
from clbench.records.record import EpisodeRow
from clbench.runs.run import pretrained_hash
from clbench.runs.spec import check_device
from clbench.runs.stages import kept_stages, lengths_of_stages, load_stages, make_stages, method_needed
from clbench.spec.protocol import Point

from .subject import Check, Subject, some

LARGEST_DRIFT = 0.05
"""Largest distance of a repeated policy from the kept one, as a share of how far the stage moved it."""

MISSED = 0.05
"""Probability with which a look at some episodes may miss made-up ones."""


def replay(subject: Subject, progress: ProgressCallback) -> list[Check]:
    """Replay episodes of a record with the policies of its stages, and ask the questions again.

    Raises:
        MethodError: The method fails when it is run again.
    """
    spec = subject.spec
    if subject.strange:
        options = " and ".join("--method" if name == spec.method else "--policy" for name in subject.strange)
        names = " and ".join(subject.strange)
        result = f"{names} is not installed: name it with {options} to import and run its code"
        return [Check("policies", result, None)]
    try:
        check_device(spec.device)
    except InputError as error:  # the rest needs the device of the run
        return [Check("policies", str(error), None)]
    processors = subject.other_processor
    tried = processors is None or subject.request.any_processor
    if not tried or not _same_pretraining(subject, progress):
        what = "pretraining" if tried else "training"
        elsewhere = f" ({processors})" if processors else ""
        anyway = "" if tried else ", or try it here with --any-processor"
        result = (
            f"{what} does not give the same policy here as on the machine of the record{elsewhere}: "
            f"repeat it on one like that{anyway}"
        )
        return [Check("policies", result, None)]
    where = f", played on another processor ({processors})" if processors else ""
    kept = kept_stages(subject.resolved, subject.request.checkpoints)
    with deterministic(spec.device):
        lengths = None
        if kept is None:
            made = make_stages(subject.resolved, progress)
            policies, lengths = load_stages(subject.resolved, made), lengths_of_stages(subject.resolved, made)
            checks = [Check("policies", f"trained again{where}", True)]
        else:
            policies = load_stages(subject.resolved, kept)
            checks = [
                Check("policies", f"kept by the run{where}", True),
                _start(subject, policies[0], progress),
            ]
        checks += [_replay_episodes(subject, policies), _replay_answers(subject, policies)]
        if subject.scenario.budget.criterion:
            checks += _replay_ends(subject, policies, lengths)
    if kept is not None:
        checks.append(_go_on(subject, kept, policies))
    return checks


def _same_pretraining(subject: Subject, progress: ProgressCallback) -> bool:
    """Return whether the run began with the policy that pretraining gives here."""
    announce("pretraining")
    _, folder = pretrained_policy(subject.scenario, subject.spec.seed, progress)
    return pretrained_hash(folder) == subject.run.record.fingerprint.get("pretrained")


def _start(subject: Subject, first: Policy, progress: ProgressCallback) -> Check:
    """Compare the kept policy before the first target with what pretraining and `prepare` give here.

    Only equal bits pass. On another processor, pretraining ends far away: on Fetch-v1, AVX2 instructions lead
    to a distance of 29 from where AVX512 leads, with weights of norm 204.
    """
    trainer = Trainer.open(
        subject.scenario, subject.resolved.new_method, subject.spec.seed, subject.spec.device
    )
    with method_needed(subject.resolved, trainer):
        trainer.prepare(progress)
    ours, theirs = trainer.policy.state_dict(), first.state_dict()
    same = ours.keys() == theirs.keys() and all(value.equal(theirs[name]) for name, value in ours.items())
    is_or_not = "is" if same else "is not"
    return Check("start", f"the policy before the first target {is_or_not} what pretraining gives", same)


def _replay_episodes(subject: Subject, policies: Sequence[Policy]) -> Check:
    """Play randomly chosen episodes again, of all splits, at the ends of all stages."""
    scenario, protocol, request = subject.scenario, subject.protocol, subject.request
    every = subject.run.record.episode_rows()
    at_ends = [row for row in every if protocol.is_end(row.point)]
    generator = np.random.default_rng(request.seed)
    chosen = generator.permutation(len(at_ends))[: request.episodes]
    # a record may hold its episodes in any order; they are played again stage by stage
    rows = sorted((at_ends[index] for index in sorted(chosen)), key=lambda row: row.stage)
    again: list[EpisodeRow] = []
    with closing(Evaluator(scenario, subject.spec.seed)) as evaluator:
        for stage, policy in enumerate(policies):
            trials = [
                Trial(scenario.task(row.task), row.split, row.episode) for row in rows if row.stage == stage
            ]
            again += [episode_row(protocol.end(stage), episode) for episode in evaluator.play(policy, trials)]
    wrong = [
        f"{theirs.task} {theirs.split} episode {theirs.episode} of stage {theirs.stage} has "
        f"{_outcome(theirs)}, not {_outcome(ours)}"
        for theirs, ours in zip(rows, again, strict=True)
        if theirs != ours
    ]
    if wrong:
        return Check("episodes", f"{len(wrong)} of {len(rows)} ended differently: {some(wrong)}", False)
    unseen = len(every) - len(at_ends)
    found = [
        f"{len(rows)} of {len(at_ends)} replayed, all ended as recorded",
        *([f"{unseen} before the ends of stages have no policy to replay"] if unseen else []),
        f"{least_found(len(at_ends), len(rows))} made-up ones would be found with a probability of 95 %",
    ]
    return Check("episodes", "; ".join(found), True)


def least_found(count: int, looked_at: int) -> int:
    """Return the least number of made-up episodes that a random look finds with a probability of 95 %.

    Args:
        count: Number of episodes.
        looked_at: Number of them that were replayed, chosen at random.
    """
    return next(
        made_up
        for made_up in range(1, count + 1)
        if hypergeom.pmf(0, count, made_up, looked_at) <= MISSED or made_up == count
    )


def _replay_ends(subject: Subject, policies: Sequence[Policy], lengths: list[int] | None) -> list[Check]:
    """Compare the lengths of stages, and repeat the last check of each with the policy that it left.

    Args:
        subject: The record.
        policies: The policies of the stages.
        lengths: Steps of the stages that were trained again; None if the run kept its policies.
    """
    last = {row.stage: row for row in subject.run.record.check_rows()}
    ends = [row.step for row in last.values()]
    if lengths is not None and lengths != ends:
        return [Check("ends of stages", f"after {ends} steps; trained again, after {lengths}", False)]
    if subject.resolved.method.whole_stages:
        return []  # the policy changed after the last check
    targets = subject.scenario.target
    with closing(Checker(subject.scenario, subject.protocol, subject.spec.seed)) as checker:
        wrong = [
            f"stage {stage}"
            for stage, row in last.items()
            if checker.check(policies[stage], targets[stage - 1], subject.protocol.end(stage)) != row
        ]
    if wrong:
        return [Check("ends of stages", f"another outcome of the last check: {some(wrong)}", False)]
    return [Check("ends of stages", f"the last checks of all {len(last)} stages repeat themselves", True)]


def _go_on(subject: Subject, kept: Path, policies: Sequence[Policy]) -> Check:
    """Train a randomly chosen stage again from the kept policy before it, and compare with the one after it.

    Policies of another method that are passed off as this one's do not follow from each other. On another GPU
    the last bits differ. A method whose code moves unused weights far enough can hide such policies.
    """
    run = subject.resolved
    number = int(np.random.default_rng(subject.request.seed).integers(len(run.scenario.target))) + 1
    steps = subject.protocol.end(number).step
    first, before, after = policies[0], policies[number - 1], policies[number]
    data = TrainingData.open(run.scenario, first.config)
    trainer = Trainer(run.scenario, data, first, run.new_method, run.spec.seed)
    with deterministic(run.spec.device), method_needed(run, trainer):
        trainer.load(stage_folder(kept, number - 1), number - 1)
        trainer.learn(number, lambda step: step.done >= steps)
    moved, apart = _distance(before, after), _distance(trainer.policy, after)
    same_parts = trainer.policy.state_dict().keys() == after.state_dict().keys()
    count = len(run.scenario.target)
    return Check(
        "from stage to stage",
        f"stage {number} of {count} ({run.scenario.target[number - 1].name}) moved the kept policy by "
        f"{moved:.3g}; trained again, it ends {apart:.2g} away from there; one made-up policy would be found "
        f"with a probability of at least {1 / count:.0%}",
        same_parts and math.isfinite(moved) and apart <= LARGEST_DRIFT * moved,
    )


def _distance(one: Policy, other: Policy) -> float:
    """Return the distance between the weights and buffers that two policies have in common.

    In 32 bits, a weight of 1e20 would make every distance infinite, and infinities pass every comparison.
    """
    values = one.state_dict()
    common = [(values[name], value) for name, value in other.state_dict().items() if name in values]
    return math.hypot(*(float((value.double() - same.double()).norm()) for same, value in common))


def _outcome(row: EpisodeRow) -> str:
    return f"{'success' if row.success else 'failure'} after {row.length} steps, return {row.total_reward}"


def _replay_answers(subject: Subject, policies: Sequence[Policy]) -> Check:
    protocol = subject.protocol
    data = TrainingData.open(subject.scenario, policies[0].config)
    kind, asked = data.scored_questions(protocol.split)
    again = [
        (*protocol.end(stage), *counts)
        for stage, policy in enumerate(policies)
        for counts in answer(policy, data.questions.kinds, kind, asked)
    ]
    rows = subject.run.record.answer_rows()
    theirs = {row for row in rows if protocol.is_end(Point(*row[:2]))}
    wrong = [f"{row[2]} after stage {row[0]}" for row in sorted(theirs.symmetric_difference(again))]
    if wrong:
        return Check(
            "answers", f"different counts of correct answers: {some(list(dict.fromkeys(wrong)))}", False
        )
    return Check("answers", f"asked again after all {len(policies) - 1} stages, same counts", True)
