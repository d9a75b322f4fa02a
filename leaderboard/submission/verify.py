"""Verification: a record is read again, replayed from its policies, or made a second time.

Each check says what it found. What a record names is imported only if it is installed or the verifier names
it himself. What was found goes into a file beside the record, with who found it; the record is never touched.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from clbench.data.questions import load_questions, scored_questions
from clbench.base.errors import ClbenchError
from clbench.evaluation.rollouts import Evaluator, Trial, answer
from clbench.jobs.job import Job, JobError
from clbench.jobs.processes import Processes
from clbench.jobs.scheduler import run_with_bars
from clbench.learning.pretraining import pretrained_policy
from clbench.learning.registry import method_names
from clbench.learning.trainer import repeatable
from clbench.policy.policy import Policy
from clbench.records.reader import RecordError
from clbench.records.record import Record
from clbench.runs.checkpoints import kept_stages, load_stages, stage_policies
from clbench.runs.fingerprint import fingerprint
from clbench.runs.run import episode_row, execute, pretrained_hash
from clbench.runs.spec import RunSpec, run_length
from clbench.scoring.metrics import measure
from clbench.spec.scenario import Scenario

from ..board.runs import Run, differences, read_run
from ..board.tiers import TIERS, tier_of, verification_path
from ..views.table import write_if_changed

Row = tuple[Any, ...]
"""One line of a table of a record."""

SHOWN = 3
"""Differences that a check tells in full."""

PARTS = ("run", "scenario", "episodes", "answers", "policy", "costs", "diagnostics")
"""What two records of one run have in common to the last bit."""


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    """What was looked at."""
    found: str
    """What was found, in words."""
    passed: bool
    """Whether it is as it should be."""


@dataclass(frozen=True)
class Request:
    """What a verifier asks for."""

    tier: str
    """The highest of `TIERS` to try."""
    episodes: int
    """How many episodes are replayed; all that can be if there are fewer."""
    seed: int
    """Of the choice of these episodes. Whoever made the record must not know it."""
    method: str | None
    """The method's "module:Class", for one that is not installed: a record's own word is not imported."""
    scenario: str | None
    """Where the scenario is registered, as "module:id"; None if importing clbench registers it."""
    checkpoints: Path | None
    """Folder of kept policies; they are made again if None."""


@dataclass(frozen=True)
class _Subject:
    """A record that is verified, and what its checks need more than once."""

    run: Run
    request: Request

    @property
    def spec(self) -> RunSpec:
        """What to run to get the record again."""
        values = self.run.record.run
        return RunSpec(
            self.request.scenario or values["scenario"],
            values["method"],
            values["seed"],
            values["changes"],
            values["device"],
            order=values.get("order", 0),
            perturb=values.get("perturb", False),
        )

    @property
    def may_import(self) -> bool:
        """Whether its method may be imported: it is installed, or the verifier named it."""
        return self.run.record.run["method"] in (*method_names(), self.request.method)

    @cached_property
    def scenario(self) -> Scenario:
        """That of the verifier."""
        return self.spec.load()

    @cached_property
    def here(self) -> dict[str, Any]:
        """The fingerprint of this machine; it plays a rollout of every world."""
        return fingerprint(replace(self.spec, order=0).load())


def verify(
    path: Path, records: Path, request: Request, progress: Callable[[float], None] = lambda _: None
) -> list[Check]:
    """Look at the record at `path`, write the tier that it reaches beside it, and return what was looked at.

    What an earlier verification wrote goes; a check that fails ends this one.

    Args:
        path: The record.
        records: Folder of the records.
        request: What is asked for.
        progress: Called with the optimiser steps, or what took as long, done since its last call.
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
    """Write the file that says what a record was found to be, and by whom."""
    values = {
        "tier": tier,
        "record": hashlib.sha256(path.read_bytes()).hexdigest(),
        "seed": subject.request.seed,
        "checks": [asdict(check) for check in checks],
        "verifier": subject.here,
    }
    write_if_changed(verification_path(path), json.dumps(values, indent=1) + "\n")


# ---- recomputed --------------------------------------------------------------------------------------------


def _recompute(subject: _Subject, _: Callable[[float], None]) -> list[Check]:
    """Check that a record agrees with itself, and is of this very scenario."""
    run = subject.run
    values = {name: measure(name, run.scores) for name in ("final_average", "adaptation", "retention")}
    told = ", ".join(f"{name} {'-' if value is None else f'{value:.3f}'}" for name, value in values.items())
    checks = [Check("metrics from its episodes", told, values["final_average"] is not None)]
    try:
        scenario = subject.scenario
        described = subject.spec.describe() if subject.may_import else None
    except ClbenchError as error:
        return [*checks, Check("what was run", str(error.args[0]), False)]
    checks.append(_check_horizons(run.record, scenario))
    if described is None:
        told = f"{run.record.run['method']} is not installed: its settings were not compared with its class"
        checks.append(Check("what was run", told, True))
    else:
        ours = dict(zip(("run", "scenario"), described, strict=True))
        theirs = {"run": run.record.run, "scenario": run.record.scenario}
        wrong = [f"{part}.{name}" for part in ours for name in differences(theirs[part], ours[part])]
        told = (
            f"{', '.join(wrong)} differ from what is installed"
            if wrong
            else "as its class and the scenario say"
        )
        checks.append(Check("what was run", told, not wrong))
    recorded, found = run.record.fingerprint.get("rollouts"), subject.here["rollouts"]
    worlds = ", ".join(differences(recorded, found)) or "all worlds"
    told = "moves as here" if recorded == found else f"the rollouts of {worlds} differ from those here"
    return [*checks, Check("simulator", told, recorded == found)]


def _check_horizons(record: Record, scenario: Scenario) -> Check:
    """Check that episodes end as episodes do: with success, or at the horizon of their task."""
    horizons = {task.name: task.horizon for task in scenario.tasks}
    wrong = [
        f"{task} {split} episode {number} of stage {stage}"
        for stage, _, task, split, number, success, _, length in _rows(record.episodes)
        if not (length == horizons.get(task) or (success and 0 < length < horizons.get(task, 0)))
    ]
    if not wrong:
        return Check(
            "ends of episodes", f"all {len(record.episodes['task'])} as the task's horizon allows", True
        )
    return Check("ends of episodes", f"failed before the horizon, or beyond it: {_some(wrong)}", False)


# ---- replayed ----------------------------------------------------------------------------------------------


def _replay(subject: _Subject, progress: Callable[[float], None]) -> list[Check]:
    """Run episodes of a record again from the policies of its stages, and ask the questions again."""
    run, spec = subject.run, subject.spec
    if run.division == "online":
        return [
            Check("policies", "an agent that learned online leaves none: it is recomputed at best", False)
        ]
    if not subject.may_import:
        told = f"{run.method} is not installed: name it with --method to import and run its code"
        return [Check("policies", told, False)]
    kept = kept_stages(spec, subject.request.checkpoints)
    if kept is None:
        _, folder = pretrained_policy(subject.scenario, spec.seed)
        if pretrained_hash(folder) != run.record.fingerprint.get("pretrained"):
            told = (
                "pretraining does not give the same policy here as where the record was made, as on another "
                "processor: ask for the policies of its stages (--checkpoints)"
            )
            return [Check("policies", told, False)]
    with repeatable(spec.device):
        policies = load_stages(spec, kept) if kept else stage_policies(spec, progress=progress)
        episodes = _replay_episodes(subject, policies)
        answers = _replay_answers(subject, policies)
    origin = "those kept by the run" if kept else "made again"
    return [Check("policies", origin, True), episodes, answers]


def _replay_episodes(subject: _Subject, policies: Sequence[Policy]) -> Check:
    scenario, request = subject.scenario, subject.request
    end = scenario.budget.adaptation_steps
    every = _rows(subject.run.record.episodes)
    at_ends = [row for row in every if row[1] in (0, end) and row[3] != "validation"]
    generator = np.random.default_rng(request.seed)
    chosen = generator.permutation(len(at_ends))[: request.episodes]
    rows = [at_ends[index] for index in sorted(chosen)]
    again: list[Row] = []
    evaluator = Evaluator(scenario, subject.spec.seed)
    for stage, policy in enumerate(policies):
        trials: list[Trial] = [(scenario.task(row[2]), row[3], row[4]) for row in rows if row[0] == stage]
        policy.eval()
        step = end if stage else 0
        again += [episode_row(stage, step, episode) for episode in evaluator.play(policy, trials)]
    evaluator.close()
    wrong = [
        f"{' '.join(theirs[2:4])} episode {theirs[4]} of stage {theirs[0]} has {_told(theirs)}, "
        f"not {_told(ours)}"
        for theirs, ours in zip(rows, again, strict=True)
        if theirs != ours
    ]
    if wrong:
        return Check("episodes", f"{len(wrong)} of {len(rows)} ended otherwise: {_some(wrong)}", False)
    return Check("episodes", f"{len(rows)} of {len(at_ends)} run again, all ended as recorded", True)


def _told(row: Row) -> str:
    success, total_reward, length = row[5:]
    return f"{'success' if success else 'failure'} after {length} steps, return {total_reward}"


def _replay_answers(subject: _Subject, policies: Sequence[Policy]) -> Check:
    scenario = subject.scenario
    _, questions = load_questions(scenario)
    kind, asked = scored_questions(questions, scenario.budget.test_questions)
    end = scenario.budget.adaptation_steps
    again = [
        (stage, end if stage else 0, *counts)
        for stage, policy in enumerate(policies)
        for counts in answer(policy, questions.kinds, kind, asked)
    ]
    theirs = {row for row in _rows(subject.run.record.answers) if row[1] in (0, end)}
    wrong = [f"{row[2]} after stage {row[0]}" for row in sorted(theirs.symmetric_difference(again))]
    if wrong:
        return Check("answers", f"other counts of right answers: {_some(list(dict.fromkeys(wrong)))}", False)
    return Check("answers", f"asked again after all {len(policies) - 1} stages, counts as recorded", True)


# ---- retrained ---------------------------------------------------------------------------------------------


def _retrain(subject: _Subject, progress: Callable[[float], None]) -> list[Check]:
    """Do the whole run again, and compare the records."""
    with tempfile.TemporaryDirectory() as folder:
        again = execute(subject.spec, Path(folder), progress)
    wrong = []
    for part in PARTS:
        theirs, ours = getattr(subject.run.record, part), getattr(again, part)
        if theirs != ours:
            names = ", ".join(differences(theirs, ours))
            wrong.append(f"{part} ({names})" if names else part)
    if again.error is not None:
        return [Check("whole run", f"it failed: {again.error['type']}: {again.error['message']}", False)]
    if wrong:
        return [Check("whole run", f"done again, {', '.join(wrong)} came out otherwise", False)]
    return [Check("whole run", f"done again, equal in {', '.join(PARTS)}", True)]


def _rows(columns: dict[str, list[Any]]) -> list[Row]:
    return list(zip(*columns.values(), strict=True))


def _some(wrong: Sequence[str]) -> str:
    more = f", and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
    return f"{'; '.join(wrong[:SHOWN])}{more}"


# ---- the job -----------------------------------------------------------------------------------------------


def run_verifications(paths: Sequence[Path], records: Path, request: Request, workers: int | None) -> bool:
    """Verify records, each in a process of its own, and return whether all of them passed."""
    jobs = [_job(path, records, request) for path in paths]
    return not run_with_bars(jobs, Processes(workers), Console())


def _job(path: Path, records: Path, request: Request) -> Job:
    """Return the job that verifies a record; how long it takes is known if it can be read."""
    length = 1.0
    try:
        subject = _Subject(read_run(records, path, changed=None), request)
        scenario = subject.scenario
        if request.tier in TIERS[2:]:
            length += len(scenario.target) * scenario.budget.adaptation_steps
        if request.tier == "retrained":
            length += run_length(scenario, perturb=subject.spec.perturb)
    except ClbenchError:
        pass  # the job itself says what is wrong
    arguments = {"path": str(path), "records": str(records), "request": request}
    return Job(str(path), "clbench.leaderboard.submission.verify:verify_job", arguments, length)


def verify_job(path: str, records: str, request: Request, progress: Callable[[float], None]) -> str:
    """Verify a record, and return its tier with what was found."""
    checks = verify(Path(path), Path(records), request, progress)
    text = "\n".join(f"  {'ok ' if check.passed else 'NOT'} {check.name}: {check.found}" for check in checks)
    progress(1.0)
    tier = tier_of(Path(path))
    if not all(check.passed for check in checks):
        raise JobError(f"{tier}\n{text}")
    return f"{tier}\n{text}"
