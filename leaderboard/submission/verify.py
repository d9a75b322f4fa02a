"""Verification: a record is read again, replayed from its policies, or made a second time.

Each check reports its result. A method that a record names is imported only if it is installed or if the
verifier names it too. The results go into a file next to the record, with the verifier's name, if given, the
time, and the fingerprint of the machine; the record is never changed.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from clbench.base.cache import cached
from clbench.base.errors import ClbenchError, UnknownNameError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.strict_json import StrictJSONError, read_regular
from clbench.base.text import printable
from clbench.data.demonstrations import simulator_versions
from clbench.jobs.job import Job, JobError
from clbench.jobs.processes import Processes
from clbench.jobs.scheduler import run_with_bars
from clbench.learning.optimise import MethodError
from clbench.learning.pretraining import is_pretrained, pretrain
from clbench.policy.checkpoint import save_policy
from clbench.records.fingerprints import LATER, other_parts, other_versions
from clbench.records.reader import RecordError, UnreadableRecordError
from clbench.records.record import Record, RunInfo, ScenarioInfo
from clbench.runs.length import pretraining_length, run_length, watching_length
from clbench.runs.run import execute, pretrained_hash
from clbench.runs.spec import describe_scenario
from clbench.scoring.metrics import measure
from clbench.scoring.reading import is_number
from clbench.spec.identifiers import without_module
from clbench.spec.scenario import Scenario

from ..board.runs import differences, read_run
from ..board.summary import ELSEWHERE
from ..board.tiers import TIERS, tier_of, verification_path, verification_text
from ..views.files import write_all
from .replay import replay
from .subject import Check, Request, Subject, some

PARTS = tuple(
    one.name for one in fields(Record) if one.name not in ("status", "fingerprint", "timing", "error")
)
"""Parts that two records of one run share to the last bit: all but what tells how and where it was made."""

_ACTORS = {"online": "an agent that learned online", "external": "a policy served from elsewhere"}
"""What acted in the runs of `ELSEWHERE`."""

OTHER_TIME = 2.0
"""Factor between two measurements of the time of a step that chance does not explain: they differ by at most
1.59 within a row of the board, and by 1.92 within the runs of a method on the ladder."""

ORIGIN = {
    "versions": (),
    "hardware": ("machine", "system", "instructions", "gpu"),
    "method": ("authors", "link", "licence", "version"),
}
"""Entries of a fingerprint that a repetition confirms on the same kind of machine; () stands for all."""


def verify(
    path: Path, records: Path, request: Request, progress: ProgressCallback = no_progress
) -> list[Check]:
    """Check the record at `path`, write its tier into a file next to it, and return the checks.

    Checking ends at the first tier with a check that does not pass. A failed check deletes the file of an
    earlier verification. A check that cannot be made here leaves the file as it is, and so does a lower tier.

    Args:
        path: Path of the record.
        records: Folder of the records.
        request: Options of the verification.
        progress: Called with the work done since its last call, in optimiser steps.
    """
    # a failed check would delete the tier of another record
    links = [one for one in path.parents if records in one.parents and one.is_symlink()]
    if links:
        return [Check("record", f"{links[0]} is a symbolic link, which is not followed.", None)]
    digest = _digest(path)  # before it is read: the tier holds for these bytes alone
    try:
        run = read_run(records, path, changed=None)
    except UnreadableRecordError as error:  # it may be sound
        return [Check("record", str(error), None)]
    except RecordError as error:
        verification_path(path).unlink(missing_ok=True)
        return [Check("record", str(error), False)]
    subject = Subject(run, request)
    looks = {"recomputed": _recompute, "replayed": replay, "retrained": _retrain}
    reached, checks = TIERS[0], list[Check]()
    for tier in TIERS[1 : TIERS.index(request.tier) + 1]:
        if tier == "replayed" and run.division in ELSEWHERE:
            none = f"{_ACTORS[run.division]} has none, so its highest tier is recomputed"
            return [*checks, Check("policies", none, True)]
        try:
            found = looks[tier](subject, progress)
        except MethodError as error:
            found = [Check("method", str(error), False)]
        if tier != "recomputed":
            found = _in_doubt(subject, found)
        if any(check.passed is False for check in found):
            verification_path(path).unlink(missing_ok=True)
        passed = all(check.passed for check in found)
        if passed:
            reached, checks = tier, checks + found
        if reached != TIERS[0] and TIERS.index(reached) >= TIERS.index(tier_of(path)):
            _write(path, digest, subject, reached, checks)
        if not passed:
            return checks + found
    return checks


def _in_doubt(subject: Subject, checks: list[Check]) -> list[Check]:
    """Return the checks of a repetition: differences with other packages or processors prove nothing."""
    # a later clbench may score the same, as a later commit may
    packages = {name: version for name, version in subject.here["versions"].items() if name != "clbench"}
    other = _made_with(subject, packages)
    if subject.other_processor is not None:
        other.append(subject.other_processor)
    if not other:
        return checks
    return [
        check if check.passed else replace(check, found=f"{check.found}; {some(other)}", passed=None)
        for check in checks
    ]


def _other_machine(subject: Subject) -> list[str]:
    """Return in words how the record's machine is of another kind: MuJoCo on ARM rounds differently."""
    recorded = subject.run.record.fingerprint.get("hardware")
    values = recorded if isinstance(recorded, dict) else {}
    here = subject.here["hardware"]
    return [
        f"{name} {values[name]}, {here[name]} here"
        for name in ("system", "machine")
        if values.get(name) not in (None, here[name])
    ]


def _made_with(subject: Subject, packages: Mapping[str, str]) -> list[str]:
    """Return in words which of these packages a record was made with in another version."""
    recorded = subject.run.record.fingerprint.get("versions")
    return [f"{one} here" for one in other_versions(recorded, packages)]


def _digest(path: Path) -> str:
    """Return the hash of the bytes of a record, empty if they cannot be read: its reader says why."""
    try:
        return hashlib.sha256(read_regular(path)).hexdigest()
    except (OSError, StrictJSONError):
        return ""


def _write(path: Path, digest: str, subject: Subject, tier: str, checks: Sequence[Check]) -> None:
    """Write the file with the tier of a record, the checks, and who did them when and with what."""
    values = {
        "tier": tier,
        "record": digest,
        "seed": subject.request.seed,
        "checks": [asdict(check) for check in checks],
        "by": subject.request.by,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "verifier": subject.here,
    }
    write_all({verification_path(path): verification_text(values)})


# ---- recomputed --------------------------------------------------------------------------------------------


def _recompute(subject: Subject, _: ProgressCallback) -> list[Check]:
    """Check that a record is consistent, and that it belongs to this version of its scenario."""
    run = subject.run
    values = {name: measure(name, run.scores) for name in ("final_average", "adaptation", "retention")}
    result = ", ".join(f"{name} {'-' if value is None else f'{value:.3f}'}" for name, value in values.items())
    checks = [Check("metrics from its episodes", result, values["final_average"] is not None)]
    name, named = run.record.scenario.id, subject.request.scenario
    if named is not None and without_module(named) != name:  # a slip of the verifier says nothing against it
        return [*checks, Check("what was run", f"it is of {name}, and --scenario names {named}", None)]
    try:
        scenario = subject.scenario
        info = None if subject.strange else subject.resolved.info
    except UnknownNameError as error:
        result = str(error.args[0])
        if named is None:
            result = f"{result.partition('.')[0]}. Name its module: --scenario module:{name}"
        return [*checks, Check("what was run", result, None)]
    except ClbenchError as error:
        return [*checks, Check("what was run", str(error.args[0]), None)]
    checks += [_check_horizons(run.record, scenario), _check_what_was_run(subject, info)]
    return [*checks, _check_simulator(subject), _check_definition(subject)]


def _check_simulator(subject: Subject) -> Check:
    """Check that the simulator moves as it did for the record."""
    recorded, found = subject.run.record.fingerprint.get("rollouts"), subject.here["rollouts"]
    if recorded == found:
        return Check("simulator", "same rollouts as here", True)
    worlds = ", ".join(differences(recorded, found)) or "all worlds"
    return _differs(subject, "simulator", f"the rollouts of {worlds} differ from those here")


def _differs(subject: Subject, name: str, result: str) -> Check:
    """Return the check of a difference, which packages or machines other than the record's may explain."""
    other = [*_made_with(subject, simulator_versions(subject.scenario.tasks)), *_other_machine(subject)]
    return Check(name, "; ".join([result, *other]), None if other else False)


def _check_what_was_run(subject: Subject, info: RunInfo | None) -> Check:
    """Check that the run and its scenario are those of the installed code.

    Args:
        subject: The record.
        info: The run as the installed code does it; None if its method or policy may not be imported. The
            scenario is compared nevertheless.
    """
    record = subject.run.record
    pairs: dict[str, tuple[RunInfo | ScenarioInfo, RunInfo | ScenarioInfo]] = {}
    if info is not None:
        pairs["run"] = record.run, info
    pairs["scenario"] = record.scenario, describe_scenario(subject.learned)
    wrong = [f"{part}.{name}" for part, pair in pairs.items() for name in differences(*map(vars, pair))]
    if info is not None and _lacks_its_curve(subject):
        wrong.append("episodes before the ends of stages")
    if wrong:
        return Check("what was run", f"{', '.join(wrong)} differ from the installed code", False)
    if info is None:
        names = " and ".join(subject.strange)
        unseen = f"{names} is not installed: its settings were not compared with its class"
        return Check("what was run", f"matches the scenario; {unseen}", True)
    return Check("what was run", "matches its class and the scenario", True)


def _lacks_its_curve(subject: Subject) -> bool:
    """Return whether a record has no episodes before the ends of stages, although its method has them.

    The reader takes such a record for one of a method of whole stages.
    """
    protocol = subject.protocol
    if subject.resolved.method.whole_stages or len(protocol.steps) < 2:  # one evaluation, at the end
        return False
    return all(protocol.is_end(row.point) for row in subject.run.record.episode_rows())


def _check_definition(subject: Subject) -> Check:
    """Check that the tasks and questions of the record are those of the installed scenario."""
    recorded = subject.run.record.fingerprint.get("definition")
    if recorded is None:
        return Check("definition", "the record is older than definitions: not compared", True)
    other = other_parts(recorded, subject.here["definition"])
    if other:
        return _differs(subject, "definition", f"{', '.join(other)} differ from the installed code")
    later = [name for name in subject.here["definition"] if name.startswith(LATER) and name not in recorded]
    missing = f"; the record says nothing of {', '.join(later)}: not compared" if later else ""
    return Check("definition", f"tasks and questions are those here{missing}", True)


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
    return Check("ends of episodes", f"failed before the horizon or ran beyond it: {some(wrong)}", False)


# ---- retrained ---------------------------------------------------------------------------------------------


def _retrain(subject: Subject, progress: ProgressCallback) -> list[Check]:
    """Repeat the whole run, on request with its pretraining, and compare the records."""
    before = [_pretrain(subject, progress)] if subject.request.pretrain else []
    if not all(check.passed for check in before):
        return before
    with tempfile.TemporaryDirectory() as folder:
        again = execute(subject.resolved, Path(folder), progress)
    if again.failure:
        return [*before, Check("whole run", f"it failed: {again.failure}", False)]
    wrong = []
    records = [asdict(record) for record in (subject.run.record, again)]
    for part in PARTS:
        theirs, ours = (values[part] for values in records)
        if theirs != ours:
            names = ", ".join(differences(theirs, ours))
            wrong.append(f"{part} ({names})" if names else part)
    if wrong:
        return [*before, Check("whole run", f"repeated, {', '.join(wrong)} differ", False)]
    equal = Check("whole run", f"repeated, equal in {', '.join(PARTS)}", True)
    return [*before, equal, *_check_time(subject, again), _check_origin(subject, again)]


def _check_time(subject: Subject, again: Record) -> list[Check]:
    """Compare the time of a step relative to plain fine-tuning's, on which the relative cost rests."""
    theirs: Any
    ours: Any
    theirs, ours = (record.timing.get("step_ratio") for record in (subject.run.record, again))
    if not is_number(ours):
        return []
    if not is_number(theirs):  # the oldest records lack it, and a forger may leave it out
        return [Check("time of a step", f"not in the record, {ours:.2f} times that of sft here", True)]
    alike = 1 / OTHER_TIME < theirs / ours < OTHER_TIME
    found = f"{theirs:.2f} times that of sft in the record, {ours:.2f} here"
    return [Check("time of a step", found, True if alike else None)]


def _pretrain(subject: Subject, progress: ProgressCallback) -> Check:
    """Pretrain the policy that the run began with, and compare its weights."""
    recorded = subject.run.record.fingerprint.get("pretrained")
    policy = pretrain(subject.scenario, subject.spec.seed, progress)
    with tempfile.TemporaryDirectory() as folder:
        found = pretrained_hash(cached(Path(folder) / "policy", {}, lambda here: save_policy(policy, here)))
    if found != recorded:
        result = f"repeated, it gives the policy {found}; the record began with {recorded}"
        return Check("pretraining", result, False)
    return Check("pretraining", f"repeated, it gives the same policy {found}", True)


def _check_origin(subject: Subject, again: Record) -> Check:
    """Compare what a record says about its software, hardware and method with this repetition."""
    theirs, ours = (_origin(record) for record in (subject.run.record, again))
    wrong = [f"{name} {theirs.get(name)} is {ours.get(name)} here" for name in differences(theirs, ours)]
    if wrong:
        # this machine cannot tell what another one has
        elsewhere = all(name.startswith("hardware ") for name in differences(theirs, ours))
        result = f"the record states what is not so here: {some(wrong)}"
        return Check("origin", result, None if elsewhere else False)
    methods = [record.fingerprint.get("method") for record in (subject.run.record, again)]
    source = [values.get("source") if isinstance(values, dict) else None for values in methods]
    same = "the method's source is the same" if source[0] == source[1] else "the method's source has changed"
    return Check(
        "origin",
        f"versions, instructions and metadata are those here; {same}; the version and commit of clbench, "
        "processor, Python and times cannot be compared",
        True,
    )


def _origin(record: Record) -> dict[str, Any]:
    """Return what a record says about itself that a repetition can confirm."""
    found: dict[str, Any] = {}
    for part, names in ORIGIN.items():
        values = record.fingerprint.get(part)
        entries = values if isinstance(values, dict) else {}
        found |= {f"{part} {name}": entries.get(name) for name in names or sorted(entries)}
    found.pop("versions clbench", None)
    return {**found, "pretrained": record.fingerprint.get("pretrained")}


# ---- the job -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """The outcome of the verification of a record."""

    path: Path
    """Path of the record."""
    checks: list[dict[str, Any]]
    """The checks that were made, each with its name, what it found, and whether the record passed."""
    failure: str | None
    """Why the record did not reach the tier, None if it did."""


def run_verifications(
    paths: Sequence[Path], records: Path, request: Request, workers: int | None, console: Console
) -> list[Outcome]:
    """Verify records, each in its own process."""
    with tempfile.TemporaryDirectory() as folder:
        reports = {path: Path(folder) / f"{number}.json" for number, path in enumerate(paths)}
        jobs = {path: _job(path, records, request, report) for path, report in reports.items()}
        device = "cuda" if any(job.device == "cuda" for job in jobs.values()) else "cpu"
        failed = run_with_bars([*jobs.values()], Processes(workers, device), console)
        return [Outcome(path, _read(reports[path]), failed.get(job)) for path, job in jobs.items()]


def _read(report: Path) -> list[dict[str, Any]]:
    """Return the checks in a report, none if the job died before it wrote one."""
    return json.loads(report.read_text(encoding="utf-8")) if report.exists() else []


def _job(path: Path, records: Path, request: Request, report: Path) -> Job:
    """Return the job that verifies a record; its length and device are known if the record can be read."""
    length, device = 1.0, "cpu"
    try:
        subject = Subject(read_run(records, path, changed=None), request)
        scenario = subject.scenario
        if request.tier != "recomputed":
            device = subject.spec.device
            length += len(scenario.target) * scenario.budget.adaptation_steps
            if not subject.strange and not is_pretrained(scenario, subject.spec.seed):
                length += pretraining_length(scenario)
        if request.tier == "retrained":
            length += run_length(scenario, subject.protocol)
            length += 0.0 if subject.strange else watching_length(subject.resolved.method, scenario)
            length += pretraining_length(scenario) * request.pretrain
    except ClbenchError:
        pass  # the job itself reports the error
    arguments = {"path": path, "records": records, "request": request, "report": report}
    return Job(printable(str(path)), verify_job, arguments, length, device=device)


def verify_job(path: Path, records: Path, request: Request, report: Path, progress: ProgressCallback) -> str:
    """Verify a record, write its checks to `report`, and return its tier with the checks in words."""
    checks = verify(path, records, request, progress)
    report.write_text(json.dumps([asdict(check) for check in checks]), encoding="utf-8")
    marks = {True: "ok ", False: "NOT", None: "?  "}
    # in one line each: a stranger's text must not look like another check
    text = "\n".join(f"  {marks[check.passed]} {check.name}: {printable(check.found)}" for check in checks)
    progress(1.0)
    tier = tier_of(path)
    if not all(check.passed for check in checks):
        raise JobError(f"{tier}\n{text}")
    return f"{tier}\n{text}"
