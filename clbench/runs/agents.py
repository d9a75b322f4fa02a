"""Online use: an agent of any library learns a scenario by trial, and leaves a record as a run does.

The loop is the agent's: it trains in the environment of one stage after another, and is evaluated after
each. It meets the test episodes of every run, from the same initial states. What it cannot have, as answers
to questions, points before the end of a stage, or a count of its optimiser steps, is missing in the record.
Until the last stage the record waits in the cache: who is interrupted loses the stage that he was in.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import packages_distributions, version
from pathlib import Path
from typing import Any, TypeAlias
from typing import Protocol as Interface

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from clbench.base.cache import cache_folder, cached, hash_of, is_cached
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, WrongTypeError
from clbench.base.seeding import seeded
from clbench.base.strict_json import check_json
from clbench.evaluation.examiner import episode_row
from clbench.evaluation.rollouts import Episode, Trial, start_of
from clbench.learning.trainer import sources
from clbench.records.paths import RECORDS, record_path
from clbench.records.reader import read_record
from clbench.records.record import Record, RunInfo, append_row
from clbench.records.writer import write_record
from clbench.runs.fingerprint import fingerprint
from clbench.runs.spec import describe_scenario
from clbench.spec.identifiers import built_in_methods, check_method_name
from clbench.spec.protocol import Protocol
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.worlds.lanes import Lanes
from clbench.worlds.scenario_env import Observation, ScenarioEnv
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv
from clbench.worlds.schedule import InstructionFormat, observed

LOG = logging.getLogger("clbench")

USES = {"demonstrations": "never", "questions": "never", "reference": False, "online": True}
"""What the record of an agent says of prior data: it has none of ours, and learns by trial."""


class Predictor(Interface):
    """What Stable-Baselines3's algorithms are, and anything that acts as they do."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Return an action (A,), and what goes with the next observation as `state`; nothing if None."""
        ...


Agent: TypeAlias = Predictor | Callable[[Observation], Any]
"""What is evaluated: it predicts, or is called with an observation and returns an action (A,)."""


def evaluate_agent(
    agent: Agent,
    env: gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any],
    *,
    method: str,
    seed: int = 0,
    steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    records: Path | str = RECORDS,
) -> Record:
    """Evaluate an agent at the end of a stage; after the last stage the record is written.

    Stages are evaluated in their order, from 0, and each once. To evaluate stage 0 again begins anew.

    Args:
        agent: As it is after the stage. It is asked for the action of one observation at a time, as `env`
            gives them, acts for a whole episode before the next begins, and should not choose at random. An
            action that is no number stands still.
        env: What it was trained in: `gymnasium.make(ID, stage=k)`. From it come the scenario, the stage, the
            form of instructions, and how many steps it took.
        method: Name of the row on the board, as "me/sac".
        seed: Of the run; it chooses the initial states, the same for all methods.
        steps: Environment steps of the stage, if they were not taken in `env` itself; 0 if none were.
        settings: What a reader should know of how it learns, as JSON; the same in all stages.
        records: Folder of the records.

    Returns:
        The record so far. Its scores are of test episodes: nothing may be chosen on them.

    Raises:
        TypeError: `env` is of no scenario, or `agent` is nothing that acts.
        ValueError: The stage has no turn now, its targets are in another order, there is a record already, an
            action has another shape than the action space, or a name, the seed, the steps or the settings are
            refused.
    """
    world = env.unwrapped
    if not isinstance(world, ScenarioEnv | ScenarioVectorEnv):
        raise WrongTypeError(
            f"{env} is not of a scenario: make it as gymnasium.make('clbench/Fetch-v0', stage=0)."
        )
    if world.stage is None:
        raise InputError(
            f"{env} goes through all stages: make one that stays in a stage, as "
            f"gymnasium.make({world.scenario.id!r}, stage=0)."
        )
    if world.order:
        raise InputError(f"{env} has its targets in order {world.order}: agents are scored in order 0.")
    if not (callable(agent) or hasattr(agent, "predict")):
        raise WrongTypeError(f"A {type(agent).__name__} is no agent: it can neither predict nor be called.")
    if steps is not None and (type(steps) is not int or steps < 0):
        raise InputError(f"steps must be a whole number from 0, not {steps!r}.")
    run = _OnlineRun(world.scenario, method, seed, Path(records))
    begin = time.perf_counter()
    trained = begin - world.begun_at if steps is None and world.begun_at is not None else None
    record = run.begin(world.stage, _plain(settings or {}), agent)
    with seeded("online evaluation", seed, world.stage), closing(Lanes(1)) as lanes:
        player = _Player(agent, lanes, seed, world.instruction)
        run.report(record, world.stage, player.play)
    taken = steps if steps is not None else world.steps_taken or None
    run.count(record, world.stage, taken, trained, time.perf_counter() - begin)
    run.keep(record, world.stage)
    return record


def next_stage(scenario: str, *, method: str, seed: int = 0, records: Path | str = RECORDS) -> int:
    """Return the stage that `evaluate_agent` expects next: where an interrupted run goes on.

    Args:
        scenario: Gymnasium id of the scenario.
        method: Name of the row on the board.
        seed: Of the run.
        records: Folder of the records.

    Returns:
        0 if there is nothing yet, one more than the last stage if there is a record.
    """
    run = _OnlineRun(load_scenario(scenario), method, seed, Path(records))
    if run.path.exists():
        return run.last + 1
    done = run.done()
    return 0 if done is None else done + 1


@dataclass(frozen=True)
class _OnlineRun:
    """The run of an agent, and where its record is."""

    scenario: Scenario
    method: str
    seed: int
    records: Path

    def __post_init__(self) -> None:
        if not self.scenario.retained:
            raise InputError(
                f"{self.scenario.id} retains nothing: agents are evaluated after stage 0, which trains the "
                "retained skills, and here there is none. Choose a scenario with retained skills."
            )
        check_method_name(self.method)
        if self.method in built_in_methods():
            raise InputError(
                f"{self.method!r} is a method of clbench: give the agent a name of its own, "
                f"as 'me/{self.method}'."
            )
        if type(self.seed) is not int or self.seed < 0:
            raise InputError(f"seed must be a whole number from 0, not {self.seed!r}.")

    @property
    def last(self) -> int:
        """The last stage."""
        return len(self.scenario.target)

    @cached_property
    def path(self) -> Path:
        """Where the record will lie."""
        return record_path(self.records, self.scenario.id, self.method, self.seed)

    @cached_property
    def folder(self) -> Path:
        """Where it waits for the last stage."""
        return cache_folder() / "online" / hash_of(str(self.path.resolve()))

    def _stage_folder(self, stage: int) -> Path:
        return self.folder / f"stage-{stage}"

    @cached_property
    def _sources(self) -> dict[str, Any]:
        scenario = dataclasses.asdict(describe_scenario(self.scenario))
        return {"scenario": scenario, **sources(self.scenario, self.seed)}

    def _inputs(self, stage: int) -> dict[str, Any]:
        """Return all that what waits depends on, but for the agent."""
        return {"method": self.method, "seed": self.seed, "stage": stage, **self._sources}

    def done(self) -> int | None:
        """Return the last stage that was evaluated by this version of the code, None if there is none."""
        stages = range(self.last, -1, -1)
        return next((k for k in stages if is_cached(self._stage_folder(k), self._inputs(k))), None)

    def begin(self, stage: int, settings: dict[str, Any], agent: Agent) -> Record:
        """Return the record of the stages before.

        Raises:
            ValueError: It is not the turn of this stage, or the settings are not those of stage 0.
        """
        name = f"{self.method}, seed {self.seed}, on {self.scenario.id}"
        if self.path.exists():
            raise InputError(
                f"{name} has a record already, {self.path}, which is never edited: "
                "choose another seed or name, or remove it."
            )
        done = self.done()
        if stage == 0:
            if done is not None:
                LOG.warning("%s begins anew: what was evaluated up to stage %d is dropped.", name, done)
                shutil.rmtree(self.folder, ignore_errors=True)
            return self._new_record(settings, agent)
        if done is None:
            raise InputError(
                f"Stage 0 of {name} comes first, not {stage}: "
                "this version of clbench has evaluated none of it."
            )
        if stage != done + 1:
            raise InputError(
                f"Stage {done + 1} of {name} comes next, not {stage}: it was evaluated up to stage {done}. "
                "To evaluate stage 0 begins anew."
            )
        record = read_record(self._stage_folder(done) / "record.json")
        if record.run.settings != settings:
            raise InputError(
                f"The settings of {name} are {settings}, but were {record.run.settings} in stage 0."
            )
        return record

    def _new_record(self, settings: dict[str, Any], agent: Agent) -> Record:
        run = RunInfo(
            scenario=self.scenario.id,
            method=self.method,
            seed=self.seed,
            device=str(getattr(agent, "device", "unknown")),
            split="test",
            settings=settings,
            changes={},
            uses=dict(USES),
        )
        record = Record("success", run, describe_scenario(self.scenario))
        record.fingerprint = {**fingerprint(self.scenario), "method": _describe(agent)}
        record.timing = {"started": datetime.now(UTC).isoformat(timespec="seconds"), "stages": []}
        network = getattr(agent, "policy", None)
        if isinstance(network, torch.nn.Module):
            record.costs.parameters = sum(parameter.numel() for parameter in network.parameters())
        return record

    def report(self, record: Record, stage: int, play: Callable[[Trial], Episode]) -> None:
        """Add the episodes that every run has at the end of a stage, and that no question was asked."""
        protocol = Protocol.of(self.scenario)
        point = protocol.end(stage)  # in optimiser steps, as if a method had trained
        for key in protocol.episodes(point):
            trial = self.scenario.task(key.task), key.split, key.number
            append_row(record.episodes, episode_row(point, play(trial)))
        for kind in resolve(self.scenario.questions):
            append_row(record.answers, (*point, kind.name, 0, 0))

    def count(
        self, record: Record, stage: int, steps: int | None, trained: float | None, evaluated: float
    ) -> None:
        """Add what a stage cost: environment steps, and seconds of training and of evaluation."""
        record.diagnostics[str(stage)] = {"environment_steps": steps}
        each = [told["environment_steps"] for told in record.diagnostics.values()]
        record.costs.environment_steps = None if None in each else sum(each)
        training = None if trained is None else round(trained, 2)
        record.timing["stages"].append({"training": training, "evaluation": round(evaluated, 2)})
        parts = [seconds for one in record.timing["stages"] for seconds in one.values()]
        record.timing["seconds"] = None if None in parts else round(sum(parts), 2)

    def keep(self, record: Record, stage: int) -> None:
        """Write the record, after the last stage where it belongs, before where it waits."""
        if stage == self.last:
            write_record(record, self.path)
            shutil.rmtree(self.folder, ignore_errors=True)
            return
        folder = self._stage_folder(stage)
        cached(folder, self._inputs(stage), lambda partial: write_record(record, partial / "record.json"))
        if stage:
            shutil.rmtree(self._stage_folder(stage - 1), ignore_errors=True)


@dataclass(frozen=True)
class _Player:
    """An agent in the worlds of a scenario, one episode after the other."""

    agent: Agent
    lanes: Lanes
    seed: int
    instruction: InstructionFormat

    def play(self, trial: Trial) -> Episode:
        """Return what comes of an episode."""
        task, split, number = trial
        world_seed, words = start_of(trial, self.seed)
        instruction = observed(words, self.instruction)
        space = self.lanes.world(task).single_action_space
        states = self.lanes.reset([0], [world_seed], [task])
        memory, total, length, success = None, 0.0, 0, False
        while length < task.horizon and not success:
            numbers, images = self.lanes.observe([0], [task], states)
            picture = {} if task.camera is None else {"image": images[0]}
            observation: Observation = {"state": numbers[0], **picture, "instruction": instruction}
            action, memory = self._act(observation, memory, space)
            states, rewards, successes = self.lanes.step([0], action[None])
            total, length, success = total + float(rewards[0]), length + 1, bool(successes[0])
        return Episode(task.name, split, number, success, total, length)

    def _act(
        self, observation: Observation, memory: Any, space: spaces.Box
    ) -> tuple[NDArray[np.float32], Any]:
        """Return the agent's action (A,) within the space, and what it wants to be reminded of."""
        predict = getattr(self.agent, "predict", None)
        if predict is None:
            action, memory = self.agent(observation), None  # type: ignore[operator]
        else:
            reminder = {} if memory is None else {"state": memory}
            found = predict(observation, deterministic=True, **reminder)
            if not (isinstance(found, tuple) and len(found) == 2):
                raise InputError("predict() must return (action, state), as that of Stable-Baselines3 does.")
            action, memory = found
        try:
            numbers = np.asarray(action, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"The agent's action must be {space.shape[0]} numbers, not a {type(action).__name__}."
            ) from error
        if numbers.shape != space.shape:
            raise InputError(f"The agent's action has the shape {numbers.shape}, not {space.shape}.")
        # an agent that has diverged stands still and fails, as a policy does
        return np.nan_to_num(numbers).clip(space.low, space.high).astype(np.float32), memory


def _describe(agent: Agent) -> dict[str, Any]:
    """Return the class of an agent, and the version of the package that it comes from, None if from none."""
    kind = type(agent)
    packages = packages_distributions().get(kind.__module__.partition(".")[0], [])
    return {
        "class": f"{kind.__module__}:{kind.__qualname__}",
        "version": version(packages[0]) if packages else None,
    }


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as a record holds them.

    Raises:
        ValueError: JSON cannot hold them.
    """
    try:
        values: dict[str, Any] = json.loads(json.dumps(dict(settings), allow_nan=False))
        check_json(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"The settings cannot be in a record: {error}") from error
    return values
