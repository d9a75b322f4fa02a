"""Online learning: an agent of any library learns a scenario by trial and error, and leaves a record.

The agent brings its own loop: it trains in the environment of one stage after another, and is evaluated after
each, on the same test episodes from the same initial states as every run. Its record has no answers to
questions, no evaluation points within a stage, and no count of optimiser steps. Until the last stage the
record is kept in the cache: an interrupted program loses only the stage that was running.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import packages_distributions, version
from pathlib import Path
from typing import Any

import gymnasium
import torch
from gymnasium.vector import VectorEnv

from clbench.base.cache import cache_folder, cached, hash_of, is_cached
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, WrongTypeError
from clbench.base.lease import Lease
from clbench.base.seeding import seeded
from clbench.base.strict_json import check_json
from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.examiner import episode_row
from clbench.evaluation.players import Agent, acts_on_batches, play
from clbench.learning.trainer import sources
from clbench.records.paths import RECORDS, record_path, stage_folder
from clbench.records.reader import read_record
from clbench.records.record import AnswerRow, Record, RunInfo
from clbench.records.writer import write_record
from clbench.runs.fingerprint import fingerprint
from clbench.runs.spec import describe_scenario
from clbench.spec.identifiers import built_in_methods, check_method_name
from clbench.spec.protocol import Protocol
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.worlds.scenario_env import ScenarioEnv
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv

LOG = logging.getLogger("clbench")

USES = {"demonstrations": "never", "questions": "never", "reference": False, "online": True}
"""`RunInfo.uses` of an agent: it uses no prior data of clbench, and another program trains it."""

_LEASES: dict[Path, Lease] = {}
"""Leases of the runs that this process has begun, by the folder of the unfinished record.

A program trains much longer than it evaluates: it keeps the lease from its first stage until the record is
written or it ends, so that no other program drops or continues the stages of its agent.
"""


def evaluate_agent(
    agent: Agent,
    env: gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any],
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
        agent: Agent after its training in the stage. It observes what `env` returns. Its actions should not
            be random; NaN counts as 0.
        env: Environment in which the agent was trained: `gymnasium.make(ID, stage=k)`. It gives the scenario,
            the stage, the format of instructions and the number of environment steps.
        method: Name of the agent's row on the leaderboard, for example "me/sac".
        seed: Seed of the run; it chooses the initial states, the same for all methods.
        steps: Number of environment steps in the stage, if they were not taken in `env` itself.
        settings: Settings of the agent that readers should know, as JSON; the same in all stages.
        batched: Whether `predict` gets the observations of 40 episodes at once, arrays (40, ...) by name, and
            returns actions (40, A); several times faster. By default it does for agents of Stable-Baselines3
            that read tokens; others get one observation at a time, and play one episode after another.
        records: Folder of the records.

    Returns:
        The record so far. Its scores come from test episodes: base no choice on them.

    Raises:
        WrongTypeError: `env` is not an environment of a scenario, or `agent` cannot act.
        InputError: Another stage comes next, the targets are in another order, a record exists already,
            another program evaluates an agent of this name and seed, an action has the wrong shape, or the
            name, the seed, the steps or the settings are invalid.
        LeaseLostError: Another program took the run over, because this one did not answer.
    """
    world = getattr(env, "unwrapped", None)
    if not isinstance(world, ScenarioEnv | ScenarioVectorEnv):
        raise WrongTypeError(
            f"{env} does not belong to a scenario: make it with gymnasium.make('clbench/Fetch-v1', stage=0)."
        )
    if world.stage is None:
        raise InputError(
            f"{env} goes through all stages: make an environment of a single stage, for example with "
            f"gymnasium.make({world.scenario.id!r}, stage=0)."
        )
    if world.order:
        raise InputError(f"{env} has its targets in order {world.order}: agents are scored in order 0.")
    if not (callable(agent) or hasattr(agent, "predict")):
        raise WrongTypeError(
            f"{type(agent).__name__} is not an agent: it has no predict() and cannot be called."
        )
    if steps is not None and (type(steps) is not int or steps < 0):
        raise InputError(f"steps must be a whole number from 0, not {steps!r}.")
    run = StagedRun(world.scenario, method, seed, Path(records))
    begin = time.perf_counter()
    trained = begin - world.begun_at if steps is None and world.begun_at is not None else None
    record = run.begin(world.stage, _plain(settings or {}), USES, agent)
    form = world.instruction
    if batched is None:
        batched = acts_on_batches(agent, form)
    with seeded("online evaluation", seed, world.stage):
        run.report(
            record, world.stage, lambda trials: play(agent, world.scenario, trials, seed, form, batched)
        )
    run.count(record, world.stage, steps if steps is not None else world.steps_taken or None)
    run.time(record, trained, time.perf_counter() - begin)
    run.keep(record, world.stage)
    return record


def next_stage(scenario: str, *, method: str, seed: int = 0, records: Path | str = RECORDS) -> int:
    """Return the stage that `evaluate_agent` expects next: an interrupted program continues with it.

    Args:
        scenario: Gymnasium id of the scenario.
        method: Name of the agent's row on the leaderboard.
        seed: Seed of the run.
        records: Folder of the records.

    Returns:
        0 if no stage has been evaluated, the last stage plus one if there is a record.
    """
    return StagedRun(load_scenario(scenario), method, seed, Path(records)).next


@dataclass(frozen=True)
class StagedRun:
    """A run whose policy another program trains, an agent or a policy that is served.

    It is evaluated stage by stage; its record is in the cache until the last one.
    """

    scenario: Scenario
    """Scenario of the run."""
    method: str
    """Name of its row on the leaderboard."""
    seed: int
    """Seed of the run."""
    records: Path
    """Folder of the records."""

    def __post_init__(self) -> None:
        if not self.scenario.retained:
            raise InputError(
                f"{self.scenario.id} retains nothing: agents are evaluated from stage 0 on, which trains the "
                "retained skills. Choose a scenario with retained skills."
            )
        check_method_name(self.method)
        if self.method in built_in_methods():
            raise InputError(
                f"{self.method!r} is a method of clbench: give your row its own name, "
                f"for example 'me/{self.method}'."
            )
        if type(self.seed) is not int or self.seed < 0:
            raise InputError(f"seed must be a whole number from 0, not {self.seed!r}.")

    @property
    def last(self) -> int:
        """Number of the last stage."""
        return len(self.scenario.target)

    @cached_property
    def path(self) -> Path:
        """Path of the finished record."""
        return record_path(self.records, self.scenario.id, self.method, self.seed)

    @cached_property
    def folder(self) -> Path:
        """Folder of the unfinished record in the cache."""
        return cache_folder() / "online" / hash_of(str(self.path.resolve()))

    def _stage_folder(self, stage: int) -> Path:
        return stage_folder(self.folder, stage)

    @cached_property
    def _sources(self) -> dict[str, Any]:
        scenario = dataclasses.asdict(describe_scenario(self.scenario))
        return {"scenario": scenario, **sources(self.scenario, self.seed)}

    def _inputs(self, stage: int) -> dict[str, Any]:
        """Return everything that the unfinished record depends on, except the agent."""
        return {"method": self.method, "seed": self.seed, "stage": stage, **self._sources}

    def done(self) -> int | None:
        """Return the last stage that this version of the code evaluated, None if there is none."""
        stages = range(self.last, -1, -1)
        return next((k for k in stages if is_cached(self._stage_folder(k), self._inputs(k))), None)

    @property
    def next(self) -> int:
        """The stage that is evaluated next; the last one plus one if there is a record."""
        if self.path.exists():
            return self.last + 1
        done = self.done()
        return 0 if done is None else done + 1

    def __str__(self) -> str:
        return f"{self.method}, seed {self.seed}, on {self.scenario.id}"

    def _own(self) -> None:
        """Take the run for this process, unless it has it."""
        if self.folder not in _LEASES:
            lease = Lease(self.folder)
            while not lease.take():
                if (owner := lease.owner) is not None:
                    raise InputError(
                        f"{self} belongs to {owner}, which is evaluating its stages: choose another name or "
                        "seed, or wait until that process has ended."
                    )
                time.sleep(0.1)  # the lease of a dead process on another machine is watched for a while
            _LEASES[self.folder] = lease
        _LEASES[self.folder].check()

    def begin(self, stage: int, settings: dict[str, Any], uses: Mapping[str, Any], agent: Any) -> Record:
        """Take the run for this process, and return the record of the earlier stages.

        Args:
            stage: Stage that is evaluated.
            settings: Settings that readers should know, the same in all stages.
            uses: `RunInfo.uses`, the same in all stages.
            agent: The agent or policy.

        Raises:
            InputError: Another stage comes next, settings or uses differ from those in stage 0, or another
                process has taken the run.
            LeaseLostError: Another process took the run over.
        """
        name = str(self)
        if self.path.exists():
            raise InputError(
                f"{name} has a record already, {self.path}, which is never edited: "
                "choose another seed or name, or remove it."
            )
        self._own()
        done = self.done()
        if stage == 0:
            if done is not None:
                LOG.warning("%s starts over: its evaluations up to stage %d are dropped.", name, done)
                shutil.rmtree(self.folder, ignore_errors=True)
            return self._new_record(settings, uses, agent)
        if done is None:
            raise InputError(
                f"Stage 0 of {name} comes first, not {stage}: "
                "this version of clbench has not evaluated any stage."
            )
        if stage != done + 1:
            raise InputError(
                f"Stage {done + 1} of {name} comes next, not {stage}: it was evaluated up to stage {done}. "
                "Evaluating stage 0 starts over."
            )
        record = read_record(self._stage_folder(done) / "record.json")
        if record.run.settings != settings:
            raise InputError(
                f"The settings of {name} are {settings}, but were {record.run.settings} in stage 0."
            )
        if record.run.uses != uses:
            raise InputError(
                f"{name} was begun as another kind of run: evaluate all stages of agents that learn by trial "
                "with evaluate_agent(), and all stages of served policies with `clbench score`."
            )
        return record

    def _new_record(self, settings: dict[str, Any], uses: Mapping[str, Any], agent: Any) -> Record:
        run = RunInfo(
            scenario=self.scenario.id,
            method=self.method,
            seed=self.seed,
            device=str(getattr(agent, "device", "unknown")),
            split="test",
            settings=settings,
            changes={},
            uses=dict(uses),
        )
        record = Record("success", run, describe_scenario(self.scenario))
        record.fingerprint = {**fingerprint(self.scenario), "method": _describe(agent)}
        record.timing = {"started": datetime.now(UTC).isoformat(timespec="seconds"), "stages": []}
        network = getattr(agent, "policy", None)
        if isinstance(network, torch.nn.Module):
            record.costs.parameters = sum(parameter.numel() for parameter in network.parameters())
        return record

    def report(self, record: Record, stage: int, play: Callable[[list[Trial]], list[Episode]]) -> None:
        """Add the episodes of every run at the end of a stage, and answers to no questions."""
        protocol = Protocol.of(self.scenario)
        point = protocol.end(stage)  # in optimiser steps, as if a method had trained
        trials = [(self.scenario.task(key.task), key.split, key.number) for key in protocol.episodes(point)]
        for episode in play(trials):
            record.add_episode(episode_row(point, episode))
        for kind in resolve(self.scenario.questions):
            record.add_answers(AnswerRow(*point, kind.name, 0, 0))

    def count(self, record: Record, stage: int, steps: int | None) -> None:
        """Add the environment steps of a stage."""
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
        """Write the record: to its final path after the last stage, which ends the run, to the cache before.

        Raises:
            LeaseLostError: Another process took the run over.
        """
        _LEASES[self.folder].check()
        if stage == self.last:
            write_record(record, self.path)
            shutil.rmtree(self.folder, ignore_errors=True)
            _LEASES.pop(self.folder).release()
            return
        folder = self._stage_folder(stage)
        cached(folder, self._inputs(stage), lambda partial: write_record(record, partial / "record.json"))
        if stage:
            shutil.rmtree(self._stage_folder(stage - 1), ignore_errors=True)


def _describe(agent: Any) -> dict[str, Any]:
    """Return the class of an agent and the version of its package, None without a package."""
    kind = type(agent)
    packages = packages_distributions().get(kind.__module__.partition(".")[0], [])
    return {
        "class": f"{kind.__module__}:{kind.__qualname__}",
        "version": version(packages[0]) if packages else None,
    }


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings in the form of a record.

    Raises:
        InputError: JSON cannot hold the settings.
    """
    try:
        values: dict[str, Any] = json.loads(json.dumps(dict(settings), allow_nan=False))
        check_json(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"A record cannot hold the settings: {error}") from error
    return values
