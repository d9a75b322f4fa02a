"""Episodes of an agent or policy of any library: one after another, or in lock-step if it acts on batches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, TypeAlias
from typing import Protocol as Interface

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.errors import InputError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import derive_seed
from clbench.evaluation.episodes import LANES, Episode, Live, Trial, play_in_lanes
from clbench.spec.protocol import Split
from clbench.spec.scenario import Scenario
from clbench.worlds.lanes import Lanes
from clbench.worlds.scenario_env import Observation
from clbench.worlds.schedule import InstructionFormat, shown_instruction
from clbench.worlds.threads import cores


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


def acts_on_batches(agent: Agent, instruction: InstructionFormat) -> bool:
    """Return whether an agent is known to act on batches: one of Stable-Baselines3, which read tokens."""
    module = sys.modules.get("stable_baselines3.common.base_class")
    return module is not None and instruction == "tokens" and isinstance(agent, module.BaseAlgorithm)


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
        batched: Whether the agent acts on `LANES` observations at once, always as many: another number of
            rows may round differently. It may have no memory then. Otherwise it plays one episode after
            another.

    Raises:
        InputError: An action has the wrong shape, or an agent that acts on batches returned a memory.
    """
    act = _act_on_batch if batched else _act
    count = LANES if batched else 1
    single = lambda lanes, live: act(agent, lanes, live)[:, None]  # noqa: E731 - chunks of one action
    return _play(single, scenario, trials, seed, instruction, count)


class ChunkPlay(NamedTuple):
    """What a policy that acts in chunks did."""

    episodes: list[Episode]
    """Outcomes of the trials, in their order."""
    executed: int
    """Actions of each chunk that were executed, at most: an episode may end before."""
    not_finite: float
    """Share of the steps whose action was NaN or infinite somewhere, and was replaced."""
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
) -> ChunkPlay:
    """Return the outcome of each of `trials`.

    The policy observes `state`, float32 (LANES, S), `image`, uint8 (LANES, N, N, 3), where the tasks have a
    camera, `instruction`, texts, and what noise may be drawn from: `seed`, int64 (LANES,), different for each
    episode, and `step`, int64 (LANES,), the steps taken in it. Unused rows repeat the first one.

    Args:
        policy: Policy that acts.
        scenario: Scenario of the trials, at least one.
        trials: Episodes by task, split and number.
        seed: Seed of the run; it chooses the initial states.
        executed: Actions of a chunk that are executed before the policy acts again; if None, the length of
            the first chunk.
        whole: Whether all chunks must have exactly that length, or may be longer.
        progress: Called with the number of episodes that have ended since its last call.

    Raises:
        InputError: The actions have the wrong shape, or a chunk has another length.
    """
    player = _ChunkPlayer(policy, executed, whole)
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
        return play_in_lanes(lanes, count, trials, seed, begin, partial(act, lanes), progress=progress)


def _observations(lanes: Lanes, live: Sequence[Live]) -> Iterator[Observation]:
    """Yield what the agent observes in each running episode."""
    tasks = [one.trial[0] for one in live]
    states = np.stack([one.state for one in live])
    numbers, images = lanes.observe([one.lane for one in live], tasks, states)
    for row, one in enumerate(live):
        picture = {} if one.trial[0].camera is None else {"image": images[row]}
        yield {"state": numbers[row], **picture, "instruction": one.shown}


def _act(agent: Agent, lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float32]:
    """Return the actions (1, A) of an agent in the only lane, and let it keep its memory."""
    (one,), (observation,) = live, _observations(lanes, live)
    predict = getattr(agent, "predict", None)
    if predict is None:
        action = agent(observation)  # type: ignore[operator]
    else:
        reminder = {} if one.memory is None else {"state": one.memory}
        action, one.memory = _predicted(predict(observation, deterministic=True, **reminder))
    return _checked(action, lanes, live, ())


def _act_on_batch(agent: Agent, lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float32]:
    """Return the actions (lanes, A) of an agent in all lanes; unused rows repeat the first one."""
    rows = list(_observations(lanes, live))
    rows += [rows[0]] * (LANES - len(rows))
    batch = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    predict = getattr(agent, "predict", None)
    if predict is None:
        actions, memory = agent(batch), None  # type: ignore[operator]
    else:
        actions, memory = _predicted(predict(batch, deterministic=True))
    if memory is not None:
        raise InputError("The agent has a memory, and cannot act on batches: pass batched=False.")
    return _checked(actions, lanes, live, (LANES,))[: len(live)]


@dataclass
class _ChunkPlayer:
    """A policy that acts in chunks, and what was wrong with its actions."""

    policy: ChunkPolicy
    executed: int | None
    whole: bool
    faults: dict[tuple[str, Split, int], list[NDArray[np.bool_]]] = field(default_factory=dict)
    """For each episode, chunk after chunk, whether an action was not finite or was clipped, (H, 2)."""

    def act(self, lanes: Lanes, live: Sequence[Live]) -> NDArray[np.float32]:
        """Return the actions (lanes, H, A) to execute."""
        rows = list(_observations(lanes, live))
        rows = [
            {**row, "seed": derive_seed("noise", one.seed), "step": one.length}
            for row, one in zip(rows, live, strict=True)
        ]
        rows += [rows[0]] * (LANES - len(rows))
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        texts = {"instruction": columns.pop("instruction")}
        chunks = self.policy({**{name: np.stack(values) for name, values in columns.items()}, **texts})
        length = self._length(chunks)
        space = _space(lanes, live)
        actions = _numbers(chunks, space, (LANES, length))[: len(live), : self.executed]
        finite = np.isfinite(actions).all(axis=-1)
        outside = finite & ((actions < space.low) | (actions > space.high)).any(axis=-1)
        for one, found in zip(live, np.stack([~finite, outside], axis=-1), strict=True):
            task, split, number = one.trial
            self.faults.setdefault((task.name, split, number), []).append(found)
        return _within(actions, space)

    def _length(self, chunks: Any) -> int:
        """Return the length of chunks, and remember that of the first ones.

        Raises:
            InputError: They are no chunks, or have another length.
        """
        length = int(np.shape(chunks)[1]) if np.ndim(chunks) == 3 else 0
        known = self.executed
        if length < (known or 1) or (self.whole and known not in (None, length)):
            wanted = "any number of" if known is None else f"{'' if self.whole else 'at least '}{known}"
            hint = f" as before; --execute {known} executes the first {known} of more" if self.whole else ""
            raise InputError(
                f"The policy's actions have the shape {np.shape(chunks)}, not ({LANES}, H, A): for each "
                f"episode {wanted} actions{hint if known else ''}."
            )
        self.executed = known or length
        return length

    def shares(self, episodes: Sequence[Episode]) -> tuple[float, float]:
        """Return the shares of the steps of all episodes whose actions were not finite, and were clipped."""
        found = [
            np.concatenate(self.faults[one.task, one.split, one.number])[: one.length] for one in episodes
        ]
        not_finite, clipped = np.concatenate(found).mean(axis=0)
        return float(not_finite), float(clipped)


def _predicted(found: Any) -> tuple[Any, Any]:
    if not (isinstance(found, tuple) and len(found) == 2):
        raise InputError("predict() must return (action, state), as in Stable-Baselines3.")
    return found


def _checked(action: Any, lanes: Lanes, live: Sequence[Live], rows: tuple[int, ...]) -> NDArray[np.float32]:
    """Return actions (N, ..., A) within the space of the running worlds.

    Args:
        action: What the agent returned.
        lanes: Running worlds.
        live: Running episodes.
        rows: Shape of the actions without A; () for a single action, which becomes (1, A).
    """
    space = _space(lanes, live)
    numbers = _numbers(action, space, rows)
    return _within(numbers if rows else numbers[None], space)


def _space(lanes: Lanes, live: Sequence[Live]) -> spaces.Box:
    """Return the action space of the first lane; all tasks of a scenario share it."""
    space: spaces.Box = lanes.world(live[0].trial[0]).single_action_space
    return space


def _numbers(action: Any, space: spaces.Box, rows: tuple[int, ...]) -> NDArray[np.float64]:
    """Return actions as numbers of the shape (*rows, A)."""
    shape = (*rows, *space.shape)
    try:
        numbers = np.asarray(action, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"The agent's action must be {space.shape[0]} numbers, not a {type(action).__name__}."
        ) from error
    if numbers.shape != shape:
        raise InputError(f"The agent's action has the shape {numbers.shape}, not {shape}.")
    return numbers


def _within(numbers: NDArray[np.float64], space: spaces.Box) -> NDArray[np.float32]:
    """Return actions within a space: a diverged agent acts with zeros and fails, like a diverged policy."""
    return np.nan_to_num(numbers).clip(space.low, space.high).astype(np.float32)
