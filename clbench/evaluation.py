"""Evaluation: rollouts of many episodes in lock-step, and answers to questions.

An episode's outcome depends on nothing but the policy, the task, its number and the run's seed. Every forward
has one shape, `LANES` rows of which the unused are padding: a matrix product may round differently for
another number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from clbench.demonstrations import World
from clbench.leaks import check_episodes
from clbench.policy import Policy, QuestionBatch, encode
from clbench.questions import QuestionKind
from clbench.seeding import derive_seed, torch_generator
from clbench.task import Scenario, Split, Task, resolve

Trial = tuple[Task, Split, int]
"""One episode to run: its task, its split and its number."""

Watch = Callable[[Trial, NDArray[np.float32]], None]
"""Called with a trial and an action (A,) that is taken in it."""

LANES = 40
"""Episodes that are stepped together, and rows of every forward."""


@dataclass(frozen=True)
class Episode:
    """What came of one evaluation episode."""

    task: str
    """Name of the task."""
    split: Split
    """What its outcome may be used for."""
    number: int
    """Which of the initial states of its task and split it had."""
    success: bool
    """Whether the success rule held before the horizon."""
    total_reward: float
    """Sum of the dense rewards."""
    length: int
    """Steps taken."""


@dataclass
class _Lane:
    """One episode on its way."""

    worlds: dict[str, World] = field(default_factory=dict)
    task: Task | None = None
    split: Split = "selection"
    number: int = 0
    words: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    noise: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    state: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    total_reward: float = 0.0
    length: int = 0


class Evaluator:
    """Runs episodes of a scenario; its worlds are made when first needed and used again.

    Args:
        scenario: Where the tasks come from.
        seed: Of the run: it chooses the initial states, the same for all methods.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        self.seed = seed
        self._lanes = [_Lane() for _ in range(LANES)]

    def close(self) -> None:
        """Close all worlds."""
        for lane in self._lanes:
            for world in lane.worlds.values():
                world.close()
            lane.worlds.clear()

    def evaluate(
        self,
        policy: Policy,
        tasks: Iterable[Task],
        split: Split = "selection",
        progress: Callable[[float], None] = lambda _: None,
    ) -> list[Episode]:
        """Return the outcome of every episode of `split` on each of the tasks, in order of task and number.

        Args:
            policy: What acts.
            tasks: What it is asked to do.
            split: Which episodes. Choose on "selection"; "report" is for scores alone.
            progress: Called with the number of episodes that have ended since its last call.
        """
        numbers = range(self.scenario.budget.episodes(split))
        return self.play(policy, [(task, split, number) for task in tasks for number in numbers], progress)

    def play(
        self,
        policy: Policy,
        trials: Sequence[Trial],
        progress: Callable[[float], None] = lambda _: None,
        watch: Watch = lambda _, __: None,
    ) -> list[Episode]:
        """Return the outcome of each of `trials`, in their order; none may be there twice.

        Args:
            policy: What acts.
            trials: Which episodes: task, split and number.
            progress: Called with the number of episodes that have ended since its last call.
            watch: Called with every action: the plain world, reset as `start_of` says, repeats the episode.
        """
        check_episodes((task.name, split) for task, split, _ in trials)
        queue = list(reversed(trials))
        ended: dict[tuple[str, Split, int], Episode] = {}
        live: list[_Lane] = []
        idle = list(self._lanes)
        while queue or live:
            while queue and idle:
                live.append(self._start(idle.pop(), policy, *queue.pop()))
            chunks = self._act(policy, live)
            for lane, chunk in zip(live.copy(), chunks, strict=True):
                episode = _execute(lane, chunk, watch)
                if episode is not None:
                    ended[episode.task, episode.split, episode.number] = episode
                    live.remove(lane)
                    idle.append(lane)
                    progress(1)
        return [ended[task.name, split, number] for task, split, number in trials]

    def _start(self, lane: _Lane, policy: Policy, task: Task, split: Split, number: int) -> _Lane:
        if task.world not in lane.worlds:
            lane.worlds[task.world] = resolve(task.world)()
        seed, instruction = start_of((task, split, number), self.seed)
        lane.task, lane.split, lane.number = task, split, number
        lane.total_reward, lane.length = 0.0, 0
        lane.state, _ = lane.worlds[task.world].reset(seed=seed, options={"task": task.name})
        lane.words = encode([instruction])[0]
        forwards = -(-task.horizon // policy.config.executed)
        shape = (forwards, policy.config.chunk, policy.config.action_size)
        lane.noise = torch.randn(shape, generator=torch_generator("noise", seed))
        return lane

    def _act(self, policy: Policy, live: Sequence[_Lane]) -> NDArray[np.float32]:
        """Return the actions to execute, (len(live), executed, A)."""
        config = policy.config
        state = torch.zeros(LANES, config.state_size)
        words = torch.ones(LANES, len(live[0].words), dtype=torch.int64)
        noise = torch.zeros(LANES, config.chunk, config.action_size)
        for row, lane in enumerate(live):
            state[row] = torch.from_numpy(lane.state)
            words[row] = lane.words
            noise[row] = lane.noise[lane.length // config.executed]
        device = policy.state_mean.device
        chunks = policy.act(state.to(device), words.to(device), noise.to(device))
        actions: NDArray[np.float32] = chunks[: len(live), : config.executed].cpu().numpy()
        return actions


def start_of(trial: Trial, seed: int) -> tuple[int, str]:
    """Return what a trial starts with in a run of `seed`: the seed of its initial state, its instruction."""
    task, split, number = trial
    instruction = task.instructions[number % len(task.instructions)]
    return derive_seed("episode", seed, task.name, split, number), instruction


def _execute(lane: _Lane, chunk: NDArray[np.float32], watch: Watch) -> Episode | None:
    """Step a lane through a chunk (executed, A); return the episode if it ends."""
    assert lane.task is not None
    world = lane.worlds[lane.task.world]
    for action in chunk:
        # a diverged policy acts in NaN: it stands still and fails rather than stop the run
        action = np.clip(np.nan_to_num(action), -1.0, 1.0)
        watch((lane.task, lane.split, lane.number), action)
        lane.state, reward, terminated, _, _ = world.step(action)
        lane.total_reward += float(reward)
        lane.length += 1
        if terminated or lane.length == lane.task.horizon:
            return Episode(
                lane.task.name, lane.split, lane.number, terminated, lane.total_reward, lane.length
            )
    return None


@torch.inference_mode()
def answer(
    policy: Policy, kinds: Sequence[QuestionKind], kind: torch.Tensor, questions: QuestionBatch
) -> list[tuple[str, int, int]]:
    """Return, for each kind of question, its name, how often it was asked, and how often answered rightly.

    Args:
        policy: What answers, by the likeliest word of the whole vocabulary.
        kinds: The kinds that there are.
        kind: Index of each question's kind, (B,).
        questions: The questions, B of them.
    """
    right = []
    device = policy.state_mean.device
    for start in range(0, len(questions), LANES):
        rows = slice(start, start + LANES)
        padding = LANES - len(questions.state[rows])
        state = torch.nn.functional.pad(questions.state[rows], (0, 0, 0, padding))
        words = torch.nn.functional.pad(questions.words[rows], (0, 0, 0, padding), value=1)
        word = policy.answer_logits(state.to(device), words.to(device)).argmax(dim=1).cpu()
        right.append(word[: LANES - padding] == questions.answer[rows])
    correct = torch.cat(right)
    return [
        (entry.name, int((kind == index).sum()), int(correct[kind == index].sum()))
        for index, entry in enumerate(kinds)
    ]
