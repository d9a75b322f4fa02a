"""Agents and policies of any library: where they were trained, and their episodes.

Episodes run one after another, or in lock-step if the agent acts on batches.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from itertools import compress
from typing import Any, NamedTuple, TypeAlias, cast
from typing import Protocol as Interface

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from clbench.base.errors import InputError, WrongTypeError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import derive_seed
from clbench.evaluation.episodes import LANES, Episode, Live, Trial, play_in_lanes
from clbench.evaluation.views import SimulatorCameras
from clbench.spec.protocol import EpisodeKey
from clbench.spec.scenario import Scenario
from clbench.worlds.lanes import Lanes
from clbench.worlds.scenario_env import Observation, ScenarioEnv
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv
from clbench.worlds.schedule import InstructionFormat, shown_instruction
from clbench.worlds.threads import cores

LOG = logging.getLogger(__name__)


class Predictor(Interface):
    """An agent with the interface of Stable-Baselines3's algorithms."""

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Return an action (A,), and a memory that the next call receives as `state` unless it is None."""
        ...


Agent: TypeAlias = Predictor | Callable[[Observation], Any]
"""An agent to evaluate: a `Predictor`, or a function of an observation that returns an action (A,)."""


ChunkPolicy: TypeAlias = Callable[[dict[str, Any]], Any]
"""A function from the observations of `LANES` episodes, arrays and lists by name, to chunks of actions
(LANES, H, A)."""


class SideBySide(Interface):
    """Environments side by side, with the interface of Stable-Baselines3's `VecEnv`."""

    def get_attr(self, attr_name: str) -> Sequence[Any]:
        """Return an attribute of each environment."""
        ...


TrainingEnv: TypeAlias = gymnasium.Env[Any, Any] | VectorEnv[Any, Any, Any] | SideBySide
"""An environment of a scenario, or several side by side, of Gymnasium or Stable-Baselines3."""


@dataclass(frozen=True)
class Training:
    """The environments in which an agent was trained, as far as its evaluation needs them."""

    scenario: Scenario
    """The scenario."""
    stage: int | None
    """Stage that the environments stay in; None if they go through all stages."""
    order: int
    """Order of the targets."""
    instruction: InstructionFormat
    """Form of the instruction in observations."""
    steps: int
    """Steps of all environments together since they were made."""
    begun_at: float | None
    """Start of the first episode in seconds, by `time.perf_counter`; None if there was none."""


def training_of(env: TrainingEnv) -> Training:
    """Return what the environments in which an agent was trained say about its training.

    Raises:
        WrongTypeError: They are not environments of a scenario.
        InputError: They differ in their scenario, stage, order of the targets or form of instructions.
    """
    inner: Any = getattr(env, "unwrapped", env)
    names = ("scenario", "stage", "order", "instruction", "steps_taken", "begun_at")
    try:
        if isinstance(inner, ScenarioEnv | ScenarioVectorEnv):
            told = [[getattr(inner, name)] for name in names]
        else:
            told = [list(inner.get_attr(name)) for name in names]
    except (AttributeError, EOFError, ConnectionError):  # such a process of Stable-Baselines3 ends
        told = [[None]]
    if not isinstance(told[0][0], Scenario):
        raise WrongTypeError(
            f"{env} does not belong to a scenario: make it with gymnasium.make('clbench/Fetch-v1', stage=0)."
        )
    scenarios, *alike, steps, begun = told
    for name, values in zip(names, ([one.id for one in scenarios], *alike), strict=False):
        if any(value != values[0] for value in values):
            raise InputError(f"The environments of {env} differ in their {name}: {values}.")
    stage, order, instruction = (values[0] for values in alike)
    known = [seconds for seconds in begun if seconds is not None]
    return Training(scenarios[0], stage, order, instruction, sum(steps), min(known, default=None))


def _is_of_stable_baselines3(agent: Agent) -> bool:
    module = sys.modules.get("stable_baselines3.common.base_class")
    return module is not None and isinstance(agent, module.BaseAlgorithm)


def acts_on_batches(agent: Agent, instruction: InstructionFormat) -> bool:
    """Return whether an agent is known to act on batches: an agent of Stable-Baselines3 that reads tokens."""
    return instruction == "tokens" and _is_of_stable_baselines3(agent)


def play(
    agent: Agent,
    scenario: Scenario,
    trials: Sequence[Trial],
    seed: int,
    instruction: InstructionFormat,
    batched: bool,
) -> list[Episode]:
    """Return the outcome of each of `trials`, in their order.

    Args:
        agent: Agent that acts.
        scenario: Scenario of the trials.
        trials: Episodes by task, split and number.
        seed: Seed of the run; it chooses the initial states.
        instruction: Form of the instruction in observations.
        batched: Whether the agent acts on `LANES` observations at once, always the same number, since another
            number of rows may round differently. Such an agent must not return a memory. Any other agent
            plays one episode after another.

    Raises:
        InputError: An action has the wrong shape, an agent that acts on batches returned a memory, or an
            agent of Stable-Baselines3 was trained behind a wrapper that evaluation lacks.
    """
    _check_wrappers(agent, scenario, instruction)
    predicted = _act_on_batch if batched else _act
    count, warned = LANES if batched else 1, False

    def act(lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float32]:
        nonlocal warned
        numbers = predicted(agent, lanes, live)
        if not (warned or np.isfinite(numbers).all()):
            warned = True
            LOG.warning("The agent returned NaN or infinities, and NaN counts as 0.")
        return _within(numbers, _space(lanes, live))[:, None]  # chunks of one action

    return _play(act, scenario, trials, seed, instruction, count)


def _check_wrappers(agent: Agent, scenario: Scenario, instruction: InstructionFormat) -> None:
    """Refuse an agent of Stable-Baselines3 whose wrapper in training changed its observations or actions.

    Most wrappers would raise no error: the agent would act on other numbers than in training, and fail.
    """
    if not _is_of_stable_baselines3(agent):
        return
    trained: Any = agent
    with closing(ScenarioEnv(scenario, instruction)) as env:
        own, shown = trained.observation_space, cast("spaces.Dict", env.observation_space)
        same = isinstance(own, spaces.Dict) and set(own) == set(shown)
        observes = same and all(own[name] in (shown[name], _first_colours(shown[name])) for name in shown)
        acts = trained.action_space == env.action_space
    normalised = trained.get_vec_normalize_env()
    if normalised is not None and normalised.norm_obs:
        observes = False
    if not (observes and acts):
        other = " and ".join(compress(("observations", "actions"), (not observes, not acts)))
        raise InputError(
            f"The agent was trained with {other} that differ from those of {scenario.id} with "
            f"instruction={instruction!r}, for example behind a wrapper. Evaluate an object whose predict() "
            "does the same as the wrapper, as docs/guide/online.md shows."
        )


def _first_colours(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return the space of a picture with its colours first, as in Stable-Baselines3; keep other spaces."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 3:
        return space
    return spaces.Box(space.low.transpose(2, 0, 1), space.high.transpose(2, 0, 1), dtype=space.low.dtype.type)


class ChunkPlay(NamedTuple):
    """Episodes of a policy that acts in chunks, and the faults of its actions."""

    episodes: list[Episode]
    """Outcomes of the trials, in their order."""
    executed: int
    """Maximum number of executed actions of each chunk; an episode may end earlier."""
    not_finite: float
    """Share of the steps whose action had a NaN or infinite number, which was replaced."""
    clipped: float
    """Share of the steps whose action was finite and outside of the action space, and was clipped."""


def play_chunks(
    policy: ChunkPolicy,
    scenario: Scenario,
    trials: Sequence[Trial],
    seed: int,
    executed: int | None = None,
    whole: bool = True,
    progress: ProgressCallback = no_progress,
    cameras: SimulatorCameras | None = None,
) -> ChunkPlay:
    """Return the outcome of each of `trials`.

    The policy observes `state`, float32 (LANES, S), `image`, uint8 (LANES, N, N, 3), where the tasks have a
    camera, `instruction`, texts, and what noise may be drawn from: `seed`, int64 (LANES,), different for each
    episode, and `step`, int64 (LANES,), the steps taken in it. With `cameras` it also observes
    `pictures/<camera>`, uint8 (LANES, N, N, 3), of each camera. Unused rows repeat the first one.

    Args:
        policy: Policy that acts.
        scenario: Scenario of the trials, at least one.
        trials: Episodes by task, split and number.
        seed: Seed of the run; it chooses the initial states.
        executed: Actions of a chunk that are executed before the policy acts again; if None, the length of
            the first chunk.
        whole: Whether all chunks must have exactly that length, or may be longer.
        progress: Called with the number of episodes that have ended since its last call.
        cameras: Cameras of the simulator whose pictures the policy observes; None gives none.

    Raises:
        UnknownNameError: A scene has no such camera.
        InputError: The actions have the wrong shape, a chunk has another length, or nothing can be drawn.
        RenderingError: This machine cannot draw.
    """
    if cameras is not None:
        cameras.check(trial.task for trial in trials)
    player = _ChunkPlayer(policy, executed, whole, cameras)
    episodes = _play(player.act, scenario, trials, seed, "text", LANES, progress)
    assert player.executed is not None
    return ChunkPlay(episodes, player.executed, *player.shares(episodes))


def _play(
    act: Callable[[Lanes, Sequence[Live]], NDArray[np.float32]],
    scenario: Scenario,
    trials: Sequence[Trial],
    seed: int,
    instruction: InstructionFormat,
    count: int,
    progress: ProgressCallback = no_progress,
) -> list[Episode]:
    """Return the outcome of each of `trials` in `count` lanes; `act` returns the actions (lanes, H, A)."""

    def begin(one: Live) -> None:
        one.shown = shown_instruction(one.instruction, instruction, scenario)

    with closing(Lanes(count, threads=cores() if count > 1 else 1)) as lanes:
        return play_in_lanes(lanes, trials, seed, begin, partial(act, lanes), progress=progress)


def _observations(lanes: Lanes, live: Sequence[Live]) -> Iterator[Observation]:
    """Yield what the agent observes in each running episode."""
    tasks = [one.trial.task for one in live]
    states = np.stack([one.state for one in live])
    numbers, images = lanes.observe([one.lane for one in live], tasks, states)
    for row, one in enumerate(live):
        picture = {} if one.trial.task.camera is None else {"image": images[row]}
        yield {"state": numbers[row], **picture, "instruction": copy(one.shown)}  # agents may change theirs


def _act(agent: Agent, lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float64]:
    """Return the actions (1, A) of an agent in the only lane, and let it keep its memory."""
    (one,), (observation,) = live, _observations(lanes, live)
    reminder = {} if one.memory is None else {"state": one.memory}
    action, one.memory = _predicted(agent, observation, **reminder)
    return _numbers("agent", action, _space(lanes, live), ())[None]


def _act_on_batch(agent: Agent, lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float64]:
    """Return the actions (lanes, A) of an agent in all lanes; unused rows repeat the first one."""
    rows = list(_observations(lanes, live))
    rows += [rows[0]] * (LANES - len(rows))
    batch = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    actions, memory = _predicted(agent, batch)
    if memory is not None:
        raise InputError("The agent has a memory, and cannot act on batches: pass batched=False.")
    return _numbers("agent", actions, _space(lanes, live), (LANES,))[: len(live)]


@dataclass
class _ChunkPlayer:
    """A policy that acts in chunks, and what was wrong with its actions."""

    policy: ChunkPolicy
    executed: int | None
    whole: bool
    cameras: SimulatorCameras | None
    faults: dict[EpisodeKey, list[NDArray[np.bool_]]] = field(default_factory=dict)
    """For each episode, chunk after chunk, whether an action was not finite or was clipped, (H, 2)."""

    def act(self, lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float32]:
        """Return the actions (lanes, H, A) to execute."""
        rows = list(_observations(lanes, live))
        rows = [
            {**row, **self._pictures(lanes, one), "seed": derive_seed("noise", one.seed), "step": one.length}
            for row, one in zip(rows, live, strict=True)
        ]
        rows += [rows[0]] * (LANES - len(rows))
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        texts = {"instruction": columns.pop("instruction")}
        chunks = self.policy({**{name: np.stack(values) for name, values in columns.items()}, **texts})
        length = self._length(chunks)
        space = _space(lanes, live)
        actions = _numbers("policy", chunks, space, (LANES, length))[: len(live), : self.executed]
        finite = np.isfinite(actions).all(axis=-1)
        outside = finite & ((actions < space.low) | (actions > space.high)).any(axis=-1)
        for one, found in zip(live, np.stack([~finite, outside], axis=-1), strict=True):
            self.faults.setdefault(one.trial.key, []).append(found)
        return _within(actions, space)

    def _pictures(self, lanes: Lanes, one: Live) -> dict[str, NDArray[np.uint8]]:
        """Return the pictures of an episode, by their names in observations."""
        drawn = {} if self.cameras is None else self.cameras.draw(lanes, one.lane, one.trial.task)
        return {f"pictures/{name}": picture for name, picture in drawn.items()}

    def _length(self, chunks: Any) -> int:
        """Return the length of chunks, and remember the length of the first ones.

        Raises:
            InputError: They are not chunks, or have another length.
        """
        shape = _shape(chunks)
        length = shape[1] if len(shape) == 3 else 0
        known = self.executed
        if known is None:
            fits, wanted = length >= 1, "any number of actions"
        elif self.whole:
            fits = length == known
            option = f"executed={known} (--executed {known} of `clbench score`)"
            wanted = f"{known} actions as before; {option} executes the first {known} of more"
        else:
            fits, wanted = length >= known, f"at least {known} actions"
        if not fits:
            raise InputError(
                f"The policy's actions have the shape {shape}, not ({LANES}, H, A): for each "
                f"episode {wanted}."
            )
        self.executed = known or length
        return length

    def shares(self, episodes: Sequence[Episode]) -> tuple[float, float]:
        """Return the shares of the steps of all episodes whose actions were not finite, and were clipped."""
        found = [np.concatenate(self.faults[one.key])[: one.length] for one in episodes]
        not_finite, clipped = np.concatenate(found).mean(axis=0)
        return float(not_finite), float(clipped)


def _shape(chunks: Any) -> tuple[int, ...]:
    """Return the shape of the actions of a served policy.

    Raises:
        InputError: They are nested lists of different lengths.
    """
    try:
        return np.shape(chunks)
    except ValueError:
        message = f"The policy's actions must have one shape ({LANES}, H, A), but its lists differ in length."
        raise InputError(message) from None


def _predicted(agent: Agent, observation: Any, **reminder: Any) -> tuple[Any, Any]:
    """Return the action of an agent, or its actions, and its memory; a function has none."""
    predict = getattr(agent, "predict", None)
    if predict is None:
        return agent(observation), None  # type: ignore[operator]
    found = predict(observation, deterministic=True, **reminder)
    if not (isinstance(found, tuple) and len(found) == 2):
        raise InputError("predict() must return (action, state), as in Stable-Baselines3.")
    return found


def _space(lanes: Lanes, live: Sequence[Live]) -> spaces.Box:
    """Return the action space of the first lane; all tasks of a scenario share it."""
    space: spaces.Box = lanes.world(live[0].trial.task).single_action_space
    return space


def _numbers(actor: str, action: Any, space: spaces.Box, rows: tuple[int, ...]) -> NDArray[np.float64]:
    """Return actions as numbers of the shape (*rows, A); messages name the actor."""
    shape = (*rows, *space.shape)
    try:
        given = np.asarray(action)
        # NumPy reads a text as a number and None in a list as NaN, and drops an imaginary part
        is_object = given.dtype.kind == "O" and given.ndim
        if given.dtype.kind in "USc" or (is_object and any(one is None for one in given.flat)):
            raise TypeError(f"of type {given.dtype}")
        numbers = np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"The {actor}'s action must be {space.shape[0]} numbers, not a {type(action).__name__} ({error})."
        ) from error
    if numbers.shape != shape:
        raise InputError(f"The {actor}'s action has the shape {numbers.shape}, not {shape}.")
    return numbers


def _within(numbers: NDArray[np.float64], space: spaces.Box) -> NDArray[np.float32]:
    """Return actions within a space: a diverged agent acts with zeros and fails, like a diverged policy."""
    return np.nan_to_num(numbers).clip(space.low, space.high).astype(np.float32)
