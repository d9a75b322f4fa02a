"""Rollouts of policies: many evaluation episodes in lock-step.

The outcome of an episode depends only on the policy, the task, the number of the episode, the seed of the run
and the number of lanes. Every forward pass of an evaluator has the same number of rows, with padding in
unused ones, because a matrix product may round differently for another number of rows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from clbench.base.errors import UnknownNameError, WrongTypeError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import torch_generator
from clbench.base.text import listed
from clbench.evaluation.episodes import LANES, Episode, Live, Trial, Watch, play_in_lanes
from clbench.policy.policy import Policy, evaluating
from clbench.spec.language import encode
from clbench.spec.protocol import SPLITS, Split
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import Lanes
from clbench.worlds.threads import threads_of_job

LOG = logging.getLogger(__name__)


class Evaluator:
    """Runs episodes of a scenario; it makes each world on first use and keeps it.

    Args:
        scenario: Scenario of the tasks.
        seed: Seed of the run: it chooses the initial states, the same for all methods.
        threads: Most threads that step the worlds; no outcome depends on it. None stands for the share of the
            cores that this process has, see `clbench.worlds.threads.share_cores`.
        lanes: Number of episodes that step together, and of rows in every forward pass.

    Raises:
        WrongTypeError: `scenario` is something other than a Scenario, such as an id.
    """

    def __init__(self, scenario: Scenario, seed: int, threads: int | None = None, lanes: int = LANES) -> None:
        if not isinstance(scenario, Scenario):
            raise WrongTypeError(
                f"A Scenario is needed, not {scenario!r}: clbench.load_scenario(ID) returns one."
            )
        self.scenario = scenario
        self.seed = seed
        self._lanes = Lanes(lanes, threads_of_job() if threads is None else threads)
        self._warned = False

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
            WrongTypeError: `tasks` has something other than tasks, or is a single one.
            UnknownNameError: No split is called `split`.
            LeakError: A hook asks for other episodes than validation episodes of tasks whose
                demonstrations it may read.
        """
        if isinstance(tasks, Task):
            raise WrongTypeError(f"Give a list of tasks, not the task {tasks.name!r} alone.")
        tasks = list(tasks)
        for task in tasks:
            if not isinstance(task, Task):
                raise WrongTypeError(f"A Task is needed, not {task!r}: Scenario.task(NAME) returns one.")
        if split not in SPLITS:
            raise UnknownNameError(f"No split is called {split!r}; there are {listed(SPLITS)}.")
        numbers = range(self.scenario.budget.episodes(split))
        return self.play(
            policy, [Trial(task, split, number) for task in tasks for number in numbers], progress
        )

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
            LeakError: A hook asks for other episodes than validation episodes of tasks whose
                demonstrations it may read.
        """
        with evaluating(policy):
            return play_in_lanes(
                self._lanes,
                trials,
                self.seed,
                partial(_begin, policy),
                partial(self._act, policy),
                progress=progress,
                watch=watch,
                enough=enough,
            )

    def _act(self, policy: Policy, live: Sequence[Live]) -> NDArray[np.float32]:
        """Return the actions to execute, (len(live), executed, A)."""
        config = policy.config
        rows = self._lanes.count
        state = torch.zeros(rows, config.state_size)
        words = torch.ones(rows, len(live[0].shown), dtype=torch.int64)
        noise = torch.zeros(rows, config.chunk, config.action_size)
        image = torch.zeros(rows, config.image_size, config.image_size, 3, dtype=torch.uint8)
        for row, one in enumerate(live):
            words[row] = one.shown
            assert one.noise is not None  # of `_begin`
            noise[row] = one.noise[one.length // config.executed]
        shown = self._lanes.observe(
            [one.lane for one in live],
            [one.trial.task for one in live],
            np.stack([one.state for one in live]),
        )
        state[: len(live)], image[: len(live)] = map(torch.from_numpy, shown)
        device = policy.device
        chunks = policy.act(state.to(device), words.to(device), noise.to(device), image.to(device))
        _check_chunks(policy, chunks, rows)
        actions: NDArray[np.float32] = chunks[: len(live), : config.executed].cpu().numpy()
        if not (self._warned or np.isfinite(actions).all()):
            self._warned = True
            LOG.warning("%s: act() returned NaN or infinities, and NaN counts as 0.", type(policy).__name__)
        # a diverged policy fails, and does not stop the run
        return np.nan_to_num(actions).clip(-1.0, 1.0)


def _check_chunks(policy: Policy, chunks: object, rows: int) -> None:
    """Refuse actions of another shape or type.

    NumPy would repeat a single number, take chunks for steps, and fail on bfloat16 or a gradient without a
    word about the policy.

    Raises:
        WrongTypeError: `act()` returned something other than a float32 tensor (B, H, A) without a gradient.
    """
    wanted = (rows, policy.config.chunk, policy.config.action_size)
    if not isinstance(chunks, torch.Tensor):
        found = type(chunks).__name__
    elif chunks.shape != wanted:
        found = str(tuple(chunks.shape))
    elif chunks.dtype != torch.float32:
        found = f"one of type {str(chunks.dtype).removeprefix('torch.')} instead of float32"
    elif chunks.requires_grad:
        found = "one with a gradient: use @torch.inference_mode()"
    else:
        return
    raise WrongTypeError(
        f"act() of {type(policy).__name__} must return a tensor (B, H, A), here {wanted}, not {found}."
    )


def _begin(policy: Policy, one: Live) -> None:
    """Give an episode the tokens of its instruction, and the noise for all its forward passes."""
    config = policy.config
    one.shown = encode([one.instruction], config.text_length)[0]
    passes = -(-one.trial.task.horizon // config.executed)
    shape = (passes, config.chunk, config.action_size)
    one.noise = torch.randn(shape, generator=torch_generator("noise", one.seed))
