"""Rollouts: many evaluation episodes in lock-step.

The outcome of an episode depends only on the policy, the task, the number of the episode and the seed of the
run. Every forward pass of an evaluator has the same number of rows, with padding in unused ones, because a
matrix product may round differently for another number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import SPLIT_LABELS, derive_seed, torch_generator
from clbench.data.access import check_episodes
from clbench.policy.policy import Policy
from clbench.spec.language import encode
from clbench.spec.protocol import Split
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import Lanes

Trial = tuple[Task, Split, int]
"""One episode to run: its task, its split and its number."""

Watch = Callable[[Trial, NDArray[np.float32]], None]
"""Called with a trial and each action (A,) taken in it."""

LANES = 40
"""Episodes that are stepped together, and rows of every forward pass. Another number may change the
last bits of scores (docs/decisions/0005-forty-lanes.md)."""


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
    """Whether the success rule held before the horizon."""
    total_reward: float
    """Sum of the dense rewards."""
    length: int
    """Number of steps."""


@dataclass
class _Lane:
    """One running episode."""

    number: int
    """Number of its lane."""
    trial: Trial
    words: torch.Tensor
    noise: torch.Tensor
    """Noise for every forward pass of the episode, (forwards, H, A)."""
    state: NDArray[np.float32]
    total_reward: float = 0.0
    length: int = 0
    success: bool = False

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.success or self.length == self.trial[0].horizon

    @property
    def episode(self) -> Episode:
        """Outcome of the episode."""
        task, split, number = self.trial
        return Episode(task.name, split, number, self.success, self.total_reward, self.length)


class Evaluator:
    """Runs episodes of a scenario; it makes each world on first use and keeps it.

    Args:
        scenario: Scenario of the tasks.
        seed: Seed of the run: it chooses the initial states, the same for all methods.
        threads: Number of threads that may step the worlds; no outcome depends on it.
        lanes: Number of episodes that step together, and of rows in every forward pass.
    """

    def __init__(self, scenario: Scenario, seed: int, threads: int = 1, lanes: int = LANES) -> None:
        self.scenario = scenario
        self.seed = seed
        self._count = lanes
        self._lanes = Lanes(lanes, threads)

    def close(self) -> None:
        """Close all worlds."""
        self._lanes.close()

    def evaluate(
        self,
        policy: Policy,
        tasks: Iterable[Task],
        split: Split = "validation",
        progress: ProgressCallback = no_progress,
    ) -> list[Episode]:
        """Return the outcome of every episode of `split` on each of the tasks, in order of task and number.

        Args:
            policy: Policy that acts.
            tasks: Tasks to evaluate.
            split: Split of the episodes. Base choices on "validation"; the others are only for scores.
            progress: Called with the number of episodes that have ended since its last call.

        Raises:
            LeakError: A hook asks for other episodes than validation episodes of tasks that it knows.
        """
        numbers = range(self.scenario.budget.episodes(split))
        return self.play(policy, [(task, split, number) for task in tasks for number in numbers], progress)

    def play(
        self,
        policy: Policy,
        trials: Sequence[Trial],
        progress: ProgressCallback = no_progress,
        watch: Watch = lambda _, __: None,
        enough: Callable[[Episode], bool] = lambda _: False,
    ) -> list[Episode]:
        """Return the outcome of each of `trials`, in their order; no trial may occur twice.

        Args:
            policy: Policy that acts.
            trials: Episodes by task, split and number.
            progress: Called with the number of episodes that have ended since its last call.
            watch: Called with every action. With these actions the plain world, reset with the seed of
                `start_of`, repeats the episode unless it is perturbed.
            enough: Called with each outcome; once it returns True, only the episodes that have ended count.

        Raises:
            LeakError: A hook asks for other episodes than validation episodes of tasks that it knows.
        """
        check_episodes((task.name, split) for task, split, _ in trials)
        queue = list(reversed(trials))
        ended: dict[tuple[str, Split, int], Episode] = {}
        live: list[_Lane] = []
        idle = list(range(self._count))
        certain = False
        while (queue or live) and not certain:
            starting = [(idle.pop(), queue.pop()) for _ in range(min(len(idle), len(queue)))]
            live += self._start(policy, starting)
            self._execute(live, self._act(policy, live), watch)
            for lane in [lane for lane in live if lane.ended]:
                episode = lane.episode
                ended[episode.task, episode.split, episode.number] = episode
                live.remove(lane)
                idle.append(lane.number)
                progress(1)
                certain = enough(episode)
                if certain:
                    break
        keys = [(task.name, split, number) for task, split, number in trials]
        return [ended[key] for key in keys if key in ended]

    def _start(self, policy: Policy, starting: Sequence[tuple[int, Trial]]) -> list[_Lane]:
        """Begin each trial in the lane that is paired with it."""
        if not starting:
            return []
        tasks = [task for _, (task, _, _) in starting]
        starts = [start_of(trial, self.seed) for _, trial in starting]
        states = self._lanes.reset(
            [lane for lane, _ in starting],
            [seed for seed, _ in starts],
            tasks,
            [split == "perturbed" for _, (_, split, _) in starting],
        )
        lanes = []
        for (lane, trial), (seed, instruction), state in zip(starting, starts, states, strict=True):
            words = encode([instruction], policy.config.text_length)[0]
            forwards = -(-trial[0].horizon // policy.config.executed)
            shape = (forwards, policy.config.chunk, policy.config.action_size)
            noise = torch.randn(shape, generator=torch_generator("noise", seed))
            lanes.append(_Lane(lane, trial, words, noise, state))
        return lanes

    def _act(self, policy: Policy, live: Sequence[_Lane]) -> NDArray[np.float32]:
        """Return the actions to execute, (len(live), executed, A)."""
        config = policy.config
        rows = self._count
        state = torch.zeros(rows, config.state_size)
        words = torch.ones(rows, len(live[0].words), dtype=torch.int64)
        noise = torch.zeros(rows, config.chunk, config.action_size)
        image = torch.zeros(rows, config.image_size, config.image_size, 3, dtype=torch.uint8)
        for row, lane in enumerate(live):
            words[row] = lane.words
            noise[row] = lane.noise[lane.length // config.executed]
        shown = self._lanes.observe(
            [lane.number for lane in live],
            [lane.trial[0] for lane in live],
            np.stack([lane.state for lane in live]),
        )
        state[: len(live)], image[: len(live)] = map(torch.from_numpy, shown)
        device = policy.device
        chunks = policy.act(state.to(device), words.to(device), noise.to(device), image.to(device))
        actions: NDArray[np.float32] = chunks[: len(live), : config.executed].cpu().numpy()
        # a diverged policy returns NaN: with zero actions it fails and does not stop the run
        return np.nan_to_num(actions).clip(-1.0, 1.0)

    def _execute(self, live: Sequence[_Lane], chunks: NDArray[np.float32], watch: Watch) -> None:
        """Step the lanes through their chunks (len(live), executed, A), each until its episode ends."""
        for step in range(chunks.shape[1]):
            rows = [row for row, lane in enumerate(live) if not lane.ended]
            if not rows:
                return
            for row in rows:
                watch(live[row].trial, chunks[row, step])
            outcomes = self._lanes.step([live[row].number for row in rows], chunks[rows, step])
            for row, state, reward, success in zip(rows, *outcomes, strict=True):
                lane = live[row]
                lane.state, lane.length = state, lane.length + 1
                lane.total_reward += float(reward)
                lane.success = bool(success)


def start_of(trial: Trial, seed: int) -> tuple[int, str]:
    """Return the start of a trial in a run of `seed`: the seed of its initial state, and its instruction.

    A perturbed episode has the same start as the test episode of its number.
    """
    task, split, number = trial
    wordings = task.wordings(split)
    instruction = wordings[number % len(wordings)]
    label = SPLIT_LABELS["test" if split == "perturbed" else split]
    return derive_seed("episode", seed, task.name, label, number), instruction
