"""Runs whose policy another program trains: agents that learn online, and served policies.

Each stage is evaluated on the same test episodes with the same initial states as in every run. The records
have no answers to questions, no evaluation points within a stage, and no count of optimiser steps. Until the
last stage ends, the record is kept beside its final path: an interrupted program loses only the stage that
was running.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, WrongTypeError
from clbench.base.lease import Lease, LeaseLostError
from clbench.base.seeding import seeded
from clbench.base.strict_json import check_json
from clbench.data.demonstrations import simulator_versions
from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.examiner import episode_row
from clbench.evaluation.players import Agent, TrainingEnv, acts_on_batches, play, training_of
from clbench.records.fingerprints import other_parts, other_versions
from clbench.records.paths import RECORDS, record_path
from clbench.records.reader import RecordError, UnreadableRecordError, read_record
from clbench.records.record import ONLINE_USES, AnswerRow, Record, RunInfo
from clbench.records.writer import write_record
from clbench.runs.fingerprint import describe_agent, fingerprint
from clbench.runs.spec import describe_scenario
from clbench.runs.stages import machine_needed
from clbench.spec.fields import is_whole, whole_number
from clbench.spec.identifiers import built_in_methods, check_method_name
from clbench.spec.protocol import FIRST_TUNING_SEED, LARGEST_SEED, Protocol, ScoredSplit
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario

LOG = logging.getLogger("clbench")

UNFINISHED = ".unfinished"
"""Suffix after .json in the name of an unfinished record, which lacks stages and does not count yet."""

_LEASES: dict[Path, Lease] = {}
"""Leases of the runs that this process has begun, by the path of the unfinished record.

A program trains much longer than it evaluates. It therefore keeps the lease from its first stage until it
ends or the record is written, so that no other program drops or continues the stages of its agent.
"""


def evaluate_agent(
    agent: Agent,
    env: TrainingEnv,
    *,
    method: str,
    seed: int = 0,
    steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    batched: bool | None = None,
    records: Path | str = RECORDS,
) -> Record:
    """Evaluate an agent at the end of a stage, and write the record after the last stage.

    Evaluate each stage once and in order, from stage 0. Evaluating stage 0 again starts over.

    Args:
        agent: Agent after its training in the stage. It gets the observations that `env` returns without its
            wrappers. Its actions should not be random; NaN counts as 0.
        env: Environment in which the agent was trained: `gymnasium.make(ID, stage=k)`, or a vectorised one
            from Gymnasium or Stable-Baselines3. It gives the scenario, the stage, the format of instructions
            and the number of environment steps.
        method: Name of the agent's row on the leaderboard, for example "me/sac".
        seed: Seed of the run; it chooses the initial states, the same for all methods. From 100 on,
            validation episodes are played.
        steps: Number of environment steps in the stage, if they were not taken in `env` itself.
        settings: Settings of the agent that readers should know, as JSON; the same in all stages.
        batched: Whether `predict` gets the observations of 40 episodes at once, as arrays (40, ...) by name,
            and returns actions (40, A); several times faster. By default, agents from Stable-Baselines3 that
            read tokens do; others get one observation at a time, and play one episode after another.
        records: Folder of the records.

    Returns:
        The record so far. Base choices on seeds from 100 on, never on test episodes.

    Raises:
        WrongTypeError: `env` is not an environment of a scenario, or `agent` cannot act.
        InputError: Another stage comes next, the targets are in another order, a record exists already,
            another program evaluates an agent of this name and seed, earlier stages had another version of
            the scenario or its simulator, an action has the wrong shape, an agent of Stable-Baselines3 was
            trained with other spaces or normalised observations, or the name, the seed, the steps or the
            settings are invalid.
        RecordError: The record of the earlier stages cannot be read.
        LeaseLostError, MachineError: The run was taken over, or its lease removed; no record can be written.
    """
    training = training_of(env)
    scenario, stage = training.scenario, training.stage
    if stage is None:
        raise InputError(
            f"{env} is not of a single stage: make an environment that is, for example with "
            f"gymnasium.make({scenario.id!r}, stage=0)."
        )
    if training.order:
        raise InputError(f"{env} has its targets in order {training.order}: agents are scored in order 0.")
    if not (callable(agent) or hasattr(agent, "predict")):
        raise WrongTypeError(
            f"{type(agent).__name__} is not an agent: it has no predict() and cannot be called."
        )
    stage, steps = int(stage), None if steps is None else whole_number("steps", steps, 0)
    run = StagedRun(scenario, method, seed, Path(records), ONLINE_USES)
    begin = time.perf_counter()
    trained = begin - training.begun_at if steps is None and training.begun_at is not None else None
    record = run.begin(stage, _checked_settings(settings or {}), agent, again=stage == 0)
    if batched is None:
        batched = acts_on_batches(agent, training.instruction)
    with seeded("online evaluation", seed, stage):
        episodes = play(agent, scenario, run.trials(stage), seed, training.instruction, batched)
    run.report(record, stage, episodes)
    run.count(record, stage, steps if steps is not None else training.steps or None, agent)
    run.time(record, trained, time.perf_counter() - begin)
    run.keep(record, stage)
    return record


def next_stage(scenario: str, *, method: str, seed: int = 0, records: Path | str = RECORDS) -> int:
    """Return the stage that `evaluate_agent` expects next, with which an interrupted program continues.

    Args:
        scenario: Gymnasium id of the scenario.
        method: Name of the agent's row on the leaderboard.
        seed: Seed of the run.
        records: Folder of the records.

    Returns:
        0 if no stage has been evaluated, the last stage plus one if there is a record.

    Raises:
        InputError: The record is of a served policy, or its scenario or simulator is another version.
        RecordError: The record cannot be read.
    """
    run = StagedRun(load_scenario(scenario), method, seed, Path(records), ONLINE_USES)
    return run.next_after(run.kept())


@dataclass(frozen=True)
class StagedRun:
    """A run whose policy is trained by another program: an agent or a served policy.

    It is evaluated stage by stage. Its record so far determines which stage comes next.
    """

    scenario: Scenario
    """Scenario of the run."""
    method: str
    """Name of its row on the leaderboard."""
    seed: int
    """Seed of the run."""
    records: Path
    """Folder of the records."""
    uses: Mapping[str, Any]
    """`RunInfo.uses`: the kind of run."""

    def __post_init__(self) -> None:
        if not self.scenario.retained:
            raise InputError(
                f"{self.scenario.id} has no retained skills. The evaluation of agents and of served policies "
                "begins with stage 0, on retained skills: choose a scenario that has some."
            )
        check_method_name(self.method)
        if ":" in self.method:
            raise InputError(
                f"{self.method!r} is the name of a class that clbench imports: give your row a name of its "
                "own, for example 'me/lora'."
            )
        if self.method in built_in_methods():
            raise InputError(
                f"{self.method!r} is a method of clbench: give your row its own name, "
                f"for example 'me/{self.method}'."
            )
        if not is_whole(self.seed) or not 0 <= self.seed <= LARGEST_SEED:
            raise InputError(f"seed must be a whole number from 0 to {LARGEST_SEED}, not {self.seed!r}.")
        object.__setattr__(self, "seed", int(self.seed))  # no record holds a number of NumPy

    @property
    def last(self) -> int:
        """Number of the last stage."""
        return len(self.scenario.target)

    @property
    def split(self) -> ScoredSplit:
        """Split that is scored. Tuning seeds avoid "test": its wordings are the same for all seeds."""
        return "validation" if self.seed >= FIRST_TUNING_SEED else "test"

    @cached_property
    def path(self) -> Path:
        """Path of the finished record."""
        return record_path(self.records.absolute(), self.scenario.id, self.method, self.seed)

    @property
    def unfinished(self) -> Path:
        """Path of the record until its last stage has been evaluated."""
        return self.path.with_name(self.path.name + UNFINISHED)

    @cached_property
    def _fingerprint(self) -> dict[str, Any]:
        return fingerprint(self.scenario)

    def __str__(self) -> str:
        return f"{self.method}, seed {self.seed}, on {self.scenario.id}"

    def kept(self, stale: bool = False) -> Record | None:
        """Return the record so far, None if no stage has been evaluated.

        Args:
            stale: Whether to return stages of another version of the scenario or its simulator, too, and None
                for a damaged file, because the run starts over.

        Raises:
            InputError: The record is of another kind of run, or of another version and not finished.
            RecordError: The file is damaged.
        """
        finished = self.path.exists()
        path = self.path if finished else self.unfinished
        if not path.exists():
            return None
        try:
            record = read_record(path)
        except RecordError as error:
            if finished or isinstance(error, UnreadableRecordError):
                raise
            if not stale:
                hint = "Evaluate all stages again (`clbench score` needs --restart), or remove the file."
                raise RecordError(f"{error} {hint}") from error
            LOG.warning("%s starts over: its unfinished record is damaged. %s", self, error)
            return None
        if record.run.uses != self.uses:
            raise InputError(
                f"{path} was begun as another kind of run: evaluate agents that learn online with "
                "evaluate_agent(), and served policies with `clbench score`, each under its own name."
            )
        if not (finished or stale):
            self._check_version(record)
        return record

    def _check_version(self, record: Record) -> None:
        """Refuse stages that were evaluated with another version of the scenario or its simulator."""
        then, now = record.fingerprint, self._fingerprint
        other = [
            *other_parts(vars(record.scenario), vars(describe_scenario(self.scenario))),
            *other_parts(then.get("definition"), now["definition"]),
            *other_parts(then.get("rollouts"), now["rollouts"]),
        ]
        if not other:
            return
        changed = other_versions(then.get("versions"), simulator_versions(self.scenario.tasks))
        versions = [f", {one} now" for one in changed]
        raise InputError(
            f"Stage {self.next_after(record) - 1} of {self} was evaluated with another version of the "
            f"scenario or its simulator: {', '.join(other)} differ{''.join(versions)}. Restore that version, "
            "evaluate all stages again (`clbench score` needs --restart), or delete the stages so far: "
            f"{self.unfinished}."
        )

    def next_after(self, record: Record | None) -> int:
        """Return the stage that follows those in a record; the last stage plus one if it has all."""
        return 0 if record is None else 1 + max(record.episodes["stage"], default=-1)

    def check_unfinished(self) -> None:
        """Refuse to evaluate a stage of a run that has a record, with an `InputError`."""
        if self.path.exists():
            told = f"{self} already has a record, {self.path}, which is never edited"
            raise InputError(f"{told}: choose another seed or name, or delete the record.")

    def record_before(self, stage: int, again: bool) -> Record | None:
        """Return the record so far, after checking that a stage comes next or has been evaluated.

        Args:
            stage: Stage to evaluate.
            again: Whether to evaluate a stage again; stage 0 also replaces stages of other versions.

        Raises:
            InputError: There is no such stage, or an earlier one comes next; also as for `kept`.
            RecordError: The file is damaged.
        """
        if not is_whole(stage) or not 0 <= stage <= self.last:
            raise InputError(f"{self.scenario.id} has stages 0 to {self.last}, not {stage!r}.")
        record = self.kept(stale=again and stage == 0)
        following = self.next_after(record)
        if stage > following:
            found = "does not exist" if record is None else f"ends with stage {following - 1}"
            message = f"Stage {following} of {self} comes next, not {stage}"
            raise InputError(f"{message}: {self.unfinished} {found}.")
        return record

    def _own(self) -> None:
        """Take the lease of the run, unless this process already has it."""
        if self.unfinished not in _LEASES:
            lease = Lease(self.unfinished)
            while not lease.take():
                if (owner := lease.owner) is not None:
                    told = f"{self} belongs to {owner}, which is evaluating its stages"
                    raise InputError(f"{told}: choose another name or seed, or wait until it is done.")
                time.sleep(1.0)  # the lease of a dead process on another machine is watched for a while
            _LEASES[self.unfinished] = lease
        self._check_lease()

    def _check_lease(self) -> None:
        """Refuse to go on without the lease; a lost one is given up, so that the next call can take it."""
        try:
            _LEASES[self.unfinished].check()
        except LeaseLostError:
            self._release()
            raise

    def begin(self, stage: int, settings: dict[str, Any] | None, agent: Any, again: bool) -> Record:
        """Take the lease of the run, and return the record of the earlier stages.

        Args:
            stage: Stage to evaluate.
            settings: Settings that readers should know, the same in all stages; None takes those of stage 0.
            agent: The agent or policy.
            again: Whether to drop an evaluated stage and all later ones; earlier ones stay.

        Raises:
            InputError: Another stage comes next, settings differ from those in stage 0, or another process
                has taken the run; also as for `record_before`.
            RecordError: As for `record_before`.
            LeaseLostError: The run is no longer this process's; the next call takes it again if it is free.
        """
        owned = self.unfinished in _LEASES
        try:
            if not self.path.exists():
                self._own()
            return self._begun(stage, settings, agent, again)
        except BaseException:
            if not owned:
                self._release()
            raise

    def _begun(self, stage: int, settings: dict[str, Any] | None, agent: Any, again: bool) -> Record:
        self.check_unfinished()  # also for a process that has just finished the run
        record = self.record_before(stage, again)
        following = self.next_after(record)
        if stage < following and not again:
            raise InputError(
                f"Stage {following} of {self} comes next, not {stage}: the last evaluated stage is "
                f"{following - 1}."
            )
        if stage == 0:
            if record is not None:
                LOG.warning("%s starts over: its stages 0 to %d are dropped.", self, following - 1)
            return self._new_record(settings or {}, agent)
        assert record is not None  # some stage precedes
        if settings not in (None, record.run.settings):
            before = record.run.settings
            raise InputError(
                f"The settings of {self} are {settings}, but were {before} in stage 0: keep them."
            )
        if stage < following:
            LOG.warning("%s: its stages %d to %d are dropped.", self, stage, following - 1)
            record.drop_stages(stage)
        return record

    def _new_record(self, settings: dict[str, Any], agent: Any) -> Record:
        run = RunInfo(
            scenario=self.scenario.id,
            method=self.method,
            seed=self.seed,
            device=str(getattr(agent, "device", "unknown")),
            split=self.split,
            settings=settings,
            changes={},
            uses=dict(self.uses),
        )
        record = Record("success", run, describe_scenario(self.scenario))
        record.fingerprint = {**self._fingerprint, "method": describe_agent(agent)}
        record.timing = {"started": datetime.now(UTC).isoformat(timespec="seconds"), "stages": []}
        return record

    @cached_property
    def _protocol(self) -> Protocol:
        """The protocol that every run follows."""
        return describe_scenario(self.scenario).protocol(self.split)

    def trials(self, stage: int) -> list[Trial]:
        """Return the episodes that every run plays at the end of a stage."""
        keys = self._protocol.episodes(self._protocol.end(stage))
        return [Trial(self.scenario.task(key.task), key.split, key.number) for key in keys]

    def report(self, record: Record, stage: int, episodes: Iterable[Episode]) -> None:
        """Add the outcomes of the trials of a stage, and answers to no questions."""
        point = self._protocol.end(stage)  # in optimiser steps, as if a method had trained
        for episode in episodes:
            record.add_episode(episode_row(point, episode))
        for kind in resolve(self.scenario.questions):
            record.add_answers(AnswerRow(*point, kind.name, 0, 0))

    def count(self, record: Record, stage: int, steps: int | None, agent: Any) -> None:
        """Add the environment steps of a stage, and count the parameters again: networks may grow."""
        network = getattr(agent, "policy", None)
        if isinstance(network, torch.nn.Module):
            record.costs.parameters = sum(parameter.numel() for parameter in network.parameters())
        record.diagnostics[str(stage)] = {"environment_steps": steps}
        each = [found["environment_steps"] for found in record.diagnostics.values()]
        record.costs.environment_steps = None if None in each else sum(each)

    def time(self, record: Record, trained: float | None, evaluated: float) -> None:
        """Add the seconds of a stage: of training, None if they are not known, and of evaluation."""
        training = None if trained is None else round(trained, 2)
        record.timing["stages"].append({"training": training, "evaluation": round(evaluated, 2)})
        parts = [seconds for timing in record.timing["stages"] for seconds in timing.values()]
        record.timing["seconds"] = None if None in parts else round(sum(parts), 2)

    def keep(self, record: Record, stage: int) -> None:
        """Write the record: beside its final path, or after the last stage to that path, which ends the run.

        Raises:
            LeaseLostError, MachineError: As for `begin`, or it cannot be written. The stage is not kept.
        """
        self._check_lease()
        with machine_needed():
            write_record(record, self.unfinished if stage < self.last else self.path)
        if stage == self.last:
            self.unfinished.unlink(missing_ok=True)
            self._release()

    def _release(self) -> None:
        if lease := _LEASES.pop(self.unfinished, None):
            lease.release()


def _checked_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as a record holds them.

    Raises:
        InputError: JSON cannot hold the settings.
    """
    try:
        values: dict[str, Any] = json.loads(json.dumps(dict(settings), allow_nan=False))
        check_json(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"A record cannot hold the settings: {error}") from error
    return values
