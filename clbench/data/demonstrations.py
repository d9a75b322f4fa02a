"""Demonstrations: episodes of the expert, stored as Minari datasets and read as batches of action chunks."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray
from torch import Tensor

from clbench.base.cache import cached, hash_of, is_cached, minari_folder
from clbench.base.dependencies import versions
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, WrongTypeError
from clbench.base.leftovers import replacing
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import derive_seed, numpy_generator
from clbench.base.source import DATA_SOURCES, source_hash
from clbench.data.access import check_demonstrations
from clbench.policy.batch import Batch
from clbench.policy.policy import PolicyConfig
from clbench.spec.budget import Budget
from clbench.spec.language import TEXT_LENGTH, encode
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task, packages_of
from clbench.worlds.observation import observed
from clbench.worlds.world import World

SIMULATORS = ("gymnasium", "mujoco", "numpy")
"""Packages whose version can change a trajectory in any suite; a task adds the packages of its own suite."""


@dataclass(frozen=True)
class Demonstration:
    """An episode of T steps."""

    state: NDArray[np.float32]
    """States of the world, (T + 1, S)."""
    executed: NDArray[np.float32]
    """Executed actions, (T, A)."""
    expert: NDArray[np.float32]
    """Action of the expert in each state, (T + 1, A)."""
    noisy: NDArray[np.bool_]
    """Whether a random action replaced the expert's, (T + 1,); the last entry is False."""
    reward: NDArray[np.float64]
    """Rewards, (T,)."""
    success: bool
    """Whether the episode ended in success."""
    seed: int | None = None
    """Seed of the initial state; None if the demonstration was recorded elsewhere."""


def demonstrate(world: World, task: Task, seed: int, noisy: bool) -> Demonstration:
    """Run the expert through one episode of `task`.

    Args:
        world: An environment of the task's world.
        task: Task of the episode.
        seed: Seed of the initial state and of the action noise.
        noisy: Whether 3 to 6 random actions replace the expert's now and then, with the probability that the
            task gives. Such an episode shows how to recover.

    Raises:
        LeakError: The running hooks of a method must not read demonstrations of the task.
        WrongTypeError: The expert returns something other than an action of the world.
    """
    check_demonstrations(task.name)
    expert = resolve(task.expert)(task.name)
    generator = np.random.default_rng([seed, 1])
    low, high = _action_bounds(world)

    def label(state: NDArray[np.float32]) -> NDArray[np.float32]:
        action = np.array(expert(state), np.float32)  # None becomes NaN
        if action.shape != low.shape:
            raise WrongTypeError(
                f"The expert {task.expert} of task {task.name} must return an action of shape {low.shape}, "
                f"not of {action.shape}."
            )
        return action

    state, _ = world.reset(seed=seed, options={"task": task.name})
    # copies: a world or an expert may return the same array in every step
    states, executed, random, rewards = [np.array(state, np.float32)], [], [], []
    labels = [label(state)]
    success, remaining = False, 0
    for _ in range(task.horizon):
        if noisy and remaining == 0 and generator.random() < task.action_noise:
            remaining = int(generator.integers(3, 7))
        action = generator.uniform(low, high).astype(np.float32) if remaining else labels[-1]
        action = np.clip(action, low, high)
        random.append(remaining > 0)
        remaining = max(0, remaining - 1)
        state, reward, terminated, _, _ = world.step(action)
        states.append(np.array(state, np.float32))
        executed.append(action)
        labels.append(label(state))
        rewards.append(float(reward))
        if terminated:
            success = True
            break
    return Demonstration(
        np.array(states, np.float32),
        np.array(executed, np.float32),
        np.clip(np.array(labels), low, high),
        np.array([*random, False]),
        np.array(rewards),
        success,
        seed,
    )


def simulator_versions(tasks: Iterable[Task]) -> dict[str, str]:
    """Return the versions of all packages that can change a trajectory of one of the tasks."""
    packages = {*SIMULATORS, *(package for task in tasks for package in task.packages)}
    return versions(packages)


def _action_bounds(world: World) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    assert isinstance(world.action_space, gymnasium.spaces.Box)
    return world.action_space.low, world.action_space.high


def collect(task: Task, budget: Budget) -> list[Demonstration]:
    """Return the successful expert episodes that a budget asks for; failed attempts are repeated.

    Args:
        task: Task of the episodes.
        budget: Budget with the number of demonstrations.

    Raises:
        InputError: The expert fails more often than it succeeds.
        LeakError: The running hooks of a method must not read them.
    """
    with contextlib.closing(_world(task)) as world:
        return _collect(world, task, budget, no_progress)


def _world(task: Task) -> World:
    world: World = resolve(task.world)()
    return world


def _collect(world: World, task: Task, budget: Budget, progress: ProgressCallback) -> list[Demonstration]:
    kept: list[Demonstration] = []
    for attempt in range(2 * budget.demonstrations):
        seed = derive_seed("demonstration", task.dataset_id, attempt)
        noisy = bool(numpy_generator("disturb", seed).random() < budget.noisy_demonstrations)
        episode = demonstrate(world, task, seed, noisy)
        if episode.success:
            kept.append(episode)
            progress(1)
        if len(kept) == budget.demonstrations:
            return kept
    raise InputError(
        f"The expert of {task.name!r} succeeded {len(kept)} times in {2 * budget.demonstrations} attempts; "
        f"{budget.demonstrations} demonstrations are needed. Fix {task.expert} or the success rule."
    )


def dataset_id(task: Task, budget: Budget) -> str:
    """Return the id of the task's Minari dataset, with a hash of everything that made the demonstrations.

    Two versions of a task, or two budgets, therefore never share a folder.
    """
    namespace, _, name = task.dataset_id.rpartition("/")
    return f"{namespace}/{hash_of(dataset_inputs(task, budget))}/{name}"


def dataset_inputs(task: Task, budget: Budget) -> dict[str, Any]:
    """Return everything that the demonstrations of a task depend on."""
    return {
        "task": dataclasses.asdict(task),
        "demonstrations": budget.demonstrations,
        "noisy_demonstrations": budget.noisy_demonstrations,
        "source": source_hash(*DATA_SOURCES, *packages_of([task], "world", "expert")),
        "versions": simulator_versions([task]),
    }


def dataset_folder(task: Task, budget: Budget, progress: ProgressCallback = no_progress) -> Path:
    """Return the folder of the task's Minari dataset, which is collected on first use.

    The folder is where Minari keeps its datasets, so that `minari.load_dataset(dataset_id(task, budget))`
    finds it.

    Args:
        task: Task of the demonstrations.
        budget: Budget with the number of demonstrations.
        progress: Called with the number of episodes collected since its last call.

    Raises:
        InputError: The expert fails more often than it succeeds.
        LeakError: The running hooks of a method must not read them.
    """
    check_demonstrations(task.name)
    return keep_dataset(task, budget, lambda world: _collect(world, task, budget, progress))


def keep_dataset(task: Task, budget: Budget, episodes: Callable[[World], Sequence[Demonstration]]) -> Path:
    """Return the folder of the task's Minari dataset, which holds the result of `episodes`.

    Args:
        task: Task of the demonstrations.
        budget: Budget with the number of demonstrations.
        episodes: Returns the episodes, given an environment of the task's world. It is called only if there
            is no such dataset yet.
    """
    name = dataset_id(task, budget)
    folder = minari_folder() / name

    def make(partial: Path) -> None:
        _declare_namespaces(folder, name)
        with contextlib.closing(_world(task)) as world:
            _write_dataset(partial / "data", name, task, world, episodes(world))

    return cached(folder, dataset_inputs(task, budget), make)


def has_dataset(task: Task, budget: Budget) -> bool:
    """Return whether Minari's folder holds the task's whole dataset, of this version of task and clbench."""
    return is_cached(minari_folder() / dataset_id(task, budget), dataset_inputs(task, budget))


def _declare_namespaces(folder: Path, dataset_id: str) -> None:
    """Write the namespace files that Minari's own listing looks for."""
    parts = dataset_id.split("/")[:-1]
    for depth in range(1, len(parts) + 1):
        namespace = folder.parents[len(parts) - depth]
        namespace.mkdir(parents=True, exist_ok=True)
        path = namespace / "namespace_metadata.json"
        if not path.exists():
            with replacing(path) as partial:  # written in place, it would stay empty after a full disk
                partial.write_text(
                    json.dumps({"description": "Expert demonstrations of clbench"}), encoding="utf-8"
                )


def _write_dataset(
    folder: Path, name: str, task: Task, world: World, episodes: Sequence[Demonstration]
) -> None:
    """Write episodes as a Minari dataset: the executed actions as actions, the expert's among the infos."""
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.new(folder, world.observation_space, world.action_space)
    buffers = []
    for number, episode in enumerate(episodes):
        last = np.arange(len(episode.executed)) == len(episode.executed) - 1
        buffers.append(
            EpisodeBuffer(
                id=number,
                seed=episode.seed,
                observations=list(episode.state),
                actions=list(episode.executed),
                rewards=list(episode.reward),
                terminations=list(last & episode.success),
                truncations=list(last & (not episode.success)),
                infos={"expert_action": list(episode.expert), "noisy": list(episode.noisy)},
            )
        )
    storage.update_metadata(
        {
            "dataset_id": name,
            "minari_version": version("minari"),
            "algorithm_name": f"expert {task.expert}",
            "description": f"{task.instructions[0]} (horizon {task.horizon})",
            "env_spec": _env_spec(task).to_json(),
        }
    )
    storage.update_episodes(buffers)


def _env_spec(task: Task) -> EnvSpec:
    """Return the spec of the environment that `recover_environment()` of a task's dataset makes."""
    return EnvSpec(
        task.environment_id,
        entry_point="clbench.worlds.world:one_task",
        max_episode_steps=task.horizon,
        kwargs={"world": task.world, "task": task.name},
    )


def read_dataset(folder: Path) -> list[Demonstration]:
    """Return the episodes of the Minari dataset in `folder`."""
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.read(folder / "data")
    numbers = range(storage.total_episodes)
    facts = storage.get_episode_metadata(numbers)
    return [
        _demonstration(episode, fact.get("seed"))
        for episode, fact in zip(storage.get_episodes(numbers), facts, strict=True)
    ]


def _demonstration(episode: dict[str, Any], seed: int | None) -> Demonstration:
    return Demonstration(
        np.asarray(episode["observations"], np.float32),
        np.asarray(episode["actions"], np.float32),
        np.asarray(episode["infos"]["expert_action"], np.float32),
        np.asarray(episode["infos"]["noisy"], np.bool_),
        np.asarray(episode["rewards"], np.float64),
        bool(episode["terminations"][-1]),
        seed,
    )


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations of one or more tasks as tensors: one row for each of N moments."""

    scenes: Tensor
    """States of the world, (N, W); no method gets them."""
    state: Tensor
    """Numbers that a policy sees of the states, (N, S)."""
    image: Tensor
    """Pictures that a policy sees of the states, uint8 (N, size, size, 3); the size is 0 without a camera."""
    action: Tensor
    """Next H actions of the expert, (N, H, A)."""
    valid: Tensor
    """Mask of actions that count, (N, H): 0 after the end of the episode and after action noise, else 1."""
    words: Tensor
    """Word ids of the instructions, (tasks, wordings, L)."""
    rows: Tensor
    """First row of each task and the number of its rows, (tasks, 2): the rows of a task are consecutive."""

    @classmethod
    def of_task(
        cls, task: Task, episodes: Sequence[Demonstration], chunk: int, text_length: int = TEXT_LENGTH
    ) -> Demonstrations:
        """Return the episodes of one task, cut into chunks of `chunk` actions.

        Raises:
            RenderingError: The task has a camera, and no back end of this machine can draw.
        """
        pieces = [_chunks(episode, chunk) for episode in episodes]
        action, valid = (torch.from_numpy(np.concatenate(column)) for column in zip(*pieces, strict=True))
        scenes = np.concatenate([episode.state[:-1] for episode in episodes])
        state, image = map(torch.from_numpy, observed(task, scenes))
        rows = torch.tensor([[0, len(state)]])
        return cls(
            torch.from_numpy(scenes),
            state,
            image,
            action,
            valid,
            encode(task.instructions, text_length)[None],
            rows,
        )

    @classmethod
    def cat(cls, parts: Sequence[Demonstrations]) -> Demonstrations:
        """Return the demonstrations of all parts as one."""
        wordings = max(part.words.shape[1] for part in parts)
        words = [part.words[:, torch.arange(wordings) % part.words.shape[1]] for part in parts]
        starts = np.cumsum([0, *(len(part.state) for part in parts)])
        rows = [part.rows + torch.tensor([int(start), 0]) for part, start in zip(parts, starts, strict=False)]
        scenes, state, image, action, valid = (
            torch.cat([getattr(part, name) for part in parts])
            for name in ("scenes", "state", "image", "action", "valid")
        )
        return cls(scenes, state, image, action, valid, torch.cat(words), torch.cat(rows))

    def __len__(self) -> int:
        """Return the number of moments."""
        return len(self.state)

    @property
    def bytes(self) -> int:
        """Memory of the data in bytes, without the scenes, which no policy learns from."""
        return sum(value.nbytes for name, value in vars(self).items() if name != "scenes")

    def sample(self, count: int, generator: torch.Generator) -> Batch:
        """Return `count` samples: each draws a task, then one of its moments and one of its wordings."""
        task = torch.randint(len(self.rows), (count,), generator=generator)
        first, length = self.rows[task].unbind(1)
        row = first + (torch.rand(count, generator=generator) * length).long()
        wording = torch.randint(self.words.shape[1], (count,), generator=generator)
        action = self.action[row]
        return Batch(
            self.state[row],
            self.words[task, wording],
            action,
            self.valid[row],
            torch.rand(count, generator=generator),
            torch.randn(action.shape, generator=generator),
            self.image[row],
        )


def _chunks(episode: Demonstration, chunk: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the chunks of an episode (T, chunk, A), and which of their steps count (T, chunk)."""
    steps = len(episode.executed)
    index = np.arange(steps)[:, None] + np.arange(chunk)
    inside = index < steps
    index = np.minimum(index, steps - 1)
    # after action noise the expert acts in states that the actions of this chunk do not lead to
    earlier = np.cumsum(episode.noisy[index], axis=1) - episode.noisy[index]
    valid = (inside & (earlier == 0)).astype(np.float32)
    return episode.expert[index], valid


def load_demonstrations(task: Task, scenario: Scenario, config: PolicyConfig) -> Demonstrations:
    """Return the demonstrations of `task` in chunks that fit a policy; they are collected on first use."""
    episodes = read_dataset(dataset_folder(task, scenario.budget))
    return Demonstrations.of_task(task, episodes, config.chunk, config.text_length)
