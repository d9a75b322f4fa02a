"""Verification: a record is read again, replayed from its policies, or made a second time.

Each check reports its result. A method that a record names is imported only if it is installed or if the
verifier names it too. The results go into a file next to the record, with the verifier's fingerprint; the
record is never changed.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from clbench.base.errors import ClbenchError, InputError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.data.questions import load_questions, scored_questions
from clbench.evaluation.answers import answer
from clbench.evaluation.checks import Checker
from clbench.evaluation.examiner import episode_row
from clbench.evaluation.rollouts import Evaluator, Trial
from clbench.jobs.job import Job, JobError
from clbench.jobs.processes import Processes
from clbench.jobs.scheduler import run_with_bars
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import method_names
from clbench.learning.trainer import repeatable
from clbench.policy.policy import Policy
from clbench.records.pinned import other_parts
from clbench.records.reader import RecordError
from clbench.records.record import EpisodeRow, Record
from clbench.runs.checkpoints import kept_stages, load_stages, stage_policies
from clbench.runs.fingerprint import fingerprint
from clbench.runs.length import run_length
from clbench.runs.run import execute, pretrained_hash
from clbench.runs.spec import ResolvedRun, RunSpec, check_device
from clbench.scoring.metrics import measure
from clbench.scoring.reading import read_protocol
from clbench.spec.protocol import Point, Protocol
from clbench.spec.scenario import Scenario

from ..board.runs import Run, differences, read_run
from ..board.tiers import TIERS, tier_of, verification_path
from ..views.format import write_if_changed

SHOWN = 3
"""Number of differences that a check reports in full."""

PARTS = (
    "run",
    "scenario",
    "episodes",
    "answers",
    "policy",
    "checks",
    "relearning",
    "costs",
    "diagnostics",
)
"""Parts that two records of one run share to the last bit."""


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    """Subject of the check."""
    found: str
    """Result in words."""
    passed: bool
    """Whether the record passed."""


@dataclass(frozen=True)
class Request:
    """The options of a verification."""

    tier: str
    """Highest of `TIERS` to check."""
    episodes: int
    """Number of episodes to replay; all replayable ones if there are fewer."""
    seed: int
    """Random seed that selects these episodes. The submitter must not know it."""
    method: str | None
    """module:Class of a method that is not installed; the name in a record alone is never imported."""
    scenario: str | None
    """module:id of the scenario; None if clbench registers it."""
    checkpoints: Path | None
    """Folder of kept policies; if None, they are trained again."""


@dataclass(frozen=True)
class _Subject:
    """A record under verification, with values that several checks need."""

    run: Run
    request: Request

    @property
    def spec(self) -> RunSpec:
        """The run that makes the record again."""
        values = self.run.record.run
        return RunSpec(
            self.request.scenario or values.scenario,
            values.method,
            values.seed,
            values.changes,
            values.device,
            order=values.order,
            perturb=values.perturb,
        )

    @property
    def may_import(self) -> bool:
        """Whether its method may be imported: it is installed, or the verifier named it."""
        return self.run.record.run.method in (*method_names(), self.request.method)

    @cached_property
    def resolved(self) -> ResolvedRun:
        """The run, whose method is imported."""
        return self.spec.resolve()

    @cached_property
    def scenarios(self) -> tuple[Scenario, Scenario]:
        """The verifier's scenario, with the targets in the order of the run and in the published order."""
        return self.spec.scenarios()

    @property
    def scenario(self) -> Scenario:
        """The verifier's scenario, with the targets in the order of the run."""
        return self.scenarios[0]

    @property
    def protocol(self) -> Protocol:
        """The evaluation protocol of the run, with the ends of its stages."""
        planned = Protocol.of(self.scenario, self.spec.split, self.spec.perturb)
        return replace(planned, ends=read_protocol(self.run.record).ends)

    @cached_property
    def here(self) -> dict[str, Any]:
        """The fingerprint of this machine; it plays a rollout of every world."""
        return fingerprint(self.scenarios[1])


def verify(
    path: Path, records: Path, request: Request, progress: ProgressCallback = no_progress
) -> list[Check]:
    """Check the record at `path`, write its tier into a file next to it, and return the checks.

    The file of an earlier verification is deleted first. The first tier with a failed check is the last one.

    Args:
        path: Path of the record.
        records: Folder of the records.
        request: Options of the verification.
        progress: Called with the work done since its last call, in optimiser steps.
    """
    verification_path(path).unlink(missing_ok=True)
    try:
        run = read_run(records, path, changed=None)
    except RecordError as error:
        return [Check("record", str(error), False)]
    subject = _Subject(run, request)
    checks: list[Check] = []
    looks = {"recomputed": _recompute, "replayed": _replay, "retrained": _retrain}
    for tier in TIERS[1 : TIERS.index(request.tier) + 1]:
        checks += looks[tier](subject, progress)
        if not all(check.passed for check in checks):
            break
        _write(path, subject, tier, checks)
    return checks


def _write(path: Path, subject: _Subject, tier: str, checks: Sequence[Check]) -> None:
    """Write the file with the tier of a record, the checks, and the verifier's fingerprint."""
    values = {
        "tier": tier,
        "record": hashlib.sha256(path.read_bytes()).hexdigest(),
        "seed": subject.request.seed,
        "checks": [asdict(check) for check in checks],
        "verifier": subject.here,
    }
    write_if_changed(verification_path(path), json.dumps(values, indent=1) + "\n")


# ---- recomputed --------------------------------------------------------------------------------------------


def _recompute(subject: _Subject, _: ProgressCallback) -> list[Check]:
    """Check that a record is consistent, and that it belongs to this version of its scenario."""
    run = subject.run
    values = {name: measure(name, run.scores) for name in ("final_average", "adaptation", "retention")}
    result = ", ".join(f"{name} {'-' if value is None else f'{value:.3f}'}" for name, value in values.items())
    checks = [Check("metrics from its episodes", result, values["final_average"] is not None)]
    try:
        scenario = subject.scenario
        described = subject.resolved if subject.may_import else None
    except ClbenchError as error:
        return [*checks, Check("what was run", str(error.args[0]), False)]
    checks.append(_check_horizons(run.record, scenario))
    if described is None:
        result = f"{run.record.run.method} is not installed: its settings were not compared with its class"
        checks.append(Check("what was run", result, True))
    else:
        ours = {"run": described.info, "scenario": described.scenario_info}
        theirs = {"run": run.record.run, "scenario": run.record.scenario}
        wrong = [
            f"{part}.{name}" for part in ours for name in differences(vars(theirs[part]), vars(ours[part]))
        ]
        result = (
            f"{', '.join(wrong)} differ from the installed code"
            if wrong
            else "matches its class and the scenario"
        )
        checks.append(Check("what was run", result, not wrong))
    recorded, found = run.record.fingerprint.get("rollouts"), subject.here["rollouts"]
    worlds = ", ".join(differences(recorded, found)) or "all worlds"
    result = (
        "same rollouts as here" if recorded == found else f"the rollouts of {worlds} differ from those here"
    )
    return [*checks, Check("simulator", result, recorded == found), _check_definition(subject)]


def _check_definition(subject: _Subject) -> Check:
    """Check that the tasks and questions of the record are those of the installed scenario."""
    recorded = subject.run.record.fingerprint.get("definition")
    if recorded is None:
        return Check("definition", "the record is older than definitions: not compared", True)
    other = other_parts(recorded, subject.here["definition"])
    result = (
        f"{', '.join(other)} differ from the installed code"
        if other
        else "tasks and questions are those here"
    )
    return Check("definition", result, not other)


def _check_horizons(record: Record, scenario: Scenario) -> Check:
    """Check that episodes end with success or at the horizon of their task."""
    horizons = {task.name: task.horizon for task in scenario.tasks}
    wrong = [
        f"{row.task} {row.split} episode {row.episode} of stage {row.stage}"
        for row in record.episode_rows()
        if not (
            row.length == horizons.get(row.task)
            or (row.success and 0 < row.length < horizons.get(row.task, 0))
        )
    ]
    if not wrong:
        return Check(
            "ends of episodes", f"all {len(record.episodes['task'])} end as the task's horizon allows", True
        )
    return Check("ends of episodes", f"failed before the horizon or ran beyond it: {_some(wrong)}", False)


# ---- replayed ----------------------------------------------------------------------------------------------


def _replay(subject: _Subject, progress: ProgressCallback) -> list[Check]:
    """Replay episodes of a record with the policies of its stages, and ask the questions again."""
    run, spec = subject.run, subject.spec
    if run.division == "online":
        return [
            Check(
                "policies", "an agent that learned online has none, so its highest tier is recomputed", False
            )
        ]
    if not subject.may_import:
        result = f"{run.method} is not installed: name it with --method to import and run its code"
        return [Check("policies", result, False)]
    try:
        check_device(spec.device)
    except InputError as error:  # the rest needs the device of the run
        return [Check("policies", str(error), False)]
    kept = kept_stages(subject.resolved, subject.request.checkpoints)
    if kept is None:
        _, folder = pretrained_policy(subject.scenario, spec.seed)
        if pretrained_hash(folder) != run.record.fingerprint.get("pretrained"):
            result = (
                "pretraining does not give the same policy here as on the machine of the record, perhaps "
                "because of another processor: ask the submitter for the policies of its stages "
                "(--checkpoints)"
            )
            return [Check("policies", result, False)]
    with repeatable(spec.device):
        policies = (
            load_stages(subject.resolved, kept)
            if kept
            else stage_policies(subject.resolved, progress=progress)
        )
        episodes = _replay_episodes(subject, policies)
        answers = _replay_answers(subject, policies)
    origin = "kept by the run" if kept else "trained again"
    checks = _replay_checks(subject, policies) if subject.scenario.budget.criterion else []
    return [Check("policies", origin, True), episodes, answers, *checks]


def _replay_episodes(subject: _Subject, policies: Sequence[Policy]) -> Check:
    scenario, protocol, request = subject.scenario, subject.protocol, subject.request
    every = subject.run.record.episode_rows()
    at_ends = [row for row in every if protocol.is_end(row.point) and row.split != "validation"]
    generator = np.random.default_rng(request.seed)
    chosen = generator.permutation(len(at_ends))[: request.episodes]
    rows = [at_ends[index] for index in sorted(chosen)]
    again: list[EpisodeRow] = []
    with closing(Evaluator(scenario, subject.spec.seed)) as evaluator:
        for stage, policy in enumerate(policies):
            trials: list[Trial] = [
                (scenario.task(row.task), row.split, row.episode) for row in rows if row.stage == stage
            ]
            policy.eval()
            again += [episode_row(protocol.end(stage), episode) for episode in evaluator.play(policy, trials)]
    wrong = [
        f"{theirs.task} {theirs.split} episode {theirs.episode} of stage {theirs.stage} has "
        f"{_outcome(theirs)}, not {_outcome(ours)}"
        for theirs, ours in zip(rows, again, strict=True)
        if theirs != ours
    ]
    if wrong:
        return Check("episodes", f"{len(wrong)} of {len(rows)} ended differently: {_some(wrong)}", False)
    return Check("episodes", f"{len(rows)} of {len(at_ends)} replayed, all ended as recorded", True)


def _replay_checks(subject: _Subject, policies: Sequence[Policy]) -> list[Check]:
    """Repeat the last check of each stage with the policy that the stage left."""
    if subject.resolved.method.whole_stages:
        return []  # the policy changed after the last check
    last = {row.stage: row for row in subject.run.record.check_rows()}
    targets = subject.scenario.target
    with closing(Checker(subject.scenario, subject.protocol, subject.spec.seed)) as checker:
        wrong = [
            f"stage {stage}"
            for stage, row in last.items()
            if checker.check(policies[stage], targets[stage - 1], subject.protocol.end(stage)) != row
        ]
    if wrong:
        return [Check("ends of stages", f"another outcome of the last check: {_some(wrong)}", False)]
    return [Check("ends of stages", f"the last checks of all {len(last)} stages repeat themselves", True)]


def _outcome(row: EpisodeRow) -> str:
    return f"{'success' if row.success else 'failure'} after {row.length} steps, return {row.total_reward}"


def _replay_answers(subject: _Subject, policies: Sequence[Policy]) -> Check:
    scenario = subject.scenario
    _, questions = load_questions(scenario)
    kind, asked = scored_questions(questions, scenario.budget.test_questions)
    protocol = subject.protocol
    again = [
        (*protocol.end(stage), *counts)
        for stage, policy in enumerate(policies)
        for counts in answer(policy, questions.kinds, kind, asked)
    ]
    rows = zip(*subject.run.record.answers.values(), strict=True)
    theirs = {row for row in rows if protocol.is_end(Point(*row[:2]))}
    wrong = [f"{row[2]} after stage {row[0]}" for row in sorted(theirs.symmetric_difference(again))]
    if wrong:
        return Check(
            "answers", f"different counts of correct answers: {_some(list(dict.fromkeys(wrong)))}", False
        )
    return Check("answers", f"asked again after all {len(policies) - 1} stages, same counts", True)


# ---- retrained ---------------------------------------------------------------------------------------------


def _retrain(subject: _Subject, progress: ProgressCallback) -> list[Check]:
    """Repeat the whole run, and compare the records."""
    with tempfile.TemporaryDirectory() as folder:
        again = execute(subject.resolved, Path(folder), progress)
    wrong = []
    for part in PARTS:
        theirs, ours = (_as_dictionary(getattr(record, part)) for record in (subject.run.record, again))
        if theirs != ours:
            names = ", ".join(differences(theirs, ours))
            wrong.append(f"{part} ({names})" if names else part)
    if again.error is not None:
        return [Check("whole run", f"it failed: {again.error['type']}: {again.error['message']}", False)]
    if wrong:
        return [Check("whole run", f"repeated, {', '.join(wrong)} differ", False)]
    return [Check("whole run", f"repeated, equal in {', '.join(PARTS)}", True)]


def _as_dictionary(part: Any) -> Any:
    return asdict(part) if is_dataclass(part) and not isinstance(part, type) else part


def _some(wrong: Sequence[str]) -> str:
    more = f", and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
    return f"{'; '.join(wrong[:SHOWN])}{more}"


# ---- the job -----------------------------------------------------------------------------------------------


def run_verifications(paths: Sequence[Path], records: Path, request: Request, workers: int | None) -> bool:
    """Verify records, each in its own process, and return whether all of them passed."""
    jobs = [_job(path, records, request) for path in paths]
    return not run_with_bars(jobs, Processes(workers), Console())


def _job(path: Path, records: Path, request: Request) -> Job:
    """Return the job that verifies a record; its length is known if the record can be read."""
    length = 1.0
    try:
        subject = _Subject(read_run(records, path, changed=None), request)
        scenario = subject.scenario
        if request.tier in TIERS[2:]:
            length += len(scenario.target) * scenario.budget.adaptation_steps
        if request.tier == "retrained":
            length += run_length(scenario, subject.protocol)
    except ClbenchError:
        pass  # the job itself reports the error
    arguments = {"path": str(path), "records": str(records), "request": request}
    return Job(str(path), verify_job, arguments, length)


def verify_job(path: str, records: str, request: Request, progress: ProgressCallback) -> str:
    """Verify a record, and return its tier with the results of the checks."""
    checks = verify(Path(path), Path(records), request, progress)
    text = "\n".join(f"  {'ok ' if check.passed else 'NOT'} {check.name}: {check.found}" for check in checks)
    progress(1.0)
    tier = tier_of(Path(path))
    if not all(check.passed for check in checks):
        raise JobError(f"{tier}\n{text}")
    return f"{tier}\n{text}"
