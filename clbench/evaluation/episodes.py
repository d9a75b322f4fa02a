"""Episodes in lock-step, for any actor: a policy of a run, an agent, or a policy from elsewhere.

The initial state of an episode depends only on the task, the number of the episode and the seed of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clbench.base.progress import ProgressCallback
from clbench.base.seeding import SPLIT_LABELS, derive_seed
from clbench.data.access import check_episodes
from clbench.spec.protocol import EpisodeKey, Split
from clbench.spec.task import Task
from clbench.worlds.lanes import Lanes

if TYPE_CHECKING:
    from torch import Tensor


class Trial(NamedTuple):
    """One episode to run."""

    task: Task
    split: Split
    """Split of the episode."""
    number: int
    """Number of the initial state within its task and split, from 0."""

    @property
    def key(self) -> EpisodeKey:
        """The identity of the episode, which its outcome shares."""
        return EpisodeKey(self.task.name, self.split, self.number)


Watch = Callable[[Trial, NDArray[np.float32]], None]
"""Called with a trial and each action (A,) taken in it."""

LANES = 40
"""Episodes that are stepped together, and rows of every forward pass. Another number may change the
last bits of scores (docs/decisions/0005-forty-lanes.md). Checks of a criterion have fewer lanes."""


@dataclass(frozen=True)
class Episode:
    """The outcome of one evaluation episode."""

    task: str
    """Name of the task."""
    split: Split
    """Split of the episode, which limits the use of its outcome."""
    number: int
    """Number of the episode, which chooses its initial state within its task and split."""
    success: bool
    """Whether the episode was a success by its horizon."""
    total_reward: float
    """Sum of the rewards."""
    length: int
    """Number of steps."""

    @property
    def key(self) -> EpisodeKey:
        """The identity of the episode."""
        return EpisodeKey(self.task, self.split, self.number)


@dataclass(eq=False)  # identity: arrays have no truth value
class Live:
    """One running episode."""

    lane: int
    """Number of its lane."""
    trial: Trial
    seed: int
    """Seed of its initial state."""
    instruction: str
    state: NDArray[np.float32]
    """State after the last step, (S,)."""
    shown: Any = None
    """The instruction as the actor reads it; `begin` of `play_in_lanes` sets it."""
    memory: Any = None
    """Memory of an agent for this episode."""
    noise: Tensor | None = None
    """Noise of a policy for all its forward passes in this episode, (passes, H, A)."""
    total_reward: float = 0.0
    length: int = 0
    success: bool = False

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.success or self.length == self.trial.task.horizon

    @property
    def episode(self) -> Episode:
        """Outcome of the episode."""
        task, split, number = self.trial
        return Episode(task.name, split, number, self.success, self.total_reward, self.length)


Act: TypeAlias = Callable[[Sequence[Live]], NDArray[np.float32]]
"""Returns the actions to execute in running episodes, (episodes, H, A)."""


def play_in_lanes(
    lanes: Lanes,
    trials: Sequence[Trial],
    seed: int,
    begin: Callable[[Live], None],
    act: Act,
    *,
    progress: ProgressCallback,
    watch: Watch = lambda _, __: None,
    enough: Callable[[Episode], bool] = lambda _: False,
) -> list[Episode]:
    """Return the outcome of each of `trials`, in their order; no trial may occur twice.

    Args:
        lanes: Running worlds.
        trials: Episodes by task, split and number.
        seed: Seed of the run; it chooses the initial states.
        begin: Called with each episode before its first step.
        act: Called with the running episodes until all have ended.
        progress: Called with the number of episodes that have ended since its last call.
        watch: Called with every action.
        enough: Called with each outcome; once it returns True, only the episodes that have ended count.

    Raises:
        LeakError: A hook asks for other episodes than validation episodes of tasks whose
            demonstrations it may read.
    """
    check_episodes((task.name, split) for task, split, _ in trials)
    queue, idle = list(reversed(trials)), list(range(lanes.count))
    live: list[Live] = []
    ended: dict[EpisodeKey, Episode] = {}
    certain = False
    while (queue or live) and not certain:
        starting = [(idle.pop(), queue.pop()) for _ in range(min(len(idle), len(queue)))]
        live += _start(lanes, starting, seed, begin)
        _execute(lanes, live, act(live), watch)
        for one in [one for one in live if one.ended]:
            episode = one.episode
            ended[episode.key] = episode
            live.remove(one)
            idle.append(one.lane)
            progress(1)
            certain = enough(episode)
            if certain:
                break
    return [ended[trial.key] for trial in trials if trial.key in ended]


def _start(
    lanes: Lanes, starting: Sequence[tuple[int, Trial]], seed: int, begin: Callable[[Live], None]
) -> list[Live]:
    """Begin each trial in the lane that is paired with it."""
    if not starting:
        return []
    starts = [start_of(trial, seed) for _, trial in starting]
    states = lanes.reset(
        [lane for lane, _ in starting],
        [world_seed for world_seed, _ in starts],
        [task for _, (task, _, _) in starting],
        [split == "perturbed" for _, (_, split, _) in starting],
    )
    found = [
        Live(lane, trial, *start, state)
        for (lane, trial), start, state in zip(starting, starts, states, strict=True)
    ]
    for one in found:
        begin(one)
    return found


def _execute(lanes: Lanes, live: Sequence[Live], chunks: NDArray[np.float32], watch: Watch) -> None:
    """Step running episodes through their chunks (episodes, H, A), each until it ends."""
    for step in range(chunks.shape[1]):
        rows = [row for row, one in enumerate(live) if not one.ended]
        if not rows:
            return
        for row in rows:
            watch(live[row].trial, chunks[row, step])
        outcomes = lanes.step([live[row].lane for row in rows], chunks[rows, step])
        for row, state, reward, success in zip(rows, *outcomes, strict=True):
            one = live[row]
            one.state, one.length, one.success = state, one.length + 1, bool(success)
            one.total_reward += float(reward)


def start_of(trial: Trial, seed: int) -> tuple[int, str]:
    """Return the start of a trial in a run of `seed`: the seed of its initial state, and its instruction.

    A perturbed episode has the same start as the test episode with the same number.
    """
    task, split, number = trial
    wordings = task.wordings(split)
    instruction = wordings[number % len(wordings)]
    label = SPLIT_LABELS["test" if split == "perturbed" else split]
    return derive_seed("episode", seed, task.name, label, number), instruction
